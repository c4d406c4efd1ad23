"""Means over subjects of the points of a curve, and when they have an interval."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import t as student_t

from headbench.bench.contracts import Budget
from headbench.bench.io.images import read_png
from headbench.reports.curve import curve
from headbench.reports.curve.curve import (
    CurvePanel,
    CurvePoint,
    Leader,
    ended,
    leaders,
    mean_point,
    write_plot,
)

COSTS = np.geomspace(4.0, 64.0, 3)


def straight(slope, at_ten, offsets):
    """Quality that rises with the logarithm of the cost, by subject."""
    values = slope * np.log(COSTS / 10) + at_ten
    return {f"s{n}": list(zip(COSTS, values + offset)) for n, offset in enumerate(offsets)}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_leader_changes_where_the_lines_cross(sign):
    lines = {"slow": straight(sign * 3.0, 0.0, [0, 0]), "fast": straight(sign * 1.0, 0.0, [0, 0])}
    first, second = leaders(lines, higher_is_better=sign > 0)
    assert (first.method, second.method) == ("fast", "slow")
    assert first.start == pytest.approx(4.0)
    assert second.start == pytest.approx(10.0, rel=0.01)
    assert second.interval is None  # two subjects are too few


def test_the_interval_of_a_crossing_is_that_of_the_difference():
    offsets = np.array([-0.3, 0.1, 0.4, -0.2])
    lines = {"slow": straight(3.0, 0.0, offsets), "fast": straight(1.0, 0.0, 0 * offsets)}
    _, second = leaders(lines, higher_is_better=True)
    half = student_t.ppf(0.975, 3) * offsets.std(ddof=1) / 2
    # The difference is 2 log(cost / 10) plus the offsets, whose mean is 0.
    assert second.interval == pytest.approx([10 * np.exp(end * half / 2) for end in (-1, 1)], rel=0.01)


def test_an_interval_that_leaves_the_measured_costs_is_open():
    offsets = [-3.0, 1.0, 4.0, -2.0]
    lines = {"slow": straight(3.0, 0.0, offsets), "fast": straight(1.0, 0.0, [0] * 4)}
    _, second = leaders(lines, higher_is_better=True)
    assert second.interval == (None, None)
    assert second.text() == f"`slow` from {second.start:.3g} [below 4, above 64]"


def test_methods_are_compared_where_all_have_a_training():
    late = {"s0": [(20.0, 9.0), (64.0, 9.0)]}
    short = {"s0": [(4.0, 5.0), (8.0, 6.0)]}
    found = leaders({"short": short, "late": late}, higher_is_better=True)
    assert [(each.method, round(each.start)) for each in found] == [("late", 20)]
    # A training that took 8 fits a budget of 64 too.
    assert leaders({"short": short, "late": {"s0": [(20.0, 5.5)]}}, higher_is_better=True) == [
        Leader("short", 20.0, None, (20.0, 20.0))
    ]


def test_an_interval_is_open_below_the_lowest_cost_of_a_method():
    """Of two lines that cross at 32, the rising one is measured from 16 on."""
    offsets = (-3.0, 0.0, 3.0)
    short = {f"s{n}": [(4.0, 5.0), (64.0, 5.0)] for n in range(3)}
    late = {f"s{n}": [(16.0, 4.0 + offset), (64.0, 6.0 + offset)] for n, offset in enumerate(offsets)}
    _, second = leaders({"short": short, "late": late}, higher_is_better=True)
    assert second.start == pytest.approx(32.0, rel=0.01)
    assert second.text() == f"`late` from {second.start:.3g} [below 16, above 64]"


def test_costs_of_zero_are_compared_on_a_linear_axis():
    falling, constant = {"s0": [(0.0, 4.0), (2.0, 0.0)]}, {"s0": [(0.0, 1.0), (2.0, 1.0)]}
    found = leaders({"falling": falling, "constant": constant}, higher_is_better=True)
    assert [(each.method, each.start) for each in found] == [
        ("falling", 0.0),
        ("constant", pytest.approx(1.5, abs=0.01)),
    ]


def test_subjects_that_one_method_lacks_are_left_out():
    lines = {"a": {"s0": [(1.0, 1.0)], "s1": [(1.0, 99.0)]}, "b": {"s0": [(1.0, 2.0)]}}
    assert [each.method for each in leaders(lines, higher_is_better=True)] == ["b"]
    assert leaders({"a": {"s0": [(1.0, 1.0)]}, "b": {"s1": [(1.0, 1.0)]}}, higher_is_better=True) == []
    assert leaders({}, higher_is_better=True) == []


@pytest.mark.parametrize(
    ("values", "mean", "half"),
    [
        ([20.0], 20.0, None),
        ([20.0, 22.0], 21.0, None),  # one degree of freedom: 12.7 standard errors
        ([20.0, 22.0, 24.0], 22.0, 4.302653 * 2 / 3**0.5),  # Student's t of two degrees of freedom
        ([20.0, None, 24.0], None, None),
    ],
)
def test_a_mean_has_an_interval_from_three_subjects(values, mean, half):
    part = Fraction(1), Budget(iterations=2), 3, 4, 12, None, {"megabytes": 2.0}
    points = [CurvePoint("a", str(i), (1.0,), *part, {"psnr": v}, {}) for i, v in enumerate(values)]
    found = mean_point(points)
    assert (found.values["psnr"], found.cost["megabytes"]) == (mean, 2.0)
    assert found.halves["psnr"] == (None if half is None else pytest.approx(half))


@pytest.mark.parametrize(
    ("lengths", "seen", "unseen", "end"),
    [
        ([10], [20.0], [20.0], False),
        ([10, 20], [20.0, 20.06], [20.0, 20.0], False),
        ([10, 20], [20.0, 20.04], [20.0, 20.1], True),
        ([10, 40], [20.0, 20.09], [20.0, 20.1], True),  # 0.045 dB for twice the length
        ([10, 20], [20.0, 21.0], [20.0, 19.9], True),
        ([10, 20], [20.0, 21.0], [None, None], False),
        ([10, 20], [20.0, None], [20.0, 20.1], True),
    ],
)
def test_a_curve_ends_at_its_gain_or_at_its_maximum(lengths, seen, unseen, end):
    points = [
        CurvePoint("a", "s", (n,), Fraction(1), Budget(n), 3, 4, 12, None, {}, {"seen": s, "unseen": u}, {})
        for n, s, u in zip(lengths, seen, unseen)
    ]
    assert ended(points, "seen", "unseen") == end


@pytest.mark.parametrize(
    ("tasks", "says"),
    [
        (
            ("novel_view", "self_reenactment"),
            "a training camera and one of 3 consecutive training timesteps.",
        ),
        (("self_reenactment",), "Held out of every training: one of 3 consecutive training timesteps."),
    ],
)
def test_the_plot_says_what_is_held_out(monkeypatch, tmp_path, tasks, says):
    notes = []
    monkeypatch.setattr(curve, "write_plot", lambda path, rows, cost, note: notes.append(note))
    empty = curve.CurveData("cameras", ["s"], [], [], [], tasks, "seconds", {}, 3, {}, {})
    curve.write_curve(tmp_path / "curve.png", empty)
    assert says in notes[0]


def test_a_plot_has_each_method_and_no_line_where_none_is(tmp_path):
    lines = {"a": [(1.0, 20.0, 0.0), (4.0, 22.0, 0.5)], "b": [(2.0, 21.0, 0.0)]}
    panels = [CurvePanel("PSNR", lines, ""), CurvePanel("LPIPS", {}, "no weights")]
    write_plot(tmp_path / "curve.png", [panels], "Seconds", "A note.")
    picture = read_png(tmp_path / "curve.png")
    blue, vermilion = (
        (picture == colour).all(axis=2).any(axis=0) for colour in ((0, 114, 178), (213, 94, 0))
    )
    half = picture.shape[1] // 2
    assert blue[:half].sum() > vermilion[:half].sum() > 0
    assert not blue[half:].any()
