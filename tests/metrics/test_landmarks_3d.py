"""insightface's 3D landmarks: a small network whose numbers have a closed form, in the crop of a known box."""

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.metrics.akd import AkdInsightFace, Landmarks3D

from .test_arcface import onnx

RNG = np.random.default_rng(1)
WEIGHTS = RNG.normal(0, 1e-3, (3, 3309)).astype(np.float32)
BIAS = RNG.uniform(-1, 1, 3309).astype(np.float32)


@pytest.fixture
def path(tmp_path):
    (tmp_path / "1k3d68.onnx").write_bytes(onnx(side=192, weights=WEIGHTS, bias=BIAS))
    return tmp_path / "1k3d68.onnx"


def landmarks(left, top, right, bottom):
    """68 landmarks with this bounding box."""
    return np.concatenate(
        [[(left, top), (right, bottom)], RNG.uniform((left, top), (right, bottom), (66, 2))]
    )


def test_points_lie_in_the_crop_about_the_whole_face(path):
    colours = np.array([200, 100, 30], np.uint8)
    image = np.broadcast_to(colours, (500, 400, 3)).copy()
    found = Landmarks3D(path)(image, landmarks(100, 180, 220, 280))
    # Brows at 180 and chin at 280: the face begins at 130, and its box of 120 x 150 is 1.5 times as large in the crop.
    side, middle = 1.5 * 150, np.array([160, 205])
    points = (colours @ WEIGHTS + BIAS).reshape(-1, 3)[-68:]
    np.testing.assert_allclose(found[:, :2], middle + points[:, :2] * side / 2, atol=1e-2)
    np.testing.assert_allclose(found[:, 2], points[:, 2] * side / 2, atol=1e-2)


def test_the_crop_is_that_of_the_box(path):
    image = np.zeros((500, 400, 3), np.uint8)
    inside = image.copy()
    inside[93:317, 48:272] = 255  # the crop but for its outermost pixels
    box = landmarks(100, 180, 220, 280)
    change = Landmarks3D(path)(inside, box) - Landmarks3D(path)(image, box)
    share = change / (255 * WEIGHTS.sum(axis=0).reshape(-1, 3)[-68:] * 1.5 * 150 / 2)
    np.testing.assert_allclose(share, (224 / 225) ** 2, atol=5e-3)


def test_depth_counts():
    first, second = RNG.normal(size=(2, 68, 3))
    expected = np.sqrt(np.square(first - second).sum(axis=1)).mean()
    assert AkdInsightFace().score(first, second) == pytest.approx(expected)


def test_the_file_of_another_network_is_refused(tmp_path):
    (tmp_path / "x.onnx").write_bytes(onnx())
    with pytest.raises(InputError, match="a picture of 192x192 pixels to 3309 numbers"):
        Landmarks3D(tmp_path / "x.onnx")
