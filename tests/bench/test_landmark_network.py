"""Landmarks by a network: what is refused, and the crops around faces."""

import sys

import numpy as np
import pytest

from headbench.bench import landmark_network as network
from headbench.bench.errors import UnavailableError


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    (tmp_path / "face_landmark.tflite").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(UnavailableError, match="ai-edge-litert"):
        network.LandmarkNetwork(tmp_path / "face_landmark.tflite")


class Face:
    """Stands in for the network: a face at a fixed place, seen in crops that hold it."""

    def __init__(self, points):
        self.points = points

    def run(self, image, crop):
        away = np.linalg.norm(self.points.mean(axis=0) - crop.middle)
        return self.points, 1.0 if away < crop.side / 4 else -1.0


@pytest.fixture
def face():
    points = np.array([150.0, 120.0]) + np.random.default_rng(0).uniform(-40, 40, (network.COUNT, 2))
    points[network.CORNERS[0]], points[network.CORNERS[1]] = (130, 110), (170, 130)
    return points


def test_a_face_is_found_without_a_start(face, monkeypatch):
    finder = object.__new__(network.LandmarkNetwork)
    monkeypatch.setattr(finder, "_run", Face(face).run, raising=False)
    image = np.zeros((240, 300, 3), np.uint8)
    np.testing.assert_array_equal(finder.find(image), face)
    np.testing.assert_array_equal(finder.find(image, near=face + 5), face)
    crop = network.FaceCrop(face.mean(axis=0) + 9, 120.0, 0.0)
    np.testing.assert_array_equal(finder.find_in(image, crop), face)
    monkeypatch.setattr(finder, "_run", Face(face + 1000).run, raising=False)
    assert finder.find(image) is finder.find_in(image, crop) is None


def test_the_crop_is_level_and_around_the_face(face):
    crop = network._crop_around(face)
    assert crop.angle == pytest.approx(np.arctan2(20, 40))
    turn = np.array([[np.cos(crop.angle), -np.sin(crop.angle)], [np.sin(crop.angle), np.cos(crop.angle)]])
    inside = (face - crop.middle) @ turn
    assert np.abs(inside).max() == pytest.approx(crop.side / network.CROP / 2)
