import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.bench.specs import Mechanism, MetricSpec
from headbench.reports.tables import compact
from headbench.reports.writers import to_markdown, to_text

from .conftest import LPIPS, PSNR, SIZE
from .made_rows import avatar_row, row, table_of

METRIC = MetricSpec("m", "M", "", True, 2, "m:m")


def cells(table, metric, task="novel_view"):
    """Cell of each method in a column."""
    index = next(i for i, c in enumerate(table.columns) if (c.task, c.metric) == (task, metric))
    return {row.method: row.cells[index] for row in table.rows}


def ranks(table, metric):
    return {method: cell.rank for method, cell in cells(table, metric).items()}


def test_columns_are_tasks_then_the_avatar(make_rows, metrics):
    table = table_of(make_rows({"a": 1.0}), metrics, "a")
    assert [(c.title, c.label, c.arrow) for c in table.columns] == [
        ("Novel view", "PSNR", "↑"),
        ("Novel view", "LPIPS", "↓"),
        ("Self-reenactment", "PSNR", "↑"),
        ("Self-reenactment", "LPIPS", "↓"),
        ("Avatar", "Size", "↓"),
    ]


def test_a_trivial_baseline_is_listed_apart_and_never_ranked(make_rows, metrics):
    values = {"floor": 0.5, "a": 1.0, "b": 2.0}
    table = table_of(make_rows(values), metrics, values, trivial=["floor"])
    assert not table.warnings
    assert ranks(table, "psnr") == {"a": 2, "b": 1, "floor": None}
    assert [(title, [r.method for r in rows]) for title, rows in table.groups] == [
        ("Methods", ["a", "b"]),
        ("Trivial baselines (not ranked)", ["floor"]),
    ]
    alone = table_of(make_rows(values), metrics, ["a", "floor"], trivial=["floor"])
    assert ranks(alone, "psnr") == {"a": None, "floor": None}
    assert "bold" not in alone.caption


def test_a_mechanism_that_is_off_is_named_and_none_is_ranked(make_rows, metrics):
    spec = MetricSpec("dynamic_splats", "Dynamic", "%", True, 1, "m:m", kind="mechanism")
    lines = Mechanism("lines", "opacity", "none")
    found = {"a": [3.0, 4.0], "b": [0.0, 40.0], "c": [8.0, 8.0], "none": [0.0, 0.0]}  # of two subjects
    rows = [
        avatar_row(method, spec.name, value, subject, reason=lines.told(value, method))
        for method, values in found.items()
        for subject, value in zip("st", values)
    ]
    table = table_of(pd.DataFrame(rows), [spec], found, [])
    assert table.warnings == ("a: lines off: 3.5 % of the splats change (opacity).",)
    assert {cell.rank for row in table.rows for cell in row.cells} == {None}
    assert table.notes == ("lines: opacity.", "lines left out: opacity.")
    assert to_text(table).startswith(table.warnings[0])


def test_a_method_below_a_baseline_is_named_first_and_not_ranked(make_rows, metrics):
    values = {"floor": 1.5, "lower": 0.5, "floor+fitted": 2.5, "a": 1.0, "b": 2.0, "c": 3.0}
    table = table_of(make_rows(values), metrics, values, trivial=["floor", "lower", "floor+fitted"])
    assert [(title, [r.method for r in rows]) for title, rows in table.groups] == [
        ("Methods", ["b", "c"]),
        ("Not better than a trivial baseline (not ranked)", ["a"]),
        ("Trivial baselines (not ranked)", ["floor", "lower", "floor+fitted"]),
    ]
    assert ranks(table, "psnr") == {
        "a": None,
        "b": 2,
        "c": 1,
        "floor": None,
        "lower": None,
        "floor+fitted": None,
    }
    assert table.warnings[0] == "a is not better than floor in novel view: PSNR 1.00 against 1.50 dB."
    assert to_text(table).startswith(table.warnings[0])
    assert table.warnings[0] in to_markdown(table)


def test_missing_and_failed_cells_say_why_and_are_not_ranked(make_rows, metrics):
    rows = make_rows({"a": 1.0, "b": 2.0})
    lpips = rows["metric"] == "lpips"
    rows.loc[lpips, ["status", "value", "reason"]] = ["missing", np.nan, "No weights. Put them there."]
    given = {"value": np.nan, "status": "failed", "reason": "RuntimeError: diverged"}
    rows = pd.concat([rows, make_rows({"c": 0.0}).assign(**given)], ignore_index=True)
    table = table_of(rows, metrics, "abcd")
    absent = cells(table, "lpips")["a"]
    assert (absent.text, absent.rank, table.notes[absent.note]) == ("–", None, "No weights. Put them there.")
    for column, shown in zip(table.columns, next(r for r in table.rows if r.method == "c").cells):
        assert (shown.status, shown.text, shown.rank) == ("failed", "failed", None), column
        assert table.notes[shown.note] == "RuntimeError: diverged"
    assert "Not measured" in table.notes[cells(table, "psnr")["d"].note]
    assert ranks(table, "psnr") == {"a": 2, "b": 1, "c": None, "d": None}
    assert len(table.notes) == len(set(table.notes)) == 3
    assert table.tasks[0].frames == 5


def test_rows_of_different_protocols_are_not_mixed(make_rows, metrics):
    rows = make_rows({"a": 1.0, "b": 2.0})
    rows.loc[(rows["method"] == "b") & (rows["task"] == "novel_view"), "protocol"] = "other"
    with pytest.raises(InputError, match="hash-novel_view, other"):
        table_of(rows, metrics, "ab")


def test_the_caption_names_protocol_frames_and_size(make_rows, metrics):
    rows = make_rows({"a": 1.0, "b": 2.0}, seeds=(0, 1))
    ids = {"novel_view": "novel_view/canonical/1"}
    caption = table_of(rows, metrics, "ab", protocol_ids=ids, image_size="550 x 802").caption
    for part in (
        "Novel view: 5 frames, 2 subjects, protocol novel_view/canonical/1 (hash-novel_view).",
        "Self-reenactment: 5 frames, 2 subjects, protocol (hash-self_reenactment).",
        "Images of 550 x 802 pixels.",
        "Mean over frames, then sequences, then subjects; mean of 2 seeds ±",
    ):
        assert part in caption


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(0, 50), min_size=2, max_size=6), st.booleans(), st.integers(0, 3))
def test_ranks_agree_with_a_count_of_better_displayed_values(values, higher, digits):
    metric = MetricSpec("m", "M", "", higher, digits, "m:m")
    names = [f"method{i}" for i in range(len(values))]
    rows = pd.DataFrame(row(n, "m", v) for n, v in zip(names, values))
    table = table_of(rows, [metric], names, ["novel_view"])
    shown = [float(f"{v:.{digits}f}") for v in values]
    for line, own in zip(table.rows, shown):
        better = {other for other in shown if (other > own if higher else other < own)}
        assert line.cells[0].rank == 1 + len(better)


def many_subjects(methods, subjects=9, seeds=(0,), spread=0.0):
    """Rows of methods at levels, each subject and method a little off; ``spread`` moves whole seeds."""
    generator = np.random.default_rng(1)
    return pd.DataFrame(
        row(m, "m", level + noise + spread * seed, f"s{s}", timestep=t, seed=seed)
        for m, level in methods.items()
        for s in range(subjects)
        for noise in [generator.normal(0, 0.2)]
        for seed in seeds
        for t in range(2)
    )


@pytest.mark.parametrize(
    ("second", "subjects", "expected", "caption"),
    [
        (
            30.02,
            9,
            {"a": 1, "b": 1, "c": 2, "d": 3},
            "(exact sign-flip test over 9 subjects, each method against all others, Holm, 5%). The others",
        ),
        (
            30.5,
            5,
            {"a": 2, "b": 1, "c": 3, "d": 4},
            "by the digits shown, without a test, which needs 7 subjects (here 5 subjects)",
        ),
    ],
)
def test_all_that_a_test_cannot_exclude_are_marked_best(second, subjects, expected, caption):
    levels = {"a": 30.0, "b": second, "c": 28.0, "d": 25.0}
    table = table_of(many_subjects(levels, subjects), [METRIC], levels, ["novel_view"])
    assert len({row.cells[0].text for row in table.rows}) == 4
    assert ranks(table, "m") == expected
    assert caption in table.caption


def test_a_column_with_too_few_subjects_for_its_test_is_named(metrics):
    # Six subjects are enough for two methods, not for three; the third has no LPIPS.
    rows = many_subjects({"a": 30.0, "b": 28.0, "c": 25.0}, 6)
    both = pd.concat([rows.assign(metric="psnr"), rows.assign(metric="lpips")], ignore_index=True)
    both = both[~((both["metric"] == "lpips") & (both["method"] == "c"))]
    table = table_of(both, metrics[:2], "abc", ["novel_view"])
    assert ranks(table, "psnr") == {"a": 1, "b": 2, "c": 3}
    assert "Too few subjects for a test, ranked by the digits alone: Novel view PSNR." in table.caption
    assert "sign-flip test over 6 subjects" in table.caption


def test_seeds_have_their_spread_and_subjects_theirs_not():
    levels = {"a": 30.0, "b": 28.0}
    rows = many_subjects(levels, seeds=(0, 1, 2), spread=0.5)
    one = table_of(rows, [METRIC], levels, ["novel_view"]).rows[0].cells[0]
    assert one.spread == "0.500"  # of 0, 0.5 and 1: no part of it from the subjects, which differ by 0.2
    assert one.shown == f"{one.text} ± 0.500"
    single = table_of(many_subjects(levels), [METRIC], levels, ["novel_view"])
    assert {row.cells[0].spread for row in single.rows} == {""}


def without_lpips(values):
    rows = [row(method, "psnr", value) for method, value in values.items()]
    rows += [row(method, "lpips", float("nan"), status="missing", reason="No weights.") for method in values]
    rows += [avatar_row(method, "size", size) for size, method in enumerate(values, 1)]
    return table_of(pd.DataFrame(rows), [PSNR, LPIPS, SIZE], values, ["novel_view"])


def test_rows_are_best_first_and_empty_columns_a_sentence():
    table = without_lpips({"a": 20.0, "b": 30.0, "c": 25.0})
    found = compact(table)
    assert [line.method for line in found.rows] == ["b", "c", "a"]
    assert [column.metric for column in found.columns] == ["psnr", "size"]
    assert "No values of Novel view LPIPS: No weights." in found.caption
    assert found.notes == ()
    assert {line.method: line.cells[0].value for line in found.rows} == {
        line.method: line.cells[0].value for line in table.rows
    }


def test_a_table_without_values_stays():
    rows = [row("a", "lpips", float("nan"), status="missing", reason="No weights.")]
    table = table_of(pd.DataFrame(rows), [LPIPS], ["a"], ["novel_view"])
    assert compact(table) == table
