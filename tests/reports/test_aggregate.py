import json

import numpy as np
import pandas as pd
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.rows import Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.aggregate import CODED_CHANGE, OTHERS_LIMIT, STORAGE_CODED, summarise
from headbench.reports.runs import RunSet, explained
from headbench.reports.table_report import read_runs, table_of
from headbench.reports.writers import WRITERS

from .made_rows import avatar_row
from .made_rows import table_of as table_of_rows


def keys(subject, cameras):
    return [FrameKey(subject, "FREE", timestep, camera) for camera in cameras for timestep in (0, 1)]


def test_cameras_are_counted_by_subject_if_all_have_as_many():
    frames = [*keys("s1", "abc"), *keys("s2", "abd")]
    text = explained(frames, {("s1", "c"), ("s2", "d")})
    assert text.startswith("Seen cameras (2 scored) have training frames")
    assert text.endswith("unseen cameras (1 scored) have none.")
    assert "scored" not in explained([*frames, *keys("s2", "e")], {("s1", "c"), ("s2", "d")})


def summary(rows, task, metric, method="a"):
    return summarise(Rows(rows), method, metric, task)


def test_each_level_weighs_its_members_equally(make_rows):
    values = {"EMO": (1.0, 2.0, 6.0), "EXP": 11.0, "s2": 100.0}

    def value(metric, seed, subject, sequence, timestep, camera):
        one = values["s2"] if subject == "s2" else values[sequence]
        return (one[timestep] if isinstance(one, tuple) else one) + 10 * seed

    rows = make_rows({"a": value}, seeds=(0, 2))
    subject_1 = ((1 + 2 + 6) / 3 + 11) / 2
    for table in (rows, rows.sample(frac=1, random_state=1)):
        found = summary(table, "novel_view", "psnr")
        assert found.value == pytest.approx((subject_1 + 100) / 2 + (0 + 20) / 2)
        assert found.spread == pytest.approx(20 / 2**0.5)


@pytest.mark.parametrize(
    ("seeds", "gone", "reason"),
    [
        ((0,), ("novel_view", "EXP", 0), "1 of 5 frames"),
        ((0, 1), ("novel_view", "EXP", 1), "1 of 10 frames"),
        ((0,), ("", "", 0), "1 of 2 avatars"),
    ],
)
def test_a_method_that_lacks_a_value_has_no_mean(make_rows, seeds, gone, reason):
    rows = make_rows({"a": 1.0, "b": 1.0}, seeds=seeds)
    place = rows[["task", "sequence", "seed"]].apply(tuple, axis=1) == gone
    rows = rows[~(place & (rows["method"] == "a") & ((rows["task"] != "") | (rows["subject"] == "s2")))]
    metric = "psnr" if gone[0] else "size"
    aggregate = summary(rows, gone[0], metric)
    assert (aggregate.value, aggregate.status) == (None, "missing")
    assert reason in aggregate.reason
    assert summary(rows, gone[0], metric, method="b").value == 1.0
    assert summary(rows, "self_reenactment", "psnr").value == 1.0


@pytest.mark.parametrize("status", ["missing", "failed"])
def test_one_value_without_a_number_names_the_reason(make_rows, status):
    rows = make_rows({"a": 1.0})
    where = (rows["task"] == "novel_view") & (rows["metric"] == "lpips") & (rows["timestep"] == 1)
    rows.loc[where, ["status", "value", "reason"]] = [status, np.nan, "no weights\n here"]
    aggregate = summary(rows, "novel_view", "lpips")
    assert (aggregate.status, aggregate.value) == (status, None)
    assert aggregate.reason == f"1 of 5 values {status}: no weights here"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.iloc[[0, 0]], "repeats"),
        (lambda r: r.assign(version=[str(i) for i in range(len(r))]), "one version"),
    ],
)
def test_faulty_rows_are_refused(make_rows, change, message):
    rows = make_rows({"a": 1.0})
    Rows(rows).check()
    with pytest.raises(InputError, match=message):
        Rows(change(rows)).check()


FPS = MetricSpec("fps", "Speed", "FPS", True, 1, "m:fps", kind="avatar", machine_bound=True)
SIZE = MetricSpec("size", "Size", "MB", False, 1, "m:size", kind="avatar")
IDLE = {"machine": "A (2 cores)", "threads": 2, "other_cores": 0.02}
BUSY = {**IDLE, "other_cores": 0.84}
ONE = {**IDLE, "threads": 1}
THERE = {**IDLE, "machine": "B (8 cores)"}
UNKNOWN = {"machine": "A (2 cores)", "threads": 2}
LOADED = "Measured under load: other processes used up to {} cores."
ELSEWHERE = "Measured on {}; not comparable with other machines or thread counts."


def measured(**conditions):
    """Table of methods whose speed was measured under these conditions, one or several for subjects; size beside it."""
    rows = []
    for method, given in conditions.items():
        for index, each in enumerate(given if isinstance(given, list) else [given]):
            rows.append(avatar_row(method, "fps", 10.0 + index, f"s{index}", **each))
            rows.append(avatar_row(method, "size", 1.0, f"s{index}"))
    return table_of_rows(
        pd.DataFrame(rows), (FPS, SIZE), conditions, (), machine="abacus", trivial=("floor",)
    )


@pytest.mark.parametrize(
    ("conditions", "notes", "machine"),
    [
        ({"a": {**IDLE, "other_cores": OTHERS_LIMIT}, "b": IDLE}, {}, "A (2 cores) with 2 threads"),
        ({"a": IDLE, "b": BUSY}, {"b": LOADED.format(0.84)}, "A (2 cores) with 2 threads"),
        ({"a": [IDLE, BUSY], "b": [IDLE, IDLE]}, {"a": LOADED.format(0.84)}, "A (2 cores) with 2 threads"),
        (
            {"a": BUSY, "b": {**IDLE, "other_cores": 1.26}, "floor": BUSY},
            dict.fromkeys(("a", "b", "floor"), LOADED.format(1.26)),
            "A (2 cores) with 2 threads",
        ),
        *(
            (
                {"a": IDLE, "b": other},
                {"a": ELSEWHERE.format("A (2 cores) with 2 threads"), "b": ELSEWHERE.format(name)},
                f"A (2 cores) with 2 threads; {name}",
            )
            for other, name in ((ONE, "A (2 cores) with 1 thread"), (THERE, "B (8 cores) with 2 threads"))
        ),
        ({"a": IDLE, "b": IDLE, "floor": ONE}, {}, "A (2 cores) with 2 threads"),  # it is not compared
        ({"a": {}, "b": {}}, {}, "abacus, load not recorded"),
        ({"a": IDLE, "b": {}}, {}, "A (2 cores) with 2 threads; abacus, load not recorded"),
        ({"a": UNKNOWN, "b": UNKNOWN}, {}, "A (2 cores) with 2 threads, load not recorded"),
    ],
)
def test_what_does_not_compare_has_a_note(conditions, notes, machine):
    table = measured(**conditions)
    cells = {row.method: row.cells for row in table.rows}
    assert {m: table.notes[fps.note] for m, (fps, _) in cells.items() if fps.note is not None} == notes
    assert all(size.note is None for _, size in cells.values())
    assert len(table.notes) == len(set(notes.values()))
    assert f"Speed measured on {machine}." in table.caption


MARKS = {
    "md": "10.0<sup>1</sup>",
    "latex": r"10.0\textsuperscript{1}",
    "html": '10.0</span><sup><a href="#note-1">1</a></sup>',
    "csv": "Measured under load",
    "json": '"note": 0',
}


@pytest.mark.parametrize("form", WRITERS)
def test_the_mark_stands_in_every_format(form):
    text = WRITERS[form][1](measured(a=BUSY, b=BUSY))
    assert MARKS[form] in text
    assert "Measured under load" in text
    assert MARKS[form] not in WRITERS[form][1](measured(a=IDLE, b=IDLE))


def test_times_under_load_have_no_ranks():
    ranks = {
        name: [row.cells[0].rank for row in measured(a=IDLE, b=last).rows]
        for name, last in {"idle": IDLE, "busy": BUSY}.items()
    }
    assert ranks["busy"] == [None, None]
    assert None not in ranks["idle"]


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
