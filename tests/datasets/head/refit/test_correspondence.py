"""Closest points against dense samples of every triangle, degenerate triangles included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.datasets.head.refit.identity import closest_points


def sampled(points, vertices, faces, steps=24):
    """Distances to the nearest of a fine grid of points on each triangle."""
    u, v = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
    inside = u + v <= steps
    weights = np.stack([steps - u[inside] - v[inside], u[inside], v[inside]], axis=1) / steps
    samples = np.einsum("sc,fci->fsi", weights, vertices[faces]).reshape(-1, 3)
    return np.linalg.norm(points[:, None] - samples, axis=2).min(axis=1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 40))
def test_nothing_on_the_surface_is_nearer(seed, count):
    rng = np.random.default_rng(seed)
    vertices, faces = rng.normal(size=(20, 3)), rng.integers(0, 20, size=(count, 3))  # many without area
    points = 2 * rng.normal(size=(15, 3))
    found = closest_points(points, vertices, faces)
    coarse = sampled(points, vertices, faces)
    longest = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max()
    assert (found.distance <= coarse + 1e-12).all()
    assert (found.distance >= coarse - longest / 24).all()
    assert (found.weights >= 0).all()
    np.testing.assert_allclose(found.weights.sum(axis=1), 1)
    places = np.einsum("nc,nci->ni", found.weights, vertices[faces[found.face]])
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), found.distance, atol=1e-12)


def test_a_small_triangle_near_by_beats_large_ones_with_nearer_centres():
    """More triangles than are tried at first, one long one whose centre is the farthest of all."""
    rng = np.random.default_rng(0)
    small = 1.0 + 0.3 * rng.normal(size=(60, 3, 3))
    long = np.array([[[0.0, 0, 0.1], [40, 0, 0.1], [40, 1, 0.1]]])
    vertices = np.concatenate([small, long]).reshape(-1, 3)
    found = closest_points(np.zeros((1, 3)), vertices, np.arange(len(vertices)).reshape(-1, 3))
    assert found.face[0] == 60
    assert found.distance[0] == pytest.approx(0.1)


def test_the_matrix_takes_vertices_to_the_closest_points():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    faces = np.array([[0, 1, 2]])
    found = closest_points(np.array([[0.2, 0.3, 1.0], [2.0, -1.0, 0.0]]), vertices, faces)
    matrix = found.matrix(faces, 4, np.array([0, 2]), 4)
    expected = np.array([[0.2, 0.3, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(matrix @ vertices, expected, atol=1e-15)
    np.testing.assert_allclose(found.distance, [1.0, np.sqrt(2)])
