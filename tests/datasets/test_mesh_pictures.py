"""The mesh rasteriser against ray casting, and its pictures against closed forms."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from scipy.spatial import Delaunay

from headbench.bench.contracts import Camera
from headbench.datasets import mesh_pictures
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.mesh_pictures import draw_mesh, portrait_camera, rasterize_mesh

from .tiny_capture import in_camera, projected

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
CUBE_FACES = np.array([face for a, b, c, d in QUADS for face in ([a, b, c], [a, c, d])])


def camera(width=41, height=33, distance=5.0):
    intrinsics = np.array([[1.1 * width, 0.7, 0.47 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1.0]])
    extrinsics = np.diag([1.0, -1.0, -1.0, 1.0])
    extrinsics[2, 3] = distance
    return Camera("c", width, height, intrinsics, extrinsics)


def cast_rays(vertices, faces, view):
    """The definition: the nearest triangle that the ray through each pixel's centre meets, Cramer's rule."""
    points = in_camera(vertices, view)
    face = np.full((view.height, view.width), -1)
    depth = np.full((view.height, view.width), np.inf)
    weights = np.zeros((view.height, view.width, 3))
    for row in range(view.height):
        for column in range(view.width):
            ray = np.linalg.solve(view.K, [column + 0.5, row + 0.5, 1.0])
            for index, corners in enumerate(points[faces]):
                try:
                    share = np.linalg.solve(corners.T, ray)
                except np.linalg.LinAlgError:
                    continue
                z = 1 / share.sum() if share.sum() > 0 else np.inf
                if (share >= 0).all() and z < depth[row, column]:
                    face[row, column], depth[row, column] = index, z
                    weights[row, column] = share * z
    return face, depth, weights


@pytest.mark.parametrize("seed", range(2))
def test_fragments_equal_cast_rays(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1, 1, size=(24, 3))
    faces = rng.permutation(24).reshape(8, 3)  # triangles that cross each other
    view = camera(distance=2.3)
    found = rasterize_mesh(vertices, faces, view)
    face, depth, weights = cast_rays(vertices, faces, view)
    assert 0.2 < (face >= 0).mean() < 0.95
    np.testing.assert_array_equal(found.face, face)
    np.testing.assert_allclose(found.depth, depth, rtol=1e-6)
    np.testing.assert_allclose(found.weights, weights, atol=1e-5)


def test_triangles_drawn_in_parts_give_the_same(monkeypatch):
    head, view = procedural_head(), camera(200, 150, distance=0.5)
    whole = rasterize_mesh(head.template, head.faces, view)
    assert (whole.face >= 0).mean() > 0.2
    monkeypatch.setattr(mesh_pictures, "_AT_ONCE", 1000)
    for one, other in zip(whole, rasterize_mesh(head.template, head.faces, view)):
        np.testing.assert_array_equal(one, other)


def test_shared_edges_leave_no_hole_and_no_overlap():
    """Every pixel of a finely triangulated square is covered, and by one triangle only."""
    rng = np.random.default_rng(0)
    plane = np.vstack([rng.uniform(-2, 2, size=(400, 2)), [[-3, -3], [-3, 3], [3, -3], [3, 3]]])
    faces = Delaunay(plane).simplices
    vertices = np.column_stack([plane, np.zeros(len(plane))])
    view = camera(120, 90, distance=2.0)
    assert (rasterize_mesh(vertices, faces, view).face >= 0).all()
    covered = sum((rasterize_mesh(vertices, face[None], view).face >= 0).astype(int) for face in faces)
    np.testing.assert_array_equal(covered, 1)


def test_the_nearer_surface_alone_is_seen_and_none_from_behind():
    view = camera()
    found = rasterize_mesh(CUBE, CUBE_FACES, view)
    front = {i for i, face in enumerate(CUBE_FACES) if (CUBE[face][:, 2] == 1).all()}
    assert set(found.face[found.face >= 0].tolist()) == front
    np.testing.assert_allclose(found.depth[found.face >= 0], 4, rtol=1e-6)
    assert (rasterize_mesh(CUBE + [0, 0, 10], CUBE_FACES, view).face == -1).all()


def test_unshaded_colours_opacity_and_background():
    view = camera()
    colors = np.tile([0.2, 0.4, 0.8], (8, 1))
    picture = draw_mesh(CUBE, CUBE_FACES, view, colors, shading=0)
    inside = rasterize_mesh(CUBE, CUBE_FACES, view).face >= 0
    core = binary_erosion(inside)
    np.testing.assert_array_equal(picture[core], np.tile([51, 102, 204], (core.sum(), 1)))
    ground = np.random.default_rng(0).integers(0, 256, size=picture.shape, dtype=np.uint8)
    over = draw_mesh(CUBE, CUBE_FACES, view, colors, shading=0, background=ground, opacity=0.25)
    expected = 0.25 * np.array([51, 102, 204]) + 0.75 * ground[core]
    assert np.abs(over[core].astype(float) - expected).max() <= 0.51
    assert (picture[0, 0] == 255).all()
    np.testing.assert_array_equal(over[0, 0], ground[0, 0])


def test_edges_are_antialiased():
    """The share of an edge pixel that is covered shows in it: the picture's mean is the covered area."""
    view = camera(60, 60)
    colors = np.zeros((8, 3))
    picture = draw_mesh(CUBE, CUBE_FACES, view, colors, shading=0, supersampling=4) / 255
    corners = CUBE[CUBE[:, 2] == 1]
    pixels = (corners * [1, -1, 0] + [0, 0, 4]) @ view.K.T / 4
    a, b, c, _ = pixels[:, :2]
    area = abs(np.cross(np.append(b - a, 0), np.append(c - a, 0))[2])
    assert abs((1 - picture[..., 0]).sum() - area) < 0.01 * area
    assert ((picture > 0.01) & (picture < 0.99)).any()


@pytest.mark.parametrize("yaw", [-0.8, 0.0, 0.8])
def test_portrait_shows_the_whole_head_centred(yaw):
    head = procedural_head()
    vertices = head.template.astype(float)
    view = portrait_camera(vertices, 90, 130, yaw=yaw, pitch=0.2)
    pixels = projected(vertices, view)
    span = pixels.max(axis=0) - pixels.min(axis=0)
    np.testing.assert_allclose((pixels.max(axis=0) + pixels.min(axis=0)) / 2, [45, 65], atol=1e-9)
    assert np.isclose(max(span / [90, 130]), 0.92)
    np.testing.assert_allclose(np.linalg.det(view.world_to_camera[:3, :3]), 1)
    # Seen from its left, the tip of the nose is to the picture's left of the head's middle.
    nose = vertices[:, 2].argmax()
    assert np.sign(pixels[nose, 0] - 45) == -np.sign(yaw) or yaw == 0
    assert pixels[vertices[:, 1].argmax(), 1] < 65
