"""What the mesh says of splats before training: turning against finite differences of the mesh, and the mask."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.rotations import quaternion_to_matrix
from headbench.methods.gbs.differences import (
    consistency_mask,
    deformation_gradients,
    entries_of,
    initial_turns,
    nearest_rotation,
)

MILLIMETRE = 1e-3


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.3, 3.0))
def test_a_similarity_of_the_mesh_is_found_whole(seed, size):
    rng = np.random.default_rng(seed)
    corners = torch.from_numpy(rng.normal(size=(5, 3, 3)))
    turn = torch.from_numpy(Rotation.random(random_state=rng).as_matrix())
    moved = size * corners @ turn.T + torch.from_numpy(rng.normal(size=3))
    found = deformation_gradients(corners, moved)
    torch.testing.assert_close(found, (size * turn).expand(5, 3, 3), rtol=1e-6, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_triangles_go_where_their_gradient_says(seed):
    rng = np.random.default_rng(seed)
    rest, moved = (torch.from_numpy(rng.normal(size=(4, 3, 3))) for _ in range(2))
    found = deformation_gradients(rest, moved)
    inside = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    at, to = inside @ rest, inside @ moved
    expected = (found @ (at - rest[:, 0])[..., None])[..., 0] + moved[:, 0]
    torch.testing.assert_close(to, expected, rtol=1e-6, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_rotations_are_those_of_the_polar_decomposition(seed):
    rng = np.random.default_rng(seed)
    matrices = np.eye(3) + 0.4 * rng.normal(size=(6, 3, 3))
    matrices[np.linalg.det(matrices) < 0.05] = np.diag([1, 2, 3])
    found = nearest_rotation(torch.from_numpy(matrices), 20).numpy()
    for one, expected in zip(found, matrices):
        np.testing.assert_allclose(one, scipy.linalg.polar(expected)[0], atol=1e-6)


def test_matrices_that_are_no_rotations_stay_finite():
    wild = torch.stack(
        [torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 1.0, 0.0])), torch.full((3, 3), 1e6)]
    )
    assert torch.isfinite(nearest_rotation(wild, 3)).all()


def frame(corners):
    """Two edges of a triangle, and its normal as long as the root of their cross product."""
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    return np.column_stack([b - a, c - a, normal / np.sqrt(np.linalg.norm(normal))])


def test_turns_are_those_of_the_mesh_that_the_head_model_makes(head):
    """Against the polar factor of the change of edges and normal between two meshes of `HeadModel`."""
    model = HeadModel(head, dtype=torch.float64)
    zero, six = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 6, dtype=torch.float64)
    still = {"rotation": zero, "neck": zero, "jaw": zero, "eyes": six, "translation": zero}
    size = model.expression_size

    def mesh(expression):
        shape = torch.zeros(1, model.shape_size, dtype=torch.float64)
        return model(shape=shape, expression=expression[None], **still)[0].numpy()

    neutral = mesh(torch.zeros(size, dtype=torch.float64))
    basis = torch.from_numpy(np.asarray(head.expression_basis, np.float64))
    turns = initial_turns(torch.from_numpy(neutral), basis, model.faces).numpy()
    rng = np.random.default_rng(0)
    for k in range(size):
        moved = mesh(torch.eye(size, dtype=torch.float64)[k])
        for face in rng.choice(len(head.faces), 20, replace=False):
            corners = head.faces[face]
            gradient = frame(moved[corners]) @ np.linalg.inv(frame(neutral[corners]))
            expected = scipy.linalg.polar(gradient)[0]
            quaternion = turns[face, :, k] + np.array([1.0, 0, 0, 0])
            np.testing.assert_allclose(
                quaternion_to_matrix(torch.from_numpy(quaternion)), expected, atol=1e-7
            )
    assert np.abs(turns).max() > 0.01


def with_expressions(head, *fields):
    return replace(head, expression_basis=np.stack(fields, axis=2), regions={"neck": head.regions["neck"]})


def test_the_mask_is_the_papers_function_of_how_far_a_triangle_moves(head):
    """Whole-head shifts of known length; nothing is held in place in a head without a scalp."""
    up = np.zeros_like(head.template)
    up[:, 1] = MILLIMETRE
    shifted = with_expressions(head, 0.01 * up, 0.1 * up, 2.1 * up, 10.1 * up)
    found = consistency_mask(shifted, head.template, 4, 0.1 * MILLIMETRE, 2.1 * MILLIMETRE)
    neck = np.isin(head.faces, head.regions["neck"])
    whole, none = ~neck.any(1), neck.all(1)
    assert whole.any()
    assert none.any()
    np.testing.assert_allclose(found[whole], np.tile([0, 0, 1, 5], (whole.sum(), 1)), atol=1e-12)
    assert (found[none] == 0).all()


def test_a_rigid_motion_in_an_expression_is_none_of_its_own(head):
    turn = Rotation.from_rotvec([0.05, 0.02, -0.03]).as_matrix()
    rigid = head.template @ turn.T + [0.001, 0.002, 0.0] - head.template
    moving = replace(head, expression_basis=rigid[:, :, None])
    found = consistency_mask(moving, head.template, 1, 0.02 * MILLIMETRE, 5 * MILLIMETRE)
    neck = np.isin(head.faces, head.regions["neck"]).any(1)
    assert found[~neck].max() == 0
    apart = replace(moving, regions={"neck": head.regions["neck"]})
    assert consistency_mask(apart, head.template, 1, 0.02 * MILLIMETRE, 5 * MILLIMETRE).max() > 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_entries_are_the_mask_without_its_zeros(seed):
    rng = np.random.default_rng(seed)
    mask = np.maximum(0, rng.normal(size=(6, 5)))
    triangles = rng.integers(0, 6, 9)
    counts, expressions, weights = entries_of(mask, triangles)
    dense = np.zeros((9, 5))
    dense[np.repeat(np.arange(9), counts), expressions] = weights
    np.testing.assert_array_equal(dense, mask[triangles])
    assert (weights > 0).all()


@pytest.mark.parametrize("size", [1e-9, 1e-12])
def test_a_triangle_of_no_size_has_a_finite_gradient_or_none_is_made(size):
    rest = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64) * size
    found = deformation_gradients(rest, rest)
    torch.testing.assert_close(found, torch.eye(3, dtype=torch.float64)[None], rtol=1e-3, atol=1e-3)


def test_a_triangle_without_area_is_not_turned():
    rest = torch.zeros(3, 3, 3, dtype=torch.float64)
    rest[2] = torch.eye(3)
    moved = rest + torch.randn(3, 3, 3, dtype=torch.float64)
    found = deformation_gradients(rest, moved)
    assert torch.equal(found[:2], torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert torch.isfinite(found).all()
