"""Points on a surface: where they are, how far apart."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from headbench.datasets.head.geometry import triangle_areas
from headbench.methods.shared.surface_points import RADIUS, poisson_disk, spacing

COUNT = 1500


@pytest.fixture(scope="module")
def ball():
    """Vertices and outward triangles of a sphere of 0.1 m."""
    index = np.arange(600) + 0.5
    polar, around = np.arccos(1 - 2 * index / 600), np.pi * (1 + 5**0.5) * index
    flat = np.stack([np.cos(around), np.sin(around)], axis=1) * np.sin(polar)[:, None]
    points = 0.1 * np.column_stack([flat, np.cos(polar)])
    return points, ConvexHull(points).simplices.astype(np.int64)


def test_samples_are_blue_noise_on_the_triangles_asked_for(ball):
    vertices, faces = ball
    upper = np.flatnonzero((vertices[faces][:, :, 2] > 0).all(1))
    found = poisson_disk(vertices, faces, upper, COUNT, 0)
    assert set(found.triangles) <= set(upper)
    assert len(found.triangles) == pytest.approx(COUNT, rel=0.05)
    assert found.barycentric.min() >= -1e-7
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-12)
    positions = found.positions(vertices, faces)
    area = triangle_areas(vertices, faces[upper]).sum()
    nearest = cKDTree(positions).query(positions, k=2)[0][:, 1]
    assert nearest.min() >= RADIUS * np.sqrt(area / COUNT) * 0.999
    # No hole: every point of the surface has a sample nearby; as candidates are few, a little beyond the disk's radius.
    corners = vertices[faces[upper]]
    assert cKDTree(positions).query(corners.mean(1))[0].max() <= 1.3 * RADIUS * np.sqrt(area / COUNT)


def test_equal_seeds_give_equal_points_and_others_others(ball):
    one, *same, other = (poisson_disk(*ball, np.arange(len(ball[1])), 2_000, seed) for seed in (0, 0, 0, 1))
    for again in same:
        np.testing.assert_array_equal(one.barycentric, again.barycentric)
    assert not np.array_equal(one.barycentric[:50], other.barycentric[:50])


def test_spacing_is_the_root_mean_square_of_three_neighbours():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]], float)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert spacing(np.zeros((4, 3)))[0] == pytest.approx(np.sqrt(1e-7))
    assert spacing(np.zeros((1, 3)))[0] == pytest.approx(np.sqrt(1e-7))
