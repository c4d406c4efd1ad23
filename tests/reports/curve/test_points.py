"""Means over subjects of the points of a curve, and when they have an interval."""

from fractions import Fraction

import pytest

from headbench.bench.contracts import Budget
from headbench.bench.io.images import read_png
from headbench.reports.curve import curve
from headbench.reports.curve.curve import CurvePanel, write_plot
from headbench.reports.curve.points import CurvePoint, mean_point


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
