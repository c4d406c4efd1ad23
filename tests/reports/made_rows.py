"""Rows of results with little to write."""

from types import SimpleNamespace

from headbench.bench.manifest import MethodRecord
from headbench.bench.rows import Row, Rows
from headbench.reports.runs import RunSet
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


def table_of(rows, metrics, methods, tasks=TASKS, trivial=(), protocol_ids=None, **facts):
    """Table of a data frame of rows, one for each method of `methods`; ``facts`` are those of a run."""
    ids = {task: SimpleNamespace(id=name) for task, name in (protocol_ids or {}).items()}
    manifest = SimpleNamespace(protocols=ids, clips=())
    run = SimpleNamespace(**{"manifest": manifest, "image_size": "", "machine": "", **facts})
    records = {name: MethodRecord(name, "1", "", name in trivial, None, {}) for name in methods}
    runs = RunSet((run,), Rows(rows), tuple(metrics), tuple(tasks), records, tuple(trivial), {}, {})
    return build_table(runs, metrics, tasks)
