"""The head model at extremes, and that a broken model is found out."""

import pytest

from headbench.bench.contracts import no_progress
from headbench.datasets.head.model import FastPosing
from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.tests.benchmarks.head import stress

from ..datasets.head.toy import toy_head

HEAD = toy_head(16, eyelids=True)


@pytest.mark.parametrize("case", stress.CASES, ids=lambda case: case.name)
def test_extreme(case):
    verdict = stress.try_case(case, HEAD)
    assert verdict.complaint == ""


@pytest.mark.slow
def test_the_whole_command_passes():
    findings = stress.measure(False, no_progress)
    assert findings.passed
    assert len(findings.data["verdicts"]) == len(stress.CASES)


def test_a_wrong_fast_path_is_found(monkeypatch):
    right = FastPosing.forward
    monkeypatch.setattr(FastPosing, "forward", lambda *a: right(*a) + 1e-9)
    assert stress.try_case(stress.CASES[0], HEAD).complaint == "the paths differ"


def test_gradients_that_are_not_finite_are_found(monkeypatch):
    def careless(axis_angle):
        """The right matrices; the root of the squared angle has no finite gradient at zero."""
        return axis_angle_to_matrix(axis_angle) + 0 * axis_angle.square().sum(-1).sqrt()[..., None, None]

    monkeypatch.setattr("headbench.datasets.head.model.axis_angle_to_matrix", careless)
    assert stress.try_case(stress.CASES[0], HEAD).complaint == "not finite"
