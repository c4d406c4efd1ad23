"""Undistortion against pycolmap, and on images with a known content."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.datasets.colmap.model import Lens, undistort_clip, undistort_image

WIDTH, HEIGHT = 240, 320
LENSES = {
    "SIMPLE_PINHOLE": (600.0, 118.0, 163.0),
    "PINHOLE": (600.0, 590.0, 118.0, 163.0),
    "SIMPLE_RADIAL": (600.0, 118.0, 163.0, -0.15),
    "RADIAL": (600.0, 118.0, 163.0, -0.2, 0.15),
    "OPENCV": (600.0, 590.0, 118.0, 163.0, -0.2, 0.1, 0.003, -0.002),
    "FULL_OPENCV": (600.0, 590.0, 118.0, 163.0, -0.2, 0.1, 0.003, -0.002, 0.05, 0.02, 0.01, -0.01),
    "SIMPLE_RADIAL_FISHEYE": (400.0, 118.0, 163.0, 0.05),
    "RADIAL_FISHEYE": (400.0, 118.0, 163.0, 0.05, -0.02),
    "OPENCV_FISHEYE": (400.0, 390.0, 118.0, 163.0, 0.05, -0.02, 0.01, 0.003),
}


def rays(lens):
    """(H W, 2) rays through the pixel centres of the pinhole image."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    K = lens.K
    return np.column_stack([((x - K[0, 2]) / K[0, 0]).ravel(), ((y - K[1, 2]) / K[1, 1]).ravel()])


@pytest.mark.parametrize("model", LENSES)
def test_places_are_those_of_pycolmap(model):
    lens = Lens(model, LENSES[model], WIDTH, HEIGHT)
    found = lens.map_from(lens.K, WIDTH, HEIGHT).reshape(-1, 2)
    points = rays(lens)
    other = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(LENSES[model]))
    projected = other.img_from_cam(np.column_stack([points, np.ones(len(points))]))
    assert np.abs(found - projected).max() < 1e-3


def test_pycolmap_undistorts_an_image_alike():
    lens = Lens("OPENCV", LENSES["OPENCV"], WIDTH, HEIGHT)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = 0.5 + 0.2 * np.sin(x / 9)[..., None] * np.array([1, 0.5, 0.2]) + 0.2 * np.cos(y / 11)[..., None]
    levels = np.round(image * 255).astype(np.uint8)
    options = pycolmap.UndistortCameraOptions(blank_pixels=1.0, min_scale=1.0, max_scale=1.0)
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=list(LENSES["OPENCV"]))
    bitmap, pinhole = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(levels), camera)
    K = pinhole.calibration_matrix()
    recorded, places = (levels / 255).astype(np.float32), lens.map_from(K, pinhole.width, pinhole.height)
    ours = undistort_image(recorded, places, 1.0)
    theirs = bitmap.to_array() / 255
    assert theirs.shape == ours.shape
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(ours[inner] - theirs[inner]).max() < 0.02
    # A shift of half a pixel, the other convention, would be seen.
    shifted = undistort_image(recorded, places + np.float32(0.5), 1.0)
    assert np.abs(shifted[inner] - theirs[inner]).max() > 0.02


def test_what_folds_back_is_put_outside():
    """Under strong barrel distortion far rays return into the image; showing them would make ghosts."""
    lens = Lens("SIMPLE_RADIAL", (100.0, 120.0, 160.0, -0.3), WIDTH, HEIGHT)
    places = lens.map_from(lens.K, WIDTH, HEIGHT)
    radius = np.hypot(*(rays(lens).T)).reshape(HEIGHT, WIDTH)
    turning = (1 / (3 * 0.3)) ** 0.5  # where r (1 + k r^2) has its maximum
    assert (places[radius > turning + 0.03] < 0).all()
    assert (places[radius < turning - 0.03] > 0).all()
    image = undistort_image(np.zeros((HEIGHT, WIDTH, 3), np.float32), places, 1.0)
    assert (image[radius > turning + 0.05] == 1).all()


@pytest.mark.parametrize(
    ("model", "params", "width"),
    [
        ("THIN_PRISM_FISHEYE", (1.0,) * 12, WIDTH),
        ("RADIAL", (600.0, 1.0, 2.0), WIDTH),
        ("RADIAL", (600.0, 1.0, 2.0, np.nan, 0.0), WIDTH),
        ("PINHOLE", (600.0, 0.0, 2.0, 1.0), WIDTH),
        ("PINHOLE", (600.0, 600.0, 2.0, 1.0), 0),
    ],
)
def test_lenses_that_are_none_are_refused(model, params, width):
    with pytest.raises(InputError, match="cameras.txt, camera 1"):
        Lens(model, params, width, HEIGHT).check(Path("cameras.txt"), "camera 1")


# ------------------------------------------------------------------ clips


def lens_for(camera: Camera, *coefficients):
    K = camera.K
    return Lens("OPENCV", (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients), camera.width, camera.height)


def test_images_masks_and_cameras_of_a_clip(clip):
    name = next(iter(clip.cameras))
    assert undistort_clip(clip, {name: lens_for(clip.cameras[name], 0.0, 0.0, 0.0, 0.0)}) is clip
    lens = lens_for(clip.cameras[name], -0.9, 0.0, 0.0, 0.0)
    straight = undistort_clip(clip, {name: lens})
    places = lens.map_from(lens.K, 48, 64)
    for key in clip.splits["train"]:
        if key.camera != name:
            assert np.array_equal(straight.image(key), clip.image(key))
            continue
        expected = undistort_image(clip.image(key).astype(np.float32) / 255, places, 1.0)
        assert np.abs(straight.image(key) - 255 * expected).max() <= 0.5 + 1e-3
        assert not np.array_equal(straight.image(key), clip.image(key))
        assert straight.mask(key).shape == (64, 48)
    assert straight.cameras[name].K == pytest.approx(lens.K)
    assert straight.steps[-1].name == "undistort"
    assert straight.steps[-1].parameters["lenses"][name][0] == "OPENCV"
