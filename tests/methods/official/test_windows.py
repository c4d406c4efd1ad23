"""Windows centred on the principal point: nothing is lost around the image, and projections stay where they were."""

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.methods.official.ga.head_files import around, inside


def camera(cx, cy, width=550, height=802, focal=2050.0):
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn * np.sign(np.linalg.det(turn)), (0.01, 0.02, 1.0)
    return Camera("a", width, height, np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]]), motion)


def project(camera, points):
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = local @ camera.K.T
    return pixels[:, :2] / pixels[:, 2:]


def points_on(camera):
    """Points in the world behind a grid of the camera's pixels."""
    grid = np.stack(
        np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9)), -1
    ).reshape(-1, 2)
    rays = (grid - camera.K[:2, 2]) / camera.K[0, 0]
    local = np.column_stack([rays, np.ones(len(rays))]) - camera.world_to_camera[:3, 3]
    return grid, local @ camera.world_to_camera[:3, :3]


CENTERS = [(275.0, 401.0), (280.3, 398.1), (268.9, 410.65), (275.25, 400.75), (275.5, 401.5), (240.0, 460.0)]


@pytest.mark.parametrize(("cx", "cy"), CENTERS)
@pytest.mark.parametrize("window_of", [inside, around])
def test_projections_stay_where_they_were(cx, cy, window_of):
    original = camera(cx, cy)
    window = window_of(original)
    centre = np.array([window.camera.width, window.camera.height]) / 2
    assert np.array_equal(window.camera.K[:2, 2], centre)
    grid, points = points_on(original)
    moved = project(window.camera, points) + [window.left, window.top]
    assert np.abs(moved - grid).max() < 0.02
    assert np.allclose(window.camera.center, original.center)


@pytest.mark.parametrize(("cx", "cy"), CENTERS)
def test_windows_are_the_largest_inside_and_least_around(cx, cy):
    original = camera(cx, cy)
    image = np.random.default_rng(0).integers(0, 256, (802, 550, 3), dtype=np.uint8)
    small, large = inside(original), around(original)
    for size, name, center in ((550, "width", cx), (802, "height", cy)):
        off = round(abs(size - 2 * center))
        assert abs(getattr(small.camera, name) - (size - off)) <= 1
        assert abs(getattr(large.camera, name) - (size + off)) <= 1
    assert small.cut(image).shape[:2] == (small.camera.height, small.camera.width)
    padded = np.zeros((large.camera.height, large.camera.width, 3), np.uint8)
    padded[-large.top : 802 - large.top, -large.left : 550 - large.left] = image
    assert np.array_equal(large.uncut(padded, original), image)
