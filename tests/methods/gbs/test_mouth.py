"""The mouth of GaussianBlendshapes: its teeth and their cylinder."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.methods.gbs.method import (
    MouthCylinder,
    mouth_cylinder,
    padded_offset,
    rows_of_teeth,
    with_mouth,
)
from headbench.methods.gbs.spec import GBSConfig


def test_distances_to_the_cylinder_are_those_of_its_sides():
    cylinder = MouthCylinder(torch.tensor([0.0, 1.0, 0.0]), 2.0, 3.0)
    inside = torch.tensor([[1.0, 0.5, -1.0], [0, 1, 0]])
    assert cylinder.violation(inside) == 0
    sideways = torch.tensor([[3.0, 1.0, 4.0]])  # 5 from the axis
    assert cylinder.violation(sideways) == pytest.approx(9.0)
    upwards = torch.tensor([[0.0, 6.0, 0.0]])
    assert cylinder.violation(upwards) == pytest.approx(4.0)
    both = torch.cat([sideways + torch.tensor([0, 5.0, 0]), inside])
    assert cylinder.violation(both) == pytest.approx((9 + 4) / 3)
    on_axis = torch.zeros(1, 3, requires_grad=True)
    cylinder.violation(on_axis).backward()
    assert torch.isfinite(on_axis.grad).all()


def test_teeth_at_rest_fit_their_cylinder(head):
    mouth = with_mouth(head, GBSConfig())
    teeth = torch.from_numpy(mouth.template[mouth.regions["teeth"]]).float()
    cylinder = mouth_cylinder(teeth.numpy())
    assert cylinder.violation(teeth) == 0
    assert cylinder.violation(teeth + torch.tensor([0, 0, cylinder.radius])) > 0
    assert cylinder.violation(teeth + torch.tensor([0, 2 * cylinder.half_height, 0])) > 0


def test_teeth_hang_on_neck_and_jaw_and_know_no_expression(head):
    mouth = with_mouth(head, GBSConfig())
    upper, lower = rows_of_teeth(mouth)
    assert len(upper) == len(lower) > 0
    for row, joint in ((upper, 1), (lower, 2)):
        corners = np.unique(mouth.faces[row])
        assert (mouth.skinning_weights[corners, joint] == 1).all()
        assert not mouth.expression_basis[corners].any()
    again = with_mouth(mouth, GBSConfig())
    assert len(again.template) == len(mouth.template)
    offset = padded_offset(np.ones_like(head.template), len(mouth.template))
    assert (offset[: len(head.template)] == 1).all()
    assert not offset[len(head.template) :].any()


def test_a_head_without_lips_stays_without_teeth(head, caplog):
    bald = replace(head, regions={}, landmarks={})
    mouth = with_mouth(bald, GBSConfig(lower_teeth_variant="official"))
    assert rows_of_teeth(mouth) == []
    assert len(mouth.template) == len(head.template)
    assert "no teeth" in caplog.text


def test_the_official_variants_of_the_mouth(head):
    official = GBSConfig(correctives_variant="official", lower_teeth_variant="official")
    plain, odd = with_mouth(head, GBSConfig()), with_mouth(head, official)
    lower = odd.regions["teeth_lower"]
    np.testing.assert_allclose(odd.skinning_weights[lower[0]], [0.0131, 0.0426, 0.9443, 0, 0])
    np.testing.assert_allclose(odd.skinning_weights.sum(1), 1, atol=1e-3)
    others = np.setdiff1d(np.arange(len(odd.template)), lower)
    np.testing.assert_array_equal(odd.skinning_weights[others], plain.skinning_weights[others])
    np.testing.assert_allclose(odd.pose_basis, 3 * plain.pose_basis)
