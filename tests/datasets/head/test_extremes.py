"""Every numerical extreme of the head model; faults are found."""

import pytest
import torch

from headbench.datasets.head.extremes import HEAD_EXTREMES, try_extreme
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.rotations import axis_angle_to_matrix

from .toy import toy_head

HEAD = toy_head(16, eyelids=True)


@pytest.mark.parametrize("case", HEAD_EXTREMES, ids=lambda case: case.name)
def test_extreme_of_the_head_model(case):
    assert try_extreme(case, HEAD)["verdict"] == "ok"


def test_rounding_that_is_too_coarse_is_found(monkeypatch):
    right = HeadModel.forward

    def coarse(model, **arguments):
        """Vertices in single precision to 1e-4."""
        vertices = right(model, **arguments)
        return vertices if vertices.dtype == torch.float64 else vertices * (1 + 1e-4)

    monkeypatch.setattr(HeadModel, "forward", coarse)
    assert try_extreme(HEAD_EXTREMES[0], HEAD)["verdict"] == "float32 error over 1e-06"


def test_gradients_that_are_not_finite_are_found(monkeypatch):
    def careless(axis_angle):
        """The right matrices; the root of the squared angle has no finite gradient at zero."""
        return axis_angle_to_matrix(axis_angle) + 0 * axis_angle.square().sum(-1).sqrt()[..., None, None]

    monkeypatch.setattr("headbench.datasets.head.model.axis_angle_to_matrix", careless)
    assert try_extreme(HEAD_EXTREMES[0], HEAD)["verdict"] == "not finite"
