"""The benchmark's cases on a few timesteps: both solvers agree, and faults are named."""

import numpy as np
import pytest

from headbench.datasets.head.procedural.model import procedural_head
from headbench.tests.benchmarks.refit import _faults, measure_case, performance


def test_both_solvers_find_the_same_meshes():
    head = procedural_head("2020")
    row = measure_case(head, head, 4, 2)
    assert row["mean_mm"] < 0.02
    assert row["scipy_difference_mm"] < 1e-3
    assert row["solver_per_second"] > row["scipy_per_second"] > 0


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"mean_mm": 0.2}, "residual"),
        ({"p95_mm": 0.5}, "residual"),
        ({"timesteps_per_second": 30.0}, "fewer"),
    ],
)
def test_what_breaks_a_bound_is_named(change, fault):
    row = {"case": "small", "exact": True, "mean_mm": 0.01, "p95_mm": 0.02, "timesteps_per_second": 50.0}
    assert _faults(row) == []
    assert [fault in line for line in _faults({**row, **change})] == [True]


def test_a_performance_moves_everything():
    clip = performance(procedural_head("2020"), 40)
    for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids"):
        values = np.array([getattr(pose, name) for pose in clip.poses.values()])
        assert np.ptp(values, axis=0).min() > 0.005, name
