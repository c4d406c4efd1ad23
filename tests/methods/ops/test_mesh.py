"""Triangle frames against their definition in float64, and against what rigid motion must do."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.methods.ops.mesh import triangle_frames
from headbench.methods.ops.splats import to_world


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
