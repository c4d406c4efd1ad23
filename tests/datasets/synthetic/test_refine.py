import numpy as np
import pytest
from scipy.spatial import ConvexHull

from headbench.datasets.head.geometry import vertex_normals
from headbench.datasets.synthetic.likeness import refine


@pytest.fixture(scope="module")
def sphere():
    points = np.random.default_rng(0).standard_normal((150, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.copy()
    corner = points[faces]
    inward = (
        np.einsum(
            "ni,ni->n", np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), corner[:, 0]
        )
        < 0
    )
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


@pytest.fixture(scope="module")
def fine(sphere):
    points, faces = sphere
    # Finer on one side, so that all kinds of splits happen.
    return refine(points, faces, np.where(points[:, 0] > 0, 0.08, 0.3), rounds=5)


def test_closed_and_consistently_turned(sphere, fine):
    edges = np.concatenate([fine.faces[:, [0, 1]], fine.faces[:, [1, 2]], fine.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)
    assert all((b, a) in directed for a, b in directed)


def test_interpolation_is_exact_for_linear_functions_and_covers_the_same_area(sphere, fine):
    points, faces = sphere
    flat = fine.interpolate(points)
    np.testing.assert_allclose(fine.weights.sum(1), 1.0, atol=1e-12)
    assert fine.weights.min() >= 0
    function = np.array([0.3, -1.2, 0.7])
    np.testing.assert_allclose(fine.interpolate(points @ function), flat @ function, atol=1e-12)

    def area(v, f):
        return np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1).sum() / 2

    assert area(flat, fine.faces) == pytest.approx(area(points, faces), rel=1e-12)


def test_edges_are_as_short_as_wanted_and_only_where_wanted(sphere, fine):
    points, _ = sphere
    flat = fine.interpolate(points)
    wanted = fine.interpolate(np.where(points[:, 0] > 0, 0.08, 0.3))
    for pair in ([0, 1], [1, 2], [2, 0]):
        ends = fine.faces[:, pair]
        length = np.linalg.norm(flat[ends[:, 0]] - flat[ends[:, 1]], axis=1)
        assert (length <= wanted[ends].mean(1) + 1e-9).all()
    near, far = (flat[fine.faces].mean(1)[:, 0] * sign > 0.5 for sign in (1, -1))
    assert near.sum() > 5 * far.sum()


def test_phong_tessellation_keeps_tracked_vertices_and_rounds_towards_the_sphere(sphere, fine):
    points, _ = sphere
    rounded = fine.positions(points)
    corners = fine.weights.max(1) == 1.0
    np.testing.assert_allclose(rounded[corners], fine.interpolate(points)[corners], atol=1e-12)
    flat_error = np.abs(np.linalg.norm(fine.interpolate(points), axis=1) - 1).mean()
    assert np.abs(np.linalg.norm(rounded, axis=1) - 1).mean() < 0.55 * flat_error


def test_vertex_normals_point_outwards(sphere):
    points, faces = sphere
    assert np.einsum("ni,ni->n", vertex_normals(points, faces), points).min() > 0.9
