"""Marks of times that do not compare: measured under load, with other threads or on another machine."""

import pandas as pd
import pytest

from headbench.bench.specs import MetricSpec
from headbench.reports.aggregate import OTHERS_LIMIT
from headbench.reports.writers import WRITERS

from .made_rows import avatar_row, table_of

FPS = MetricSpec("fps", "Speed", "FPS", True, 1, "m:fps", kind="avatar", machine_bound=True)
SIZE = MetricSpec("size", "Size", "MB", False, 1, "m:size", kind="avatar")
IDLE = {"machine": "A (2 cores)", "threads": 2, "other_cores": 0.02}
BUSY = {**IDLE, "other_cores": 0.84}
ONE = {**IDLE, "threads": 1}
THERE = {**IDLE, "machine": "B (8 cores)"}
UNKNOWN = {"machine": "A (2 cores)", "threads": 2}
LOADED = "Measured under load: other processes used up to {} cores."
ELSEWHERE = "Measured on {}; not comparable with other machines or thread counts."


def made(**conditions):
    """Table of methods whose speed was measured under these conditions, one or several for subjects; size beside it."""
    rows = []
    for method, given in conditions.items():
        for index, each in enumerate(given if isinstance(given, list) else [given]):
            rows.append(avatar_row(method, "fps", 10.0 + index, f"s{index}", **each))
            rows.append(avatar_row(method, "size", 1.0, f"s{index}"))
    return table_of(pd.DataFrame(rows), (FPS, SIZE), conditions, (), machine="abacus", trivial=("floor",))


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
    table = made(**conditions)
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
    text = WRITERS[form][1](made(a=BUSY, b=BUSY))
    assert MARKS[form] in text
    assert "Measured under load" in text
    assert MARKS[form] not in WRITERS[form][1](made(a=IDLE, b=IDLE))


def test_times_under_load_have_no_ranks():
    ranks = {
        name: [row.cells[0].rank for row in made(a=IDLE, b=last).rows]
        for name, last in {"idle": IDLE, "busy": BUSY}.items()
    }
    assert ranks["busy"] == [None, None]
    assert None not in ranks["idle"]
