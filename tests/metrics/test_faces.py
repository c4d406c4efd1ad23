"""Landmarks and descriptors by dlib, which is not a dependency: what it is called with, and what its absence gives; networks
in files of the user."""

import sys
import types

import numpy as np
import pytest

from headbench.bench.errors import InputError, LeftOutError, UnavailableError
from headbench.metrics import akd, coefficients, csim, faces
from headbench.metrics.akd import AkdDlib, AkdPipNet
from headbench.metrics.csim import CsimArcFace, CsimDlib


class Shape:
    """A face found: landmarks at the level of its picture's first pixel."""

    def __init__(self, level, count):
        self.level, self.count = level, count

    def parts(self):
        return [types.SimpleNamespace(x=self.level, y=2 * self.level)] * self.count


@pytest.fixture
def dlib(monkeypatch, tmp_path):
    """A stand-in: two faces in every picture that is not black, the second more certain; descriptors turn with the level."""
    calls = []

    class Detector:
        def run(self, image, upsampled, threshold):
            calls.append((upsampled, threshold))
            return (["first", "second"], [0.1, 0.7], [0, 0]) if image.any() else ([], [], [])

    class Predictor:
        def __init__(self, path):
            calls.append(path)
            self.count = 68 if "68" in path else 5

        def __call__(self, image, face):
            assert face == "second"
            return Shape(int(image[0, 0, 0]), self.count)

    class Identity:
        def __init__(self, path):
            calls.append(path)

        def compute_face_descriptor(self, image, shape):
            assert shape.count == 5
            angle = np.radians(shape.level)
            return [2 * np.cos(angle), 2 * np.sin(angle)]

    module = types.ModuleType("dlib")
    module.get_frontal_face_detector = Detector
    module.shape_predictor = Predictor
    module.face_recognition_model_v1 = Identity
    monkeypatch.setitem(sys.modules, "dlib", module)
    found = types.SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(faces, "find_spec", lambda name: found)
    return calls


def level(value):
    return np.full((40, 30, 3), value, np.uint8)


def test_akd_is_the_distance_of_landmarks_in_the_best_face(dlib, tmp_path):
    assert AkdDlib()(level(13), level(10)) == pytest.approx(np.hypot(3, 6))
    assert dlib == [str(tmp_path / "models/shape_predictor_68_face_landmarks.dat"), (1, 0.0), (1, 0.0)]


def test_csim_is_the_cosine_between_descriptors(dlib):
    metric = CsimDlib()
    assert metric(level(70), level(10)) == pytest.approx(np.cos(np.radians(60)))
    assert metric(level(10), level(10)) == pytest.approx(1.0)


@pytest.fixture
def networks(monkeypatch):
    """Stand-ins of networks at dlib's 68 landmarks, which return them, and the angle of the first."""
    monkeypatch.setattr(akd, "_pipnet", lambda: lambda image, landmarks: landmarks)
    monkeypatch.setattr(akd, "_landmarks_3d", lambda: lambda image, landmarks: landmarks)
    monkeypatch.setattr(coefficients, "_deep3d", lambda: lambda image, landmarks: landmarks[:67, 0])
    monkeypatch.setattr(
        csim,
        "_arcface",
        lambda: lambda image, landmarks: np.array([1.0, np.tan(np.radians(landmarks[0, 0]))]),
    )


def test_networks_of_files_are_shown_the_best_face(dlib, networks):
    assert AkdPipNet()(level(13), level(10)) == pytest.approx(np.hypot(3, 6))
    assert akd.AkdInsightFace()(level(13), level(10)) == pytest.approx(np.hypot(3, 6))
    assert coefficients.AedSum()(level(13), level(10)) == pytest.approx(64 * 3)
    assert CsimArcFace()(level(70), level(10)) == pytest.approx(np.cos(np.radians(60)))


@pytest.mark.parametrize("metric", [AkdDlib, CsimDlib, AkdPipNet, CsimArcFace, coefficients.Apd])
@pytest.mark.parametrize(("image", "truth", "name"), [(0, 9, "render"), (9, 0, "ground truth")])
def test_a_picture_without_a_face_is_left_out(dlib, networks, metric, image, truth, name):
    with pytest.raises(LeftOutError, match=f"no face is found in the {name}"):
        metric()(level(image), level(truth))


@pytest.mark.parametrize("missing", ["dlib", "face_recognition_models"])
def test_without_a_package_the_remedy_says_what_to_install(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, "dlib", None if missing == "dlib" else types.ModuleType("dlib"))
    monkeypatch.setattr(faces, "find_spec", lambda name: None if name == missing else object())
    with pytest.raises(
        UnavailableError, match=rf"package {missing} is not installed.*pip install -e '\.\[faces\]'"
    ):
        AkdDlib()(level(1), level(1))
    (need,) = faces.dlib_needs(None, "cpu")
    assert (need.found, need.required) == ("", False)


@pytest.mark.parametrize(
    ("metric", "variable", "needs", "remedy"),
    [
        (akd.AkdMediaPipe, akd.VARIABLE, akd.mediapipe_needs, "mediapipe 0.10.21"),
        (AkdPipNet, akd.PIPNET_VARIABLE, akd.pipnet_needs, "epoch59.pth.*meanface.txt"),
        (CsimArcFace, csim.VARIABLE, csim.arcface_needs, "w600k_r50.onnx.*not commercial"),
        (akd.AkdInsightFace, akd.INSIGHTFACE_VARIABLE, akd.insightface_needs, "1k3d68.onnx.*not commercial"),
        (
            coefficients.Aed,
            coefficients.VARIABLE,
            coefficients.needs,
            "epoch_20.pth.*similarity_Lm3D_all.mat",
        ),
    ],
)
def test_without_its_file_the_remedy_says_where_it_is(
    dlib, monkeypatch, tmp_path, metric, variable, needs, remedy
):
    monkeypatch.delenv(variable, raising=False)
    with pytest.raises(UnavailableError, match=f"is not named. Set {variable} to .*{remedy}"):
        metric()(level(1), level(1))
    need, *others = needs(None, "cpu")
    assert (need.found, need.required) == ("", False)
    assert all(other.found == "installed" for other in others)
    monkeypatch.setenv(variable, str(tmp_path / "none"))
    with pytest.raises(InputError, match=f"{variable}: expected a file, found .*none, not there. .*{remedy}"):
        metric()(level(1), level(1))
    assert next(iter(needs(None, "cpu"))).found == ""


def test_the_file_of_a_network_that_can_be_read_is_found(monkeypatch):
    monkeypatch.setenv("HEADBENCH_X", "there")
    assert faces.network_need("x", "HEADBENCH_X", "remedy", lambda: None).found == "there"
