"""AKD: average distance of facial landmarks between a render and the ground truth.

Papers use at least three kinds of landmarks (98 by PIPNet, 478 by MediaPipe, 68 by dlib), so the metric's name states which.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.specs import MetricSpec, Need
from .faces import AtLandmarks, DlibLandmarks, FaceMetric, dlib_needs, named_file, network_need

if TYPE_CHECKING:
    from ..bench.landmark_network import LandmarkNetwork
    from .pipnet import PipNet

VARIABLE = "HEADBENCH_FACE_LANDMARKS"
REMEDY = (
    f"Set {VARIABLE} to the file mediapipe/modules/face_landmark/face_landmark.tflite of the package mediapipe 0.10.21 "
    "(Apache-2.0): pip download --no-deps mediapipe==0.10.21, and unpack the wheel. It is read by ai-edge-litert: "
    "pip install ai-edge-litert."
)
PIPNET_VARIABLE = "HEADBENCH_PIPNET"
PIPNET_REMEDY = (
    f"Set {PIPNET_VARIABLE} to the authors' weights of WFLW with ResNet-18, epoch59.pth of the experiment "
    "pip_32_16_60_r18_l2_l1_10_1_nb10, to which the page of the project PIPNet (jhb86253817 on GitHub, MIT licence) links, and put "
    "the project's file data/WFLW/meanface.txt beside it."
)


class _Akd(FaceMetric):
    """Mean distance between landmarks, pixels."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Mean distance over (N, 2) landmarks."""
        return float(np.linalg.norm(found - truth, axis=1).mean())


class AkdMediaPipe(_Akd):
    """AKD of 468 landmarks by MediaPipe, searched near the ground truth's landmarks first, then in the whole image."""

    @staticmethod
    def network() -> LandmarkNetwork:
        """Load the network from the file in the environment variable."""
        from ..bench.landmark_network import LandmarkNetwork

        return LandmarkNetwork(named_file("AKD", VARIABLE, REMEDY))


class AkdDlib(_Akd):
    """AKD of 68 landmarks by dlib, detected in each image independently."""

    network = DlibLandmarks


class AkdPipNet(_Akd):
    """AKD of 98 landmarks by PIPNet, detected in each image independently."""

    @staticmethod
    def network() -> AtLandmarks:
        """Load the network from the file in the environment variable; it is applied at dlib's landmarks."""
        return AtLandmarks(_pipnet)


def mediapipe_needs(config: object, device: str) -> Iterator[Need]:
    """The network's file, and the package that reads it."""
    yield network_need("landmark network, for AKD", VARIABLE, REMEDY, AkdMediaPipe.network)


def _pipnet() -> PipNet:
    from .pipnet import PipNet

    return PipNet(named_file("AKD", PIPNET_VARIABLE, PIPNET_REMEDY))


def pipnet_needs(config: object, device: str) -> Iterator[Need]:
    """The network's files, and dlib, which detects faces for it."""
    yield network_need("PIPNet's weights and mean face, for AKD", PIPNET_VARIABLE, PIPNET_REMEDY, _pipnet)
    yield from dlib_needs(config, device)


def _spec(name: str, count: int, network: str, implementation: str, needs: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label=f"AKD ({network})",
        unit="px",
        higher_is_better=False,
        digits=2,
        implementation=f"headbench.metrics.akd:{implementation}",
        summary=f"Mean distance of {count} {network} landmarks in pixels; frames in which no face is found are left out and counted.",
        needs=f"headbench.metrics.{needs}",
    )


AKD_MEDIAPIPE = _spec("akd-mediapipe", 468, "MediaPipe", "AkdMediaPipe", "akd:mediapipe_needs")
AKD_DLIB = _spec("akd-dlib", 68, "dlib", "AkdDlib", "faces:dlib_needs")
AKD_PIPNET = _spec("akd-pipnet", 98, "PIPNet", "AkdPipNet", "akd:pipnet_needs")
