"""Triangle frames against their definition in float64, and against what rigid motion must do."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.methods.shared.binding import apply_matrices, left_products, to_world, triangle_frames


def random_mesh(seed, faces=7):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(3 * faces, 3)), np.arange(3 * faces).reshape(faces, 3)


def defined_frame(corners):
    """The definition, a triangle at a time."""
    v0, v1, v2 = corners
    a0 = (v1 - v0) / np.linalg.norm(v1 - v0)
    a1 = np.cross(a0, v2 - v0)
    a1 /= np.linalg.norm(a1)
    a2 = np.cross(a1, a0)
    a2 = -a2 / np.linalg.norm(a2)
    size = 0.5 * (np.linalg.norm(v1 - v0) + abs(a2 @ (v2 - v0)))
    return np.column_stack([a0, a1, a2]), (v0 + v1 + v2) / 3, size


def frames_of(vertices, faces):
    return triangle_frames(torch.from_numpy(vertices), torch.from_numpy(faces))


def test_frames_follow_the_definition():
    vertices, faces = random_mesh(0)
    frames = frames_of(vertices, faces)
    for number, face in enumerate(faces):
        rotation, center, size = defined_frame(vertices[face])
        np.testing.assert_allclose(frames.rotation[number], rotation, atol=1e-12)
        np.testing.assert_allclose(frames.center[number], center, atol=1e-12)
        np.testing.assert_allclose(frames.size[number], size, rtol=1e-12)
        quaternion = frames.quaternion[number].numpy()[[1, 2, 3, 0]]
        np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), rotation, atol=1e-12)


def test_frames_are_right_handed_and_the_third_axis_points_away_from_the_third_vertex():
    vertices, faces = random_mesh(1)
    frames = frames_of(vertices, faces)
    np.testing.assert_allclose(torch.linalg.det(frames.rotation), 1, atol=1e-12)
    towards = torch.from_numpy(vertices[faces[:, 2]] - vertices[faces[:, 0]])
    assert ((frames.rotation[:, :, 2] * towards).sum(1) < 0).all()


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(-2, 2), min_size=3, max_size=3),
)
def test_a_rigid_motion_of_the_mesh_moves_splats_rigidly(seed, axis, shift):
    vertices, faces = random_mesh(seed, 4)
    turn = Rotation.from_rotvec(axis).as_matrix()
    rng = np.random.default_rng(seed + 1)
    binding = torch.tensor([0, 1, 2, 3, 3, 0])
    means, log_scales = (torch.from_numpy(rng.normal(size=(6, 3))) for _ in range(2))
    quats = torch.from_numpy(rng.normal(size=(6, 4)))
    still = to_world(frames_of(vertices, faces), binding, means, log_scales, quats)
    moved = to_world(frames_of(vertices @ turn.T + shift, faces), binding, means, log_scales, quats)
    np.testing.assert_allclose(moved.means, still.means.numpy() @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(moved.scales, still.scales, rtol=1e-9)
    before, after = (Rotation.from_quat(w.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix() for w in (still, moved))
    np.testing.assert_allclose(after, turn @ before, atol=1e-8)


def test_to_world_follows_the_equations():
    vertices, faces = random_mesh(3)
    frames = frames_of(vertices, faces)
    rng = np.random.default_rng(4)
    binding = np.array([6, 0, 0, 2])
    means, log_scales, quats = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=(4, 4))
    world = to_world(frames, *(torch.from_numpy(x) for x in (binding, means, log_scales, quats)))
    for row, face in enumerate(binding):
        rotation, center, size = defined_frame(vertices[faces[face]])
        np.testing.assert_allclose(world.means[row], size * rotation @ means[row] + center, atol=1e-12)
        np.testing.assert_allclose(world.scales[row], size * np.exp(log_scales[row]), rtol=1e-12)
        local = Rotation.from_quat(quats[row, [1, 2, 3, 0]]).as_matrix()
        found = Rotation.from_quat(world.quats[row].numpy()[[1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(found, rotation @ local, atol=1e-12)


def test_gradients_reach_vertices_and_local_parameters():
    vertices, faces = random_mesh(5, 2)
    rng = np.random.default_rng(6)
    inputs = [
        torch.from_numpy(x).requires_grad_()
        for x in (vertices, rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(3, 4)))
    ]
    binding, triangles = torch.tensor([0, 1, 1]), torch.from_numpy(faces)

    def world(vertices, means, log_scales, quats):
        return to_world(triangle_frames(vertices, triangles), binding, means, log_scales, quats)

    assert torch.autograd.gradcheck(world, inputs)


def test_a_degenerate_triangle_gives_finite_frames():
    vertices = torch.zeros(3, 3)
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    assert all(torch.isfinite(part).all() for part in frames)


def test_apply_matrices():
    rng = np.random.default_rng(7)
    matrices, vectors = rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3))
    found = apply_matrices(torch.from_numpy(matrices.reshape(5, 9)), torch.from_numpy(vectors))
    np.testing.assert_allclose(found, np.einsum("nij,nj->ni", matrices, vectors), atol=1e-12)


def test_left_products_are_hamilton_products():
    rng = np.random.default_rng(0)
    left, right = (rng.normal(size=(20, 4)) for _ in range(2))
    found = torch.bmm(left_products(torch.from_numpy(left)), torch.from_numpy(right)[:, :, None])[:, :, 0]
    length = np.linalg.norm(left, axis=1) * np.linalg.norm(right, axis=1)
    turns = [Rotation.from_quat(values[:, [1, 2, 3, 0]]) for values in (left, right)]
    expected = length[:, None] * (turns[0] * turns[1]).as_quat()[:, [3, 0, 1, 2]]
    sign = np.sign((found.numpy() * expected).sum(1, keepdims=True))
    np.testing.assert_allclose(found, sign * expected, atol=1e-12)
    unit = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    np.testing.assert_array_equal(left_products(unit)[0], np.eye(4))
