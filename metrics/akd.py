"""AKD: average distance of facial landmarks between a render and the ground truth.

Papers compute it with three kinds of landmarks at least (98 by PIPNet, 478 by MediaPipe, 68 by dlib), so that the name says which.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.errors import HeadbenchError, UnavailableError
from ..bench.specs import MetricSpec, Need
from .faces import DlibLandmarks, FaceMetric

if TYPE_CHECKING:
    from ..bench.landmark_network import LandmarkNetwork

VARIABLE = "HEADBENCH_FACE_LANDMARKS"
REMEDY = (
    f"Set {VARIABLE} to the file mediapipe/modules/face_landmark/face_landmark.tflite of the package mediapipe 0.10.21 "
    "(Apache-2.0): pip download --no-deps mediapipe==0.10.21, and unpack the wheel. It is read by ai-edge-litert: "
    "pip install ai-edge-litert."
)


class _Akd(FaceMetric):
    """Mean distance of landmarks, pixels."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Mean over (N, 2) landmarks."""
        return float(np.linalg.norm(found - truth, axis=1).mean())


class AkdMediaPipe(_Akd):
    """AKD of 468 landmarks by MediaPipe; the image is searched around the landmarks of the ground truth first, then everywhere."""

    def network(self) -> LandmarkNetwork:
        """The network of the file that the variable names."""
        return _mediapipe()


class AkdDlib(_Akd):
    """AKD of 68 landmarks by dlib, each image searched by itself."""

    def network(self) -> DlibLandmarks:
        """dlib's landmarks."""
        return DlibLandmarks()


def _mediapipe() -> LandmarkNetwork:
    from ..bench.landmark_network import LandmarkNetwork

    path = os.environ.get(VARIABLE, "")
    if not path:
        raise UnavailableError("AKD needs a landmark network, whose file is not named.", REMEDY)
    return LandmarkNetwork(Path(path))


def mediapipe_needs(config: object, device: str) -> Iterator[Need]:
    """The file of the network, and what reads it."""
    try:
        _mediapipe()
    except HeadbenchError:
        yield Need("landmark network, for AKD", "", REMEDY, required=False)
    else:
        yield Need("landmark network, for AKD", os.environ[VARIABLE], REMEDY, required=False)


def _spec(name: str, landmarks: str, implementation: str, needs: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label="AKD",
        unit="px",
        higher_is_better=False,
        digits=2,
        implementation=f"headbench.metrics.akd:{implementation}",
        summary=f"Mean distance of {landmarks} landmarks in pixels; frames in which no face is found are left out and counted.",
        needs=f"headbench.metrics.{needs}",
    )


AKD_MEDIAPIPE = _spec("akd-mediapipe", "468 MediaPipe", "AkdMediaPipe", "akd:mediapipe_needs")
AKD_DLIB = _spec("akd-dlib", "68 dlib", "AkdDlib", "faces:dlib_needs")
