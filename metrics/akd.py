"""AKD: average distance of facial landmarks between a render and the ground truth.

Papers compute it with three kinds of landmarks at least (98 by PIPNet, 478 by MediaPipe, 68 by dlib), so that the name says which.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import HeadbenchError, LeftOutError, UnavailableError
from ..bench.specs import MetricSpec, Need
from .pairs import check_pair

if TYPE_CHECKING:
    from ..bench.landmark_network import LandmarkNetwork

VARIABLE = "HEADBENCH_FACE_LANDMARKS"
REMEDY = (
    f"Set {VARIABLE} to the file mediapipe/modules/face_landmark/face_landmark.tflite of the package mediapipe 0.10.21 "
    "(Apache-2.0): pip download --no-deps mediapipe==0.10.21, and unpack the wheel. It is read by ai-edge-litert: "
    "pip install ai-edge-litert."
)

AKD = MetricSpec(
    name="akd-mediapipe",
    label="AKD",
    unit="px",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.akd:Akd",
    summary="Mean distance of 468 MediaPipe landmarks in pixels; frames in which no face is found are left out and counted.",
    needs="headbench.metrics.akd:needs",
)


class Akd:
    """Mean distance in pixels of landmarks found in an image and in its ground truth, (H, W, 3) 8-bit each.

    The image is searched around the landmarks of the ground truth first, then everywhere.

    Raises `LeftOutError` if one of them shows no face to the network, and `UnavailableError` without the network.
    """

    def __init__(self) -> None:
        self._local = threading.local()  # an interpreter serves one thread

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """See the class."""
        check_pair(image, target)
        first = self._find(target, "ground truth")
        second = self._find(image, "render", first)
        return float(np.linalg.norm(first - second, axis=1).mean())

    def _find(self, image: ByteArray, name: str, near: FloatArray | None = None) -> FloatArray:
        if not hasattr(self._local, "network"):
            self._local.network = _network()
        found: FloatArray | None = self._local.network.find(image, near)
        if found is None:
            raise LeftOutError(f"no face is found in the {name}")
        return found


def _network() -> LandmarkNetwork:
    from ..bench.landmark_network import LandmarkNetwork

    path = os.environ.get(VARIABLE, "")
    if not path:
        raise UnavailableError("AKD needs a landmark network, whose file is not named.", REMEDY)
    return LandmarkNetwork(Path(path))


def needs(config: object, device: str) -> Iterator[Need]:
    """The file of the network, and what reads it."""
    try:
        _network()
    except HeadbenchError:
        yield Need("landmark network, for AKD", "", REMEDY, required=False)
    else:
        yield Need("landmark network, for AKD", os.environ[VARIABLE], REMEDY, required=False)
