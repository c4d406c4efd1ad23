import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.bench.specs import MetricSpec
from headbench.bench.store import Row, to_frame
from headbench.reports.tables import build_table


def ranks(table, task, metric):
    index = next(i for i, c in enumerate(table.columns) if (c.task, c.metric) == (task, metric))
    return {row.method: row.cells[index].rank for row in table.rows}


def cell(table, method, task, metric):
    index = next(i for i, c in enumerate(table.columns) if (c.task, c.metric) == (task, metric))
    return next(row.cells[index] for row in table.rows if row.method == method)


def test_columns_are_tasks_then_the_avatar(make_rows, metrics):
    table = build_table(make_rows({"a": 1.0}), metrics, ["a"])
    assert [(c.title, c.label, c.arrow) for c in table.columns] == [
        ("Novel view", "PSNR", "↑"),
        ("Novel view", "LPIPS", "↓"),
        ("Self-reenactment", "PSNR", "↑"),
        ("Self-reenactment", "LPIPS", "↓"),
        ("Avatar", "Size", "↓"),
    ]


def test_direction_decides_the_rank(make_rows, metrics):
    table = build_table(make_rows({"a": 1.0, "b": 3.0, "c": 2.0}), metrics, ["a", "b", "c"])
    assert ranks(table, "novel_view", "psnr") == {"a": 3, "b": 1, "c": 2}
    assert ranks(table, "novel_view", "lpips") == {"a": 1, "b": 3, "c": 2}


def test_values_that_look_equal_share_a_rank(make_rows, metrics):
    values = {"a": 30.004, "b": 29.996, "c": 29.99, "d": 12.0}
    table = build_table(make_rows(values), metrics, list(values))
    assert [cell(table, m, "novel_view", "psnr").text for m in "abc"] == ["30.00", "30.00", "29.99"]
    assert ranks(table, "novel_view", "psnr") == {"a": 1, "b": 1, "c": 2, "d": 3}
    assert cell(table, "a", "novel_view", "psnr").value == pytest.approx(30.004)


def test_a_floor_is_listed_apart_and_never_ranked(make_rows, metrics):
    values = {"floor": 99.0, "a": 1.0, "b": 2.0}
    table = build_table(make_rows(values), metrics, list(values), trivial=["floor"])
    assert ranks(table, "novel_view", "psnr") == {"a": 2, "b": 1, "floor": None}
    assert [(title, [r.method for r in rows]) for title, rows in table.groups] == [
        ("Methods", ["a", "b"]),
        ("Floor (not ranked)", ["floor"]),
    ]


def test_a_single_method_has_nothing_to_be_best_of(make_rows, metrics):
    table = build_table(make_rows({"a": 1.0, "floor": 2.0}), metrics, ["a", "floor"], trivial=["floor"])
    assert ranks(table, "novel_view", "psnr") == {"a": None, "floor": None}
    assert "bold" not in table.caption


def test_missing_and_failed_cells_say_why_and_are_not_ranked(make_rows, metrics):
    rows = make_rows({"a": 1.0, "b": 2.0, "c": 3.0})
    lpips = rows["metric"] == "lpips"
    rows.loc[lpips, ["status", "value", "reason"]] = ["missing", np.nan, "No weights. Put them there."]
    rows = rows[rows["method"] != "c"]
    failed = [
        Row(
            "c",
            "1",
            0,
            task,
            subject,
            "",
            -1,
            "",
            "full",
            metric,
            np.nan,
            protocol,
            "failed",
            "RuntimeError: diverged",
        )
        for subject in ("s1", "s2")
        for task, metric, protocol in [
            ("novel_view", "psnr", "hash-novel_view"),
            ("novel_view", "lpips", "hash-novel_view"),
            ("self_reenactment", "psnr", "hash-self_reenactment"),
            ("self_reenactment", "lpips", "hash-self_reenactment"),
            ("", "size", ""),
        ]
    ]
    rows = pd.concat([rows, to_frame(failed)], ignore_index=True)
    table = build_table(rows, metrics, ["a", "b", "c", "d"])
    absent = cell(table, "a", "novel_view", "lpips")
    assert (absent.text, absent.rank, table.notes[absent.note]) == ("–", None, "No weights. Put them there.")
    for column, shown in zip(table.columns, next(r for r in table.rows if r.method == "c").cells):
        assert (shown.status, shown.text, shown.rank) == ("failed", "failed", None), column
        assert table.notes[shown.note] == "RuntimeError: diverged"
    assert "Not measured" in table.notes[cell(table, "d", "novel_view", "psnr").note]
    assert ranks(table, "novel_view", "psnr") == {"a": 2, "b": 1, "c": None, "d": None}
    assert len(table.notes) == len(set(table.notes)) == 3
    assert table.tasks[0].frames == 5


def test_rows_of_different_protocols_are_not_mixed(make_rows, metrics):
    rows = make_rows({"a": 1.0, "b": 2.0})
    rows.loc[(rows["method"] == "b") & (rows["task"] == "novel_view"), "protocol"] = "other"
    with pytest.raises(InputError, match="hash-novel_view, other"):
        build_table(rows, metrics, ["a", "b"])


def test_the_caption_tells_protocol_frames_and_size(make_rows, metrics):
    table = build_table(
        make_rows({"a": 1.0, "b": 2.0}, seeds=(0, 1)),
        metrics,
        ["a", "b"],
        protocol_ids={"novel_view": "novel_view/canonical/1"},
        image_size="550 x 802",
    )
    for part in (
        "Novel view: 5 frames, 2 subjects, protocol novel_view/canonical/1 (hash-novel_view).",
        "Self-reenactment: 5 frames, 2 subjects, protocol (hash-self_reenactment).",
        "550 x 802",
        "2 seeds",
        "Mean over frames, then sequences, then subjects",
    ):
        assert part in table.caption


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.floats(0, 50), min_size=2, max_size=6),
    st.booleans(),
    st.integers(0, 3),
)
def test_ranks_agree_with_a_count_of_better_displayed_values(values, higher, digits):
    metric = MetricSpec("m", "M", "", higher, digits, "m:m")
    names = [f"method{i}" for i in range(len(values))]
    rows = to_frame(
        Row(n, "1", 0, "novel_view", "s", "q", 0, "a", "full", "m", v, "h") for n, v in zip(names, values)
    )
    table = build_table(rows, [metric], names)
    shown = [float(f"{v:.{digits}f}") for v in values]
    for row, own in zip(table.rows, shown):
        better = {other for other in shown if (other > own if higher else other < own)}
        assert row.cells[0].rank == 1 + len(better)
