"""Teeth: where they are, what moves them, the room they may not leave."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.methods.gbs.mouth import (
    Cylinder,
    mouth_room,
    padded_offset,
    rows_of_teeth,
    with_mouth,
)


def test_distances_to_the_cylinder_are_those_of_its_sides():
    room = Cylinder(torch.tensor([0.0, 1.0, 0.0]), 2.0, 3.0)
    inside = torch.tensor([[1.0, 0.5, -1.0], [0, 1, 0]])
    assert room.violation(inside) == 0
    sideways = torch.tensor([[3.0, 1.0, 4.0]])  # 5 from the axis
    assert room.violation(sideways) == pytest.approx(9.0)
    upwards = torch.tensor([[0.0, 6.0, 0.0]])
    assert room.violation(upwards) == pytest.approx(4.0)
    both = torch.cat([sideways + torch.tensor([0, 5.0, 0]), inside])
    assert room.violation(both) == pytest.approx((9 + 4) / 3)
    on_axis = torch.zeros(1, 3, requires_grad=True)
    room.violation(on_axis).backward()
    assert torch.isfinite(on_axis.grad).all()


def test_teeth_at_rest_fit_their_room_and_not_much_else(head):
    mouth = with_mouth(head, ())
    teeth = torch.from_numpy(mouth.template[mouth.regions["teeth"]]).float()
    room = mouth_room(teeth.numpy())
    assert room.violation(teeth) == 0
    assert room.violation(teeth + torch.tensor([0, 0, room.radius])) > 0
    assert room.violation(teeth + torch.tensor([0, 2 * room.half_height, 0])) > 0


def test_teeth_hang_on_neck_and_jaw_and_know_no_expression(head):
    mouth = with_mouth(head, ())
    upper, lower = rows_of_teeth(mouth)
    assert len(upper) == len(lower) > 0
    for row, joint in ((upper, 1), (lower, 2)):
        corners = np.unique(mouth.faces[row])
        assert (mouth.skinning_weights[corners, joint] == 1).all()
        assert not mouth.expression_basis[corners].any()
    again = with_mouth(mouth, ())
    assert len(again.template) == len(mouth.template)


def test_a_head_without_lips_stays_without_teeth(head, caplog):
    bald = replace(head, regions={}, landmarks={})
    mouth = with_mouth(bald, ("blended_lower_teeth",))
    assert rows_of_teeth(mouth) == []
    assert len(mouth.template) == len(head.template)
    assert "no teeth" in caplog.text


def test_the_published_codes_departures(head):
    plain, odd = with_mouth(head, ()), with_mouth(head, ("blended_lower_teeth", "triple_correctives"))
    lower = odd.regions["teeth_lower"]
    np.testing.assert_allclose(odd.skinning_weights[lower[0]], [0.0131, 0.0426, 0.9443, 0, 0])
    np.testing.assert_allclose(odd.skinning_weights.sum(1), 1, atol=1e-3)
    others = np.setdiff1d(np.arange(len(odd.template)), lower)
    np.testing.assert_array_equal(odd.skinning_weights[others], plain.skinning_weights[others])
    np.testing.assert_allclose(odd.pose_basis, 3 * plain.pose_basis)


def test_offsets_are_zero_for_added_teeth():
    offset = np.ones((4, 3), np.float32)
    padded = padded_offset(offset, 6)
    assert padded.dtype == np.float32
    np.testing.assert_array_equal(padded, [[1, 1, 1]] * 4 + [[0, 0, 0]] * 2)
