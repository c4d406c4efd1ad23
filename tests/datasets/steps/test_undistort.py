"""Undistortion against the lens formulas written out, against pycolmap, and on images with a known content."""

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.datasets.steps.undistort import Lens, undistort_clip, undistort_image

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


def distorted(model, parameters, points):
    """(N, 2) pixels of the rays (x, y, 1): the formulas as published, one by one."""
    x, y = np.asarray(points, float).T
    r = np.hypot(x, y)
    if model.endswith("FISHEYE"):
        angle = np.arctan(r)
        count = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4}[model]
        k = [*parameters[-count:], 0, 0, 0]
        bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        x, y = x * scale, y * scale
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        k = [*parameters[3:], 0]
        scale = 1 + k[0] * r**2 + k[1] * r**4
        x, y = x * scale, y * scale
    elif model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = [*parameters[4:], 0, 0, 0, 0][:8]
        scale = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        x, y = (
            x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    two = model in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
    fx, fy, cx, cy = parameters[:4] if two else (parameters[0], *parameters[:3])
    return np.column_stack([fx * x + cx, fy * y + cy])


def rays(lens):
    """(H W, 2) rays through the pixel centres of the pinhole image."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    K = lens.K
    return np.column_stack([((x - K[0, 2]) / K[0, 0]).ravel(), ((y - K[1, 2]) / K[1, 1]).ravel()])


@pytest.mark.parametrize("model", LENSES)
def test_places_are_those_of_the_formula_and_of_pycolmap(model):
    lens = Lens(model, LENSES[model], WIDTH, HEIGHT)
    found = lens.map_from(lens.K, WIDTH, HEIGHT).reshape(-1, 2)
    points = rays(lens)
    assert np.abs(found - distorted(model, LENSES[model], points)).max() < 1e-3
    other = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(LENSES[model]))
    projected = other.img_from_cam(np.column_stack([points, np.ones(len(points))]))
    assert np.abs(found - projected).max() < 1e-3


def blob_image(lens, centres, radius=2.5):
    """Gaussian blobs around distorted places of rays, dark on white."""
    places = distorted(lens.model, lens.parameters, centres)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    darkness = sum(np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * radius**2)) for px, py in places)
    return np.repeat((1 - 0.8 * darkness)[..., None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize("model", [name for name in LENSES if "PINHOLE" not in name])
def test_a_blob_is_found_where_the_pinhole_camera_projects_it(model):
    lens = Lens(model, LENSES[model], WIDTH, HEIGHT)
    pixels = np.array([[60.3, 71.8], [190.1, 250.4], [118.0, 163.0], [50.7, 280.2]])
    centres = (pixels - lens.K[:2, 2]) / [lens.K[0, 0], lens.K[1, 1]]
    straight = undistort_image(blob_image(lens, centres), lens.map_from(lens.K, WIDTH, HEIGHT), 1.0)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for px, py in pixels:
        near = np.hypot(x - px, y - py) < 9
        darkness = (1 - straight[..., 0].astype(float)) * near
        found = np.array([(darkness * x).sum(), (darkness * y).sum()]) / darkness.sum()
        # The blob itself is bent a little, which moves its centroid by a second-order amount.
        assert np.abs(found - (px, py)).max() < 0.05


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


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_any_moderate_lens_agrees_with_the_formula(k1, k2, p1, p2):
    lens = Lens("OPENCV", (400.0, 410.0, 60.5, 50.5, k1, k2, p1, p2), 120, 100)
    places = lens.map_from(lens.K, 120, 100)
    assert places[50, 60] == pytest.approx([60.5, 50.5], abs=1e-4)
    expected = distorted("OPENCV", lens.parameters, rays(lens)).reshape(100, 120, 2)
    assert np.abs(places - expected).max() < 1e-3


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
    ("model", "parameters", "match"),
    [
        ("THIN_PRISM_FISHEYE", (1.0,) * 12, "one of SIMPLE_PINHOLE"),
        ("RADIAL", (600.0, 1.0, 2.0), "5 finite numbers: f, cx, cy, k1, k2"),
        ("RADIAL", (600.0, 1.0, 2.0, np.nan, 0.0), "5 finite numbers"),
        ("PINHOLE", (600.0, 0.0, 2.0, 1.0), "positive focal"),
    ],
)
def test_no_lens(model, parameters, match):
    with pytest.raises(InputError, match=match):
        Lens(model, parameters, WIDTH, HEIGHT)


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


def test_lenses_that_do_not_fit_are_refused(clip):
    name = next(iter(clip.cameras))
    with pytest.raises(InputError, match="no such camera"):
        undistort_clip(clip, {"x": Lens("PINHOLE", LENSES["PINHOLE"], 48, 64)})
    with pytest.raises(InputError, match="expected 48x64, that of the images, found 240x320"):
        undistort_clip(clip, {name: Lens("RADIAL", LENSES["RADIAL"], WIDTH, HEIGHT)})
