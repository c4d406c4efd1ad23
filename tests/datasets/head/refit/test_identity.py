"""Identity, alignment and counterparts, over one topology and over two."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.refit.identity import (
    closest_points,
    fit_shape,
    fitted_vertices,
    match,
    rigid_alignment,
    same_topology,
)
from headbench.datasets.head.refit.settings import RefitSettings

from ..toy import toy_head
from .heads import subdivided

HEAD = procedural_head("2020")
SMALL = toy_head(32)
SETTINGS = RefitSettings()


@pytest.fixture(scope="module")
def shape():
    return np.random.default_rng(4).normal(size=HEAD.shape_basis.shape[2])


def test_the_neutral_face_gives_the_identity_back(shape):
    vertices, weights = fitted_vertices(HEAD, SETTINGS)
    neutral = HEAD.template.astype(float) + HEAD.shape_basis.astype(float) @ shape
    found = fit_shape(HEAD, vertices, weights, neutral[vertices], RefitSettings(prior_mm=1e-6))
    fitted = HEAD.template + HEAD.shape_basis @ found
    assert np.abs(fitted - neutral)[vertices].max() < 1e-6
    bounded = fit_shape(HEAD, vertices, weights, neutral[vertices], RefitSettings(coefficient_bound=0.5))
    assert np.abs(bounded).max() == 0.5


def test_weights_are_those_of_the_regions():
    settings = RefitSettings(eyeballs=0.3, lips=2.0, eye_region=4.0)
    vertices, weights = fitted_vertices(HEAD, settings)
    by_vertex = dict(zip(vertices.tolist(), weights.tolist()))
    plain = np.setdiff1d(HEAD.regions["face"], np.union1d(HEAD.regions["lips"], HEAD.regions["eye_region"]))
    lips = np.setdiff1d(
        np.intersect1d(HEAD.regions["face"], HEAD.regions["lips"]), HEAD.regions["eye_region"]
    )
    assert {by_vertex[v] for v in plain.tolist()} == {1.0}
    assert {by_vertex[v] for v in lips.tolist()} == {2.0}
    assert by_vertex[int(HEAD.regions["left_eyeball"][0])] == 0.3
    assert len(fitted_vertices(HEAD, RefitSettings(eyeballs=0.0))[0]) == len(HEAD.regions["face"])


def test_another_topology_in_another_place_is_matched():
    """The same surface cut finer, vertices in random order, turned and shifted: counterparts are the old vertices."""
    source = subdivided(SMALL)
    assert not same_topology(source, SMALL)
    shape = np.random.default_rng(4).normal(size=SMALL.shape_basis.shape[2])
    neutral = source.template + source.shape_basis @ shape
    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    moved = neutral @ turn.T + [0.02, -0.03, 0.01]
    matching = match(source, moved, SMALL, RefitSettings(prior_mm=0.001))
    assert len(matching.vertices) > 0.95 * len(fitted_vertices(SMALL, SETTINGS)[0])
    np.testing.assert_allclose(matching.counterparts.sum(axis=1), 1)
    wanted = SMALL.template + SMALL.shape_basis @ shape
    aligned = (matching.counterparts @ moved) @ matching.alignment[:3, :3].T + matching.alignment[:3, 3]
    # Identity and alignment may share a rigid part, and counterparts a slide along the surface.
    placed = aligned_surface(aligned, wanted[matching.vertices])
    assert np.linalg.norm(aligned - placed, axis=1).mean() < 0.5e-3
    fitted = (SMALL.template + SMALL.shape_basis @ matching.shape)[matching.vertices]
    assert np.linalg.norm(fitted - aligned, axis=1).mean() < 0.4e-3


def aligned_surface(points, other):
    """``other`` moved rigidly onto ``points``."""
    motion = rigid_alignment(other, points, np.ones(len(other)))
    return other @ motion[:3, :3].T + motion[:3, 3]


def test_heads_far_from_each_other_are_refused():
    head = toy_head(16)
    other = subdivided(head)
    squashed = other.template * [1.0, 1.0, 0.1]
    with pytest.raises(InputError, match="counterpart"):
        match(other, 3 * squashed, head, SETTINGS)


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


def test_a_near_small_triangle_beats_large_ones():
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
