"""Rays against the projection of points on them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.contracts import Camera
from headbench.methods.insta.rays import box_corners, camera_rays, pixels_of_hull


def some_camera(seed, width=40, height=30):
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.05, -0.02, 1.0]
    K = np.array([[50.0, 0.4, 18.0], [0, 60.0, 17.0], [0, 0, 1]])
    return Camera("c", width, height, K, pose)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_points_on_a_ray_project_to_the_centre_of_its_pixel(seed):
    camera = some_camera(seed)
    rows, columns = np.divmod(np.arange(40 * 30), 40)
    rays = camera_rays(camera, columns, rows, 0.5)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    points = rays.origins.astype(np.float64) + 0.8 * rays.directions
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], np.stack([columns, rows], 1) + 0.5, atol=1e-3)
    assert (seen[:, 2] > 0).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_no_point_of_the_hull_projects_outside_its_pixels(seed):
    camera = some_camera(seed)
    rng = np.random.default_rng(seed)
    corners = box_corners(rng.normal(size=(10, 3)) * 0.1, 0.02)
    weights = rng.dirichlet(np.ones(8), 200)
    seen = (weights @ corners) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    left, top, right, bottom = pixels_of_hull(camera, corners)
    inside = ((pixels >= 0) & (pixels < [40, 30])).all(1)
    assert ((pixels >= [left, top]) & (pixels < [right, bottom])).all(1)[inside].all()


def test_a_hull_around_the_camera_takes_the_whole_image():
    camera = some_camera(1)
    assert pixels_of_hull(camera, box_corners(np.stack([camera.center] * 2), 0.1)) == (0, 0, 40, 30)


@pytest.mark.parametrize("padding", [0.0, 0.3])
def test_box_corners_are_those_of_the_grown_box(padding):
    points = np.array([[0.0, 1, 2], [3, -1, 5]])
    corners = box_corners(points, padding)
    assert corners.shape == (8, 3)
    np.testing.assert_allclose(corners.min(0), [-padding, -1 - padding, 2 - padding])
    np.testing.assert_allclose(corners.max(0), [3 + padding, 1 + padding, 5 + padding])
