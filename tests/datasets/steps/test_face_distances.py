"""Face distances and farthest-point landmarks against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.steps.clusters import expression_displacements, farthest_meshes, mean_vertex_distances
from headbench.methods.shared.threads import torch_threads

from .clips import make_clip, with_poses


def random_meshes(count, vertices=7, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3, vertices)).astype(np.float32)


def brute_force(one, other):
    return np.linalg.norm(one[:, None].astype(float) - other[None].astype(float), axis=2).mean(axis=2)


def test_displacements_are_of_the_unposed_face_with_eyes_doubled():
    clip = make_clip(3)
    found = expression_displacements(clip, [0, 1, 2])
    subject = PosedSubject.of(clip)
    face, eyes = clip.head.regions["face"], set(clip.head.regions["eye_region"].tolist())
    assert 0 < len(eyes & set(face.tolist())) < len(face)
    still = with_poses(clip, **dict.fromkeys(("rotation", "neck", "translation"), lambda t: np.zeros(3)))
    moved = subject.meshes([still.poses[t] for t in range(3)]) - subject.neutral
    for column, vertex in enumerate(face):
        weight = 2 if int(vertex) in eyes else 1
        np.testing.assert_allclose(found[:, :, column], weight * moved[:, vertex], atol=2e-7)


def test_rigid_motion_does_not_matter():
    clip = make_clip(5)
    moved = with_poses(
        clip, rotation=lambda t: np.ones(3), neck=lambda t: np.ones(3), translation=lambda t: np.ones(3)
    )
    np.testing.assert_array_equal(
        expression_displacements(moved, [0, 3]), expression_displacements(clip, [0, 3])
    )


@pytest.mark.parametrize("count", [1, 5, 16, 17, 130])
@pytest.mark.parametrize("threads", [1, 3])
def test_distances_equal_brute_force_across_blocks(count, threads):
    meshes = random_meshes(count)
    with torch_threads(threads):
        found = mean_vertex_distances(meshes)
        landmarks = farthest_meshes(meshes, count)
    np.testing.assert_allclose(found, brute_force(meshes, meshes), rtol=2e-6, atol=1e-7)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(
        landmarks.distances, brute_force(meshes, meshes[landmarks.indices]), rtol=2e-6, atol=1e-7
    )


def test_small_distances_keep_their_digits():
    """Neighbouring frames differ by micrometres, a millionth of a face's size."""
    mesh = random_meshes(1, 50) * np.float32(0.1)
    near = mesh + np.float32(1e-6) * np.array([1, 0, 0], np.float32)[:, None]
    expected = np.linalg.norm((near.astype(float) - mesh.astype(float))[0], axis=0).mean()
    np.testing.assert_allclose(mean_vertex_distances(np.vstack([mesh, near]))[0, 1], expected, rtol=1e-5)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), count=st.integers(1, 40), limit=st.integers(1, 45))
def test_landmarks_are_the_farthest_points_by_definition(seed, count, limit):
    meshes = random_meshes(count, seed=seed)
    distances = mean_vertex_distances(meshes)
    found = farthest_meshes(meshes, limit, seed=seed)
    chosen = [int(found.indices[0])]
    while len(chosen) < min(limit, count):
        chosen.append(int(distances[chosen].min(axis=0).argmax()))
    assert found.indices.tolist() == chosen
    assert found.radius == distances[chosen].min(axis=0).max()
    assert len(set(chosen)) == len(chosen)
    assert chosen[0] == np.random.default_rng(seed).integers(count)


def test_landmarks_stop_at_the_tolerance_and_at_distinct_meshes():
    meshes = random_meshes(6)[np.arange(60) % 6]
    assert len(farthest_meshes(meshes, 50).indices) == 6
    assert farthest_meshes(meshes, 50).radius == 0
    meshes = random_meshes(400, 1) * np.float32(0.01)
    few = farthest_meshes(meshes, 400, tolerance=0.2)
    assert len(few.indices) < 100
    assert few.radius <= 0.2 * few.distances.max()
    fewer = farthest_meshes(meshes, len(few.indices) - 1, tolerance=0.2)
    assert fewer.radius > 0.2 * fewer.distances.max()
