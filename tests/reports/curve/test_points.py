"""Means over subjects of the points of a curve, and when they have an interval."""

from fractions import Fraction

import pytest

from headbench.bench.contracts import Budget
from headbench.reports.curve import curve
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
    points = [
        CurvePoint(
            "a",
            str(index),
            (1.0,),
            Fraction(1),
            Budget(iterations=2),
            3,
            4,
            12,
            None,
            {"megabytes": 2.0},
            {"psnr": value},
            {},
        )
        for index, value in enumerate(values)
    ]
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
