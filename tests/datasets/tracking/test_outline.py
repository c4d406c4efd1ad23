"""Outlines of masks and meshes against closed forms and the rasteriser, and the static offset between them."""

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.head.arrays import with_derived_regions
from headbench.datasets.head.geometry import vertex_normals
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.mesh_pictures import rasterize_mesh
from headbench.datasets.tracking.outline import MeshOutline, OutlinePoints, gaps, outline_of, static_offset
from headbench.datasets.tracking.rig import Occlusion, Views

SIZE = 256


@pytest.fixture(scope="module")
def head():
    return with_derived_regions(procedural_head("2023"))


@pytest.fixture(scope="module")
def camera(head):
    middle = np.asarray(head.template)[head.regions["face"]].mean(axis=0)
    K = np.array([[900.0, 0, SIZE / 2], [0, 900.0, SIZE / 2], [0, 0, 1]])
    motion = np.diag([1.0, -1, -1, 1])
    motion[:3, 3] = [0, 0, 1.0] - motion[:3, :3] @ middle
    return Camera("0", SIZE, SIZE, K, motion)


def test_the_outline_of_a_disk_is_a_circle():
    middle, radius = np.array([60.3, 50.8]), 30.0
    place = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(100) + 0.5), axis=2)
    distance = np.linalg.norm(place - middle, axis=2)
    mask = np.rint(255 * np.clip(radius + 0.5 - distance, 0, 1)).astype(np.uint8)
    mask[:10, :10] = 255  # a smaller part
    outline = outline_of(mask)
    away = outline.pixels - middle
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), radius, atol=0.1)
    assert (outline.normals * away / radius).sum(axis=1).min() > 0.99
    turned = np.array([[0.6, 0.8], [-0.8, 0.6]])
    found = gaps(outline, middle + 33.0 * turned, turned)
    np.testing.assert_allclose(found.distance, -3.0, atol=0.1)
    assert found.aligned.tolist() == [1, 1]
    assert gaps(outline, middle + 27.0 * turned, -turned).aligned.tolist() == [0, 0]


def test_both_sides_of_a_mask_cut_by_two_borders_count():
    mask = np.zeros((100, 120), np.uint8)
    for row in range(100):
        mask[row, 40 : 80 + row // 10] = 255  # the right side is longer
    mask[40:50, 55:65] = 0  # a hole
    mask[:, :5] = 255  # another part
    outline = outline_of(mask)
    left = outline.normals[:, 0] < 0
    np.testing.assert_allclose(outline.pixels[left, 0], 40, atol=0.01)
    assert outline.pixels[~left, 0].min() > 79
    for side in (left, ~left):
        assert np.ptp(outline.pixels[side, 1]) > 90


def test_an_empty_mask_has_no_outline():
    assert outline_of(np.zeros((20, 20), np.uint8)) is None
    assert outline_of(np.full((20, 20), 255, np.uint8)) is None


def test_points_of_the_mesh_are_on_the_outline_that_is_drawn(head, camera):
    mesh = np.asarray(head.template, np.float64)
    mask = np.where(rasterize_mesh(mesh, head.faces, camera).face >= 0, 255, 0).astype(np.uint8)
    views = Views([camera])
    (points,) = MeshOutline(head, scalp=True).points(Occlusion(head, mesh, views).surface(mesh))
    assert len(points.corners) > 100
    places = np.einsum("nk,nki->ni", points.weights, mesh[points.corners])
    normals = np.einsum("nk,nki->ni", points.weights, vertex_normals(mesh, head.faces)[points.corners])
    toward = camera.center - places
    seen_at = (
        (normals * toward).sum(axis=1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(toward, axis=1)
    )
    assert np.quantile(np.abs(seen_at), 0.9) < 0.02  # the surface is seen along its tangent
    outward = (normals @ camera.world_to_camera[:3, :3].T)[:, :2]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    found = gaps(outline_of(mask), views.place(places)[0][0], outward)
    assert found.aligned.mean() > 0.8
    assert np.median(np.abs(found.distance[found.aligned > 0])) < 0.6
    assert np.quantile(np.abs(found.distance[found.aligned > 0]), 0.9) < 2.0


def test_a_static_offset_follows_the_scalp_and_keeps_the_eyes(head, camera):
    mesh = np.asarray(head.template, np.float64)
    (points,) = MeshOutline(head, scalp=True).points(Occlusion(head, mesh, Views([camera])).surface(mesh))
    hair = np.isin(points.corners, head.regions["scalp"]).all(axis=1)
    frames = 64
    chosen = OutlinePoints(
        np.tile(points.corners[hair], (frames, 1)), np.tile(points.weights[hair], (frames, 1))
    )
    offset = static_offset(head, mesh, chosen, np.full(len(chosen.corners), 0.01))
    moved = (offset * vertex_normals(mesh, head.faces)).sum(axis=1)
    reached = np.einsum("nk,nk->n", chosen.weights, moved[chosen.corners])
    assert 0.008 < np.median(reached) < 0.0105
    assert not offset[head.regions["eye_region"]].any()
    assert moved.max() < 0.015
