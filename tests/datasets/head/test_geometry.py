"""Meshes and points against answers that are known, and against scipy's."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from headbench.datasets.head.geometry import (
    border_edges,
    even_weights,
    rigid_alignment,
    smoothstep,
    triangle_areas,
    unique_pairs,
    vertex_normals,
)


def points(count=20, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 40.0, 180.0])
def test_a_rigid_motion_is_found(degrees):
    turn = Rotation.from_rotvec(degrees * np.array([0.6, 0.0, 0.8]), degrees=True).as_matrix()
    shift = np.array([0.1, -2.0, 3.0])
    motion = rigid_alignment(points(), points() @ turn.T + shift)
    np.testing.assert_allclose(motion[:3, :3], turn, atol=1e-12)
    np.testing.assert_allclose(motion[:3, 3], shift, atol=1e-12)
    np.testing.assert_array_equal(motion[3], [0, 0, 0, 1])


def test_weights_equal_scipys():
    here, there = points(), points(seed=1)
    weights = np.random.default_rng(2).random(len(here))
    middle, there_middle = (np.average(x, axis=0, weights=weights) for x in (here, there))
    turn, _ = Rotation.align_vectors(there - there_middle, here - middle, weights=weights)
    motion = rigid_alignment(here, there, weights)
    np.testing.assert_allclose(motion[:3, :3], turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(motion[:3, :3] @ middle + motion[:3, 3], there_middle, atol=1e-12)


def test_a_mirror_image_is_met_by_a_rotation():
    motion = rigid_alignment(points(), points() * [-1, 1, 1])
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1)


def test_smoothstep():
    np.testing.assert_allclose(smoothstep(np.array([-1.0, 0, 0.25, 1, 2]), 0, 1), [0, 0, 0.15625, 1, 1])
    assert smoothstep(np.array([0.2]), 1.0, 0.0) == pytest.approx(1 - smoothstep(np.array([0.2]), 0.0, 1.0))


@pytest.mark.parametrize("count", [0, 1, 500])
@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_unique_pairs_are_those_of_numpy(count, kind):
    pairs = np.random.default_rng(count).integers(0, 20, (count, 2)).astype(kind)
    unique, inverse, counts = unique_pairs(pairs)
    expected, places, times = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(unique, expected)
    np.testing.assert_array_equal(inverse, places.ravel())
    np.testing.assert_array_equal(counts, times)


def test_normals_and_border_of_a_cap():
    """Of a convex hull normals point outwards; without the triangles below, the border is where it was cut."""
    sphere = points(150) / np.linalg.norm(points(150), axis=1, keepdims=True)
    hull = ConvexHull(sphere)
    faces = hull.simplices.copy()
    np.testing.assert_allclose(triangle_areas(sphere, faces).sum(), hull.area, rtol=1e-12)
    inward = np.linalg.det(sphere[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    assert np.einsum("ni,ni->n", vertex_normals(sphere, faces), sphere).min() > 0.9
    assert not len(border_edges(faces))
    below = sphere[faces, 2].max(axis=1) < 0
    cut = border_edges(faces[~below])
    assert set(map(tuple, cut)) == set(map(tuple, border_edges(faces[below])[:, ::-1]))
    assert not vertex_normals(sphere, faces[below])[sphere[:, 2].argmax()].any()


def test_even_weights_move_with_the_points():
    target = np.array([0.2, -0.1, 0.3])
    weights = even_weights(points(30), target)
    np.testing.assert_allclose(weights.sum(), 1)
    turn = Rotation.random(random_state=0)
    for moved, wanted in ((points(30), target), (3 * turn.apply(points(30)) + 1, 3 * turn.apply(target) + 1)):
        np.testing.assert_allclose(weights @ moved, wanted, atol=1e-13)
    with pytest.raises(ValueError, match="span"):
        even_weights(points(30) * [1, 1, 0], target)
