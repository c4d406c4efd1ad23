"""Triangle frames against their definition in float64, and against what rigid motion must do."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.head.rotations import matrix_to_quaternion
from headbench.methods.ops.splats import chart_axes, to_world, triangle_frames


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


@settings(max_examples=15, deadline=None)
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


def test_axes_of_a_unit_triangle_with_its_own_chart():
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    axes = chart_axes(corners, corners[:, 1:, :2] - corners[:, :1, :2])
    torch.testing.assert_close(axes[0], torch.eye(3))


def test_axes_along_a_chart_follow_its_coordinates():
    """Tangent and bitangent are the directions in which one coordinate rises and the other stays; also of mirrored charts."""
    rng = np.random.default_rng(0)
    corners, uv = rng.normal(size=(20, 3, 3)), rng.normal(size=(20, 3, 2))
    found = chart_axes(torch.from_numpy(corners), torch.from_numpy(uv[:, 1:] - uv[:, :1])).numpy()
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    for axes, (v0, v1, v2), place in zip(found, corners, uv):
        across = np.cross(v1 - v0, v2 - v0)
        np.testing.assert_allclose(axes[:, 2], across / np.linalg.norm(across))
        # The affine map from the triangle's plane to the chart, of which the axes are the two columns of the inverse.
        plane = np.linalg.lstsq(np.stack([v1 - v0, v2 - v0, across]), np.eye(3), rcond=None)[0]
        gradients = plane[:, :2] @ (place[1:] - place[0])
        values = axes[:, :2].T @ gradients
        assert (np.diag(values) > 0).all()
        np.testing.assert_allclose(values - np.diag(np.diag(values)), 0, atol=1e-9)


def test_quaternions_of_other_matrices_are_the_programs():
    """The rule of the authors' program of RGBAvatar by the largest of diagonal and trace, a matrix at a time."""
    matrices = np.random.default_rng(0).normal(size=(50, 3, 3))
    for m, found in zip(matrices, matrix_to_quaternion(torch.from_numpy(matrices)).numpy()):
        choice = int(np.argmax([*np.diag(m), np.trace(m)]))
        q = np.zeros(4)
        if choice == 3:
            q[:] = 1 + np.trace(m), m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        else:
            i, j, k = choice, (choice + 1) % 3, (choice + 2) % 3
            q[0], q[i + 1] = m[k, j] - m[j, k], 1 - np.trace(m) + 2 * m[i, i]
            q[j + 1], q[k + 1] = m[j, i] + m[i, j], m[k, i] + m[i, k]
        np.testing.assert_allclose(found * np.sign(found @ q), q / np.linalg.norm(q), atol=1e-12)
