"""The vocabulary of the sculptor against closed forms, and the stored head against a new sculpture."""

import numpy as np
import pymeshlab
import pytest
from hypothesis import given
from hypothesis import strategies as st

import headbench.datasets.head.procedural.sculpture as fields
from headbench.datasets.head.geometry import border_edges, mesh_edges
from headbench.datasets.head.procedural.sculpt import (
    SculptSettings,
    coarsen,
    main,
    mirrored,
    polygonise,
    vertex_areas,
)
from headbench.datasets.head.procedural.surface import load_sculpture

unit = st.floats(-1, 1, allow_nan=False)


def sphere(points):
    return np.linalg.norm(points, axis=1) - 0.05


@given(st.tuples(unit, unit, unit))
def test_round_ellipsoid_and_short_capsule_are_spheres(place):
    point = np.array([place])
    exact = np.linalg.norm(point - 0.3, axis=1) - 0.2
    np.testing.assert_allclose(fields.ellipsoid(point, (0.3,) * 3, (0.2,) * 3), exact, atol=1e-5)
    np.testing.assert_allclose(
        fields.capsule(point, (0.3,) * 3, (0.3, 0.3, 0.300001), 0.2, 0.2), exact, atol=1e-5
    )


@given(unit, unit, st.floats(0.01, 0.5))
def test_smooth_union_is_below_both_and_exact_far_away(a, b, blend):
    joined = fields.union(np.array([a]), np.array([b]), blend)[0]
    assert min(a, b) - blend / 4 - 1e-12 <= joined <= min(a, b) + 1e-12
    if abs(a - b) > blend:
        assert joined == min(a, b)


def test_rotation_is_a_rotation():
    turn = fields.rotation_xyz((20, -35, 70))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(fields.rotation_xyz((0, 0, 90)) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_narrow_band_marching_cubes_finds_the_whole_sphere():
    low, high = np.full(3, -0.0701), np.full(3, 0.07)
    vertices, faces = polygonise(sphere, low, high, 0.002)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, atol=1e-4)
    assert vertex_areas(vertices, faces).sum() == pytest.approx(4 * np.pi * 0.05**2, rel=0.01)
    assert len(border_edges(faces)) == 0
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=0.01)


def test_coarsening_keeps_border_fixed_points_and_edge_length():
    vertices, faces = polygonise(sphere, np.array([0.0, -0.0701, -0.0701]), np.full(3, 0.07), 0.002)
    border = (np.abs(vertices[:, 0]) < 1e-9).astype(int)
    fixed = np.array([np.argmax(vertices[:, 0]), np.argmax(np.where(border, vertices[:, 1], -1))])
    size = np.full(len(vertices), 0.010)
    coarse, triangles = coarsen(vertices, faces, size, fixed=fixed, border=border)
    np.testing.assert_array_equal(coarse[:2], vertices[fixed])
    rim = np.unique(border_edges(triangles))
    np.testing.assert_allclose(coarse[rim, 0], 0, atol=1e-9)
    edges = np.unique(np.sort(mesh_edges(triangles), axis=1), axis=0)
    assert len(coarse) - len(edges) + len(triangles) == 1  # a disk
    length = np.linalg.norm(coarse[edges[:, 0]] - coarse[edges[:, 1]], axis=1)
    assert np.median(length) == pytest.approx(0.010, rel=0.2)
    whole, both, image = mirrored(coarse, triangles)
    assert len(border_edges(both)) == 0
    np.testing.assert_allclose(whole[image], whole * [-1, 1, 1], atol=1e-12)


@pytest.mark.slow
def test_sculpting_again_gives_the_stored_head(tmp_path):
    main(SculptSettings(out=tmp_path / "again.npz"))
    again, stored = load_sculpture(tmp_path / "again.npz"), load_sculpture()
    assert len(again.faces) == pytest.approx(len(stored.faces), rel=0.02)
    meshes = pymeshlab.MeshSet()
    for surface in (again, stored):
        meshes.add_mesh(pymeshlab.Mesh(surface.vertices, surface.faces))
    for one, other in ((0, 1), (1, 0)):
        found = meshes.get_hausdorff_distance(sampledmesh=one, targetmesh=other)
        assert found["max"] < 0.001
