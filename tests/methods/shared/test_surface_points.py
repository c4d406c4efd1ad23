"""Points on a surface: where they are, how far apart."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from headbench.bench.errors import InputError
from headbench.datasets.head.geometry import triangle_areas
from headbench.methods.shared.surface_points import RADIUS, poisson_disk, spacing, spread_points, texel_points

from ...datasets.head.toy import toy_head

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


def test_spacing_is_the_root_mean_square_of_three_neighbours():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]], float)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert spacing(np.zeros((4, 3)))[0] == pytest.approx(np.sqrt(1e-7))
    assert spacing(np.zeros((1, 3)))[0] == pytest.approx(np.sqrt(1e-7))


def square_chart(n):
    """A square of n x n cells in two triangles each, whose chart is the unit square, wound both ways."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, n + 1)], indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    one, two, three, four = (corner.ravel() for corner in corners)
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([one, four, three], 1)])
    return grid, faces


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("size", [16, 33])
def test_each_texel_of_a_chart_has_one_point(n, size):
    grid, faces = square_chart(n)
    found = texel_points(grid[faces], np.arange(len(faces)), size**2)
    texels = size * found.positions(grid, faces) - 0.5
    np.testing.assert_allclose(texels, texels.round(), atol=1e-4)
    assert len(np.unique(texels.round(), axis=0)) == len(texels) == size**2
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-12)
    assert found.barycentric.min() >= -1e-6


@pytest.mark.parametrize("count", [4_000, 16_000, 64_000])
def test_number_of_texels_is_area_times_squared_resolution(ball, count):
    vertices, faces = ball
    # Each half is nearly a disk of radius 0.3.
    flat = 0.5 + 0.3 * vertices[:, :2] / np.linalg.norm(vertices, axis=1, keepdims=True)
    lower = (vertices[faces][:, :, 2] > 0).all(1)
    area = triangle_areas(np.pad(flat, ((0, 0), (0, 1))), faces[lower]).sum()
    assert area == pytest.approx(np.pi * 0.3**2, rel=0.1)
    found = texel_points(flat[faces], np.flatnonzero(lower), count)
    resolution = round((count / area) ** 0.5)
    assert len(found.triangles) == pytest.approx(area * resolution**2, rel=0.02)
    assert len(found.triangles) == pytest.approx(count, rel=0.02)
    assert set(found.triangles) <= set(np.flatnonzero(lower))
    uv = (found.barycentric[:, :, None] * flat[faces[found.triangles]]).sum(1)
    np.testing.assert_allclose(resolution * uv % 1, 0.5, atol=1e-4)


def test_triangles_without_a_place_in_the_chart_have_no_point():
    grid, faces = square_chart(2)
    uv = grid[faces]
    uv[3] = 0
    found = texel_points(uv, np.arange(len(faces)), 400)
    assert set(found.triangles) == set(range(len(faces))) - {3}
    for nowhere in (np.zeros_like(uv), uv[:, [0, 0, 1]]):
        with pytest.raises(InputError, match="cover a part of the square"):
            texel_points(nowhere, np.arange(len(faces)), 400)


def test_a_head_without_a_chart_has_blue_noise():
    head = toy_head()
    vertices, everything = head.template, np.arange(len(head.faces))
    noise = poisson_disk(vertices, head.faces, everything, 500, 3)
    charted = replace(head, uv=np.random.default_rng(0).random((len(head.faces), 3, 2)))
    for points in (
        spread_points(head, vertices, 500, 3),
        spread_points(charted, vertices, 500, 3, chart=False),
    ):
        np.testing.assert_array_equal(points.triangles, noise.triangles)
        np.testing.assert_array_equal(points.barycentric, noise.barycentric)
    border = np.arange(40)
    found = spread_points(charted, vertices, 500, 3, chart_without=border)
    assert len(found.triangles)
    assert not np.isin(head.faces[found.triangles], border).any()
