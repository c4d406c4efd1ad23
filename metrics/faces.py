"""Metrics that compare a network's output for the faces of a render and its ground truth; dlib's networks."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import HeadbenchError, InputError, LeftOutError, UnavailableError, install_extra
from ..bench.io.files import read_bytes, reading
from ..bench.specs import Need
from .psnr import check_pair

REMEDY = f"{install_extra('faces')} (Boost licence; networks CC0, but the 68 landmarks were trained on 300-W: no commercial use)."
ENLARGED = 1
"""Number of times that dlib's detector upsamples the image: 0 finds faces of at least 80 pixels, 1 of 40."""


class FaceNetwork(Protocol):
    """A network for images of faces."""

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """Output for an (H, W, 3) 8-bit image, or None if no face is found.

        ``near`` is the output for a similar image; a network may ignore it.
        """
        ...


class FaceMetric(ABC):
    """Compares a network's output for an image and its ground truth, (H, W, 3) 8-bit each.

    Raises `LeftOutError` if the network finds no face in one of them, and `UnavailableError` if the network is missing.
    """

    def __init__(self) -> None:
        self._local = threading.local()  # one network per thread

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Compute the metric."""
        check_pair(image, target)
        truth = self._find(target, "ground truth")
        return self.score(self._find(image, "render", truth), truth)

    @staticmethod
    @abstractmethod
    def network() -> FaceNetwork:
        """Create a network. Raises `UnavailableError`."""

    @abstractmethod
    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Value of the metric from the outputs for the image and the ground truth."""

    def _find(self, image: ByteArray, name: str, near: FloatArray | None = None) -> FloatArray:
        if not hasattr(self._local, "network"):
            self._local.network = self.network()
        found: FloatArray | None = self._local.network.find(image, near)
        if found is None:
            raise LeftOutError(f"no face is found in the {name}")
        return found


class _Dlib:
    """dlib's frontal face detector, with landmarks of the face of highest confidence."""

    def __init__(self, landmarks: str):
        self._dlib, self._folder = _dlib()
        self._detector = self._dlib.get_frontal_face_detector()
        self._landmarks = self._dlib.shape_predictor(str(self._folder / landmarks))

    def _shape(self, image: ByteArray) -> Any:
        image = np.ascontiguousarray(image)
        faces, scores, _ = self._detector.run(image, ENLARGED, 0.0)
        return self._landmarks(image, faces[int(np.argmax(scores))]) if faces else None


class DlibLandmarks(_Dlib):
    """The 68 landmarks of the 300-W benchmark. Raises `UnavailableError` without dlib or its networks."""

    def __init__(self) -> None:
        super().__init__("shape_predictor_68_face_landmarks.dat")

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """(68, 2) landmarks in whole pixels, as dlib returns them."""
        shape = self._shape(image)
        return None if shape is None else np.array([(point.x, point.y) for point in shape.parts()], float)


class DlibIdentity(_Dlib):
    """dlib's face embedding for identification. Raises as `DlibLandmarks`."""

    def __init__(self) -> None:
        super().__init__("shape_predictor_5_face_landmarks.dat")
        path = str(self._folder / "dlib_face_recognition_resnet_model_v1.dat")
        self._network = self._dlib.face_recognition_model_v1(path)

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """(128,) embedding."""
        shape = self._shape(image)
        if shape is None:
            return None
        return np.array(self._network.compute_face_descriptor(np.ascontiguousarray(image), shape))


class AtLandmarks:
    """A network applied at the landmarks of `DlibLandmarks`.

    The function ``network`` returns it: a function of an image and landmarks with the result of `FaceNetwork.find`. Errors of
    `DlibLandmarks` are raised before ``network`` reads a file, which would be repeated for each frame.
    """

    def __init__(self, network: Callable[[], Callable[[ByteArray, FloatArray], FloatArray | None]]) -> None:
        _dlib()
        self._network = network()
        self._landmarks = DlibLandmarks()

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """Output for the face of highest confidence."""
        landmarks = self._landmarks.find(image)
        return None if landmarks is None else self._network(image, landmarks)


class OnnxNetwork:
    """A network of an ONNX file that maps a square picture to numbers."""

    def __init__(self, path: Path, side: int, length: int, shift: float = 0.0, scale: float = 1.0):
        """Read the file; pixels p are given to the network as ``(p - shift) / scale``."""
        self._side, self._shift, self._scale = side, shift, scale
        expected = f"a network of ONNX that maps a picture of {side}x{side} pixels to {length} numbers"
        content = read_bytes(path, expected)
        with reading(path, expected):
            import cv2

            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
            found = self._run(np.zeros((side, side, 3), np.uint8))
        if found.shape != (1, length):
            raise InputError(path, "", expected, f"an output of shape {found.shape}")
        if not np.isfinite(found).all():
            raise InputError(path, "", expected, "numbers that are not finite")

    def __call__(self, image: ByteArray, turn: FloatArray) -> FloatArray:
        """Numbers of the crop of an (H, W, 3) 8-bit RGB image that its (2, 3) affine map to the network's pixels defines."""
        import cv2

        return self._run(np.asarray(cv2.warpAffine(image, turn, (self._side, self._side)), np.uint8))[0]

    def _run(self, crop: ByteArray) -> FloatArray:
        pixels = (crop.astype(np.float32) - self._shift) / self._scale
        self._network.setInput(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]))
        return np.array(self._network.forward(), float)


def named_file(metric: str, variable: str, remedy: str) -> Path:
    """Path of a metric's network file, from an environment variable.

    Raises `UnavailableError` if it is not set, and `InputError` if there is no such file.
    """
    path = os.environ.get(variable, "")
    if not path:
        raise UnavailableError(f"{metric} needs a network, whose file is not named.", remedy)
    if not os.path.isfile(path):  # False, too, for paths that cannot be accessed
        found = f"{path}, {'a folder' if os.path.isdir(path) else 'not there'}"
        raise InputError(f"environment variable {variable}", "", "a file", found, remedy)
    return Path(path)


def network_need(what: str, variable: str, remedy: str, network: Callable[[], object]) -> Need:
    """The network file of a metric; it is found if ``network``, which reads it, raises no `HeadbenchError`.

    If the file is set but cannot be read, the remedy is the error message.
    """
    try:
        network()
    except UnavailableError:
        return Need(what, "", remedy, required=False)
    except HeadbenchError as error:
        return Need(what, "", str(error), required=False)
    return Need(what, os.environ[variable], remedy, required=False)


def _dlib() -> tuple[Any, Path]:
    """The dlib package, and the folder of its networks.

    The package of the networks is not imported, since older versions import pkg_resources, which was removed.
    """
    found = find_spec("face_recognition_models")
    try:
        import dlib
    except ImportError as error:
        raise UnavailableError("The Python package dlib is not installed.", REMEDY) from error
    if found is None or not found.submodule_search_locations:
        raise UnavailableError("The Python package face_recognition_models is not installed.", REMEDY)
    return dlib, Path(found.submodule_search_locations[0]) / "models"


def dlib_needs(config: object, device: str) -> Iterator[Need]:
    """The packages dlib and face_recognition_models."""
    installed = all(find_spec(name) is not None for name in ("dlib", "face_recognition_models"))
    yield Need(
        "dlib and its networks, for AKD and CSIM", "installed" if installed else "", REMEDY, required=False
    )
