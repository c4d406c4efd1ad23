"""Rows of results with little to write."""

from headbench.bench.rows import Row


def row(method, metric, value, subject="s", sequence="EMO", timestep=0, camera="a", **changes):
    """A value of a frame of novel view, by protocol "h"; ``changes`` are other columns."""
    given = {"seed": 0, "task": "novel_view", "region": "full", "protocol": "h", **changes}
    return Row(
        method=method,
        version="1",
        subject=subject,
        sequence=sequence,
        timestep=timestep,
        camera=camera,
        metric=metric,
        value=value,
        **given,
    )


def avatar_row(method, metric, value, subject="s", **changes):
    """A value of an avatar as a whole."""
    return row(method, metric, value, subject, "", -1, "", **{"task": "", "protocol": "", **changes})
