"""Rows of results with little to write."""

from headbench.bench.rows import Row, Rows
from headbench.reports.tables import build_table

TASKS = ("novel_view", "self_reenactment")


def row(method, metric, value, subject="s", sequence="EMO", timestep=0, camera="a", **changes):
    """A value of a frame of novel view, by protocol "h"; ``changes`` are other columns."""
    given = {"seed": 0, "task": "novel_view", "region": "full", "protocol": "h", **changes}
    place = {"subject": subject, "sequence": sequence, "timestep": timestep, "camera": camera}
    return Row(method=method, version="1", metric=metric, value=value, **place, **given)


def avatar_row(method, metric, value, subject="s", **changes):
    """A value of an avatar as a whole."""
    return row(method, metric, value, subject, "", -1, "", **{"task": "", "protocol": "", **changes})


def table_of(rows, metrics, methods, tasks=TASKS, protocol_ids=None, **options):
    """Table of a data frame of rows, one for each method of `methods`."""
    return build_table(Rows(rows), metrics, list(methods), tasks, protocol_ids=protocol_ids or {}, **options)
