"""Coded avatars as columns of their methods: values, what is missing, and what no table may mix."""

import json

import pytest

from headbench.bench.errors import InputError
from headbench.reports.aggregate import CODED_CHANGE, STORAGE_CODED
from headbench.reports.runs import RunSet
from headbench.reports.table_report import read_runs, table_of

LEVELS = {"ga": 30.0, "ours": 32.0, "mean-image": 20.0, "ga+coded": 29.9, "ours+coded": 32.25}


def recorded(folder, **codecs):
    """The run with codecs of its methods by label, as JSON has them."""
    path = folder / "run.json"
    record = json.loads(path.read_text())
    for method in record["methods"]:
        label = method["name"] + ("+" + method["condition"] if method.get("condition") else "")
        if label in codecs:
            method["codec"] = codecs[label]
    path.write_text(json.dumps(record))
    return folder


ALIKE = {"ga": "", "ours": "", "mean-image": "", "ga+coded": "2, steps x1", "ours+coded": "2, steps x1"}


def test_coded_avatars_are_columns_and_no_rows(write_run):
    table = table_of(RunSet.read([recorded(write_run("run", LEVELS), **ALIKE)]))
    assert [row.method for row in table.rows] == ["ga", "ours", "mean-image"]
    names = [column.metric for column in table.columns if not column.task]
    assert names[:3] == ["storage", STORAGE_CODED.name, CODED_CHANGE.name]
    cells = {row.method: dict(zip([c.metric for c in table.columns], row.cells)) for row in table.rows}
    for method, change in (("ga", -0.1), ("ours", 0.25)):
        # The sizes of the written run are 5 and a tenth of the level.
        assert cells[method]["storage"].value == pytest.approx(5 + 0.1 * LEVELS[method])
        assert cells[method][STORAGE_CODED.name].value == pytest.approx(5 + 0.1 * LEVELS[f"{method}+coded"])
        assert cells[method][CODED_CHANGE.name].value == pytest.approx(change)
    for name in (STORAGE_CODED.name, CODED_CHANGE.name):
        cell = cells["mean-image"][name]
        assert cell.status == "missing"
        assert "no coded avatar" in table.notes[cell.note]


def test_a_run_without_coded_avatars_has_no_such_column(write_run):
    plain = {name: level for name, level in LEVELS.items() if "+" not in name}
    table = table_of(RunSet.read([write_run("run", plain)]))
    assert not {STORAGE_CODED.name, CODED_CHANGE.name} & {column.metric for column in table.columns}


def test_other_conditions_stay_rows(write_run):
    runs = RunSet.read([write_run("run", {**LEVELS, "ours+cameras-4": 31.0})])
    assert runs.changed == ("ours+cameras-4",)
    row = next(row for row in table_of(runs).rows if row.method == "ours+cameras-4")
    assert row.cells[-1].status == "ok"


@pytest.mark.parametrize(
    ("codecs", "says"),
    [
        ({"ours": "2, steps x1"}, "codec of trained avatars: expected files as trained"),
        ({"ours": "2, steps x1", "ga": "2, steps x1"}, "codec of trained avatars"),
        ({"ours+coded": "2, steps x2"}, "codec of coded avatars: expected one codec with one set of steps"),
        ({"ga+coded": "2, steps x1; 2, steps x2"}, "codec of coded avatars"),
    ],
)
def test_methods_that_are_coded_differently_are_refused(write_run, codecs, says):
    folder = recorded(write_run("run", LEVELS), **{**ALIKE, **codecs})
    for read in (RunSet.read, lambda folders: read_runs(folders).table):
        with pytest.raises(InputError, match=says):
            read([folder])


def test_runs_that_are_coded_differently_are_refused(write_run):
    one = recorded(write_run("one", {name: LEVELS[name] for name in ("ga", "ga+coded")}), **ALIKE)
    other = write_run("other", {name: LEVELS[name] for name in ("ours", "ours+coded")})
    assert RunSet.read([one, recorded(other, **ALIKE)]).methods == ("ga", "ours")
    with pytest.raises(InputError, match="codec of coded avatars"):
        RunSet.read([one, recorded(other, **{**ALIKE, "ours+coded": "2, steps x4"})])
