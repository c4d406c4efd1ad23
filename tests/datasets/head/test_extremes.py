"""Every numerical extreme of the head model; faults are found."""

import pytest

from headbench.bench.contracts import no_progress
from headbench.datasets.benchmarks.head import HEAD_EXTREMES, stress, try_extreme
from headbench.datasets.head.model import FastPosing
from headbench.datasets.head.rotations import axis_angle_to_matrix

from .toy import toy_head

HEAD = toy_head(16, eyelids=True)


@pytest.mark.parametrize("case", HEAD_EXTREMES, ids=lambda case: case.name)
def test_extreme_of_the_head_model(case):
    assert try_extreme(case, HEAD)["verdict"] == "ok"


@pytest.mark.slow
def test_the_whole_head_command_passes():
    found = stress(False, no_progress)
    assert found.passed
    assert len(found.data["verdicts"]) == len(HEAD_EXTREMES)


def test_a_wrong_fast_path_is_found(monkeypatch):
    right = FastPosing.forward
    monkeypatch.setattr(FastPosing, "forward", lambda *a: right(*a) + 1e-9)
    assert try_extreme(HEAD_EXTREMES[0], HEAD)["verdict"] == "the paths differ"


def test_gradients_that_are_not_finite_are_found(monkeypatch):
    def careless(axis_angle):
        """The right matrices; the root of the squared angle has no finite gradient at zero."""
        return axis_angle_to_matrix(axis_angle) + 0 * axis_angle.square().sum(-1).sqrt()[..., None, None]

    monkeypatch.setattr("headbench.datasets.head.model.axis_angle_to_matrix", careless)
    assert try_extreme(HEAD_EXTREMES[0], HEAD)["verdict"] == "not finite"
