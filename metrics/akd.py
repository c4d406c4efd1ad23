"""AKD: average distance of facial landmarks between a render and the ground truth.

Papers use at least four kinds of landmarks (98 by PIPNet, 478 by MediaPipe, 68 by dlib, 68 in 3D by insightface), so the metric's
name states which.

insightface's network is in an ONNX file. Crop and scale are those of the project.

Formats read:

- insightface's 3D landmarks (`1k3d68.onnx` of `buffalo_l.zip`). Written by deepinsight/insightface. Not checked on a file of the
  program.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.specs import MetricSpec, Need
from .faces import AtLandmarks, DlibLandmarks, FaceMetric, OnnxNetwork, dlib_needs, named_file, network_need

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


INSIGHTFACE_VARIABLE = "HEADBENCH_LANDMARKS_3D"
INSIGHTFACE_REMEDY = (
    f"Set {INSIGHTFACE_VARIABLE} to the file 1k3d68.onnx of the archive buffalo_l.zip, which the project insightface (deepinsight on "
    "GitHub) publishes with its releases; its weights are for research that is not commercial."
)
SIDE, POINTS, OUTPUTS = 192, 68, 3309
"""Of insightface's network: side of the input, landmarks, which are the last points of the output, and numbers of the output."""
MARGIN = 1.5
"""Side of the crop, relative to the longer side of the face's box."""


class Landmarks3D:
    """insightface's network of 68 landmarks in 3D, in an ONNX file."""

    def __init__(self, path: Path):
        self._network = OnnxNetwork(path, SIDE, OUTPUTS)

    def __call__(self, image: ByteArray, landmarks: FloatArray) -> FloatArray:
        """(68, 3) landmarks in pixels of an (H, W, 3) 8-bit RGB image; the depth has the same unit.

        The face is found by (68, 2) landmarks of 300-W, from brows to chin: two thirds of a face's height. insightface's detector
        finds the whole face, so the box is extended by the forehead.
        """
        left, top = landmarks.min(axis=0)
        right, bottom = landmarks.max(axis=0)
        top -= (bottom - top) / 2
        scale = SIDE / (MARGIN * max(right - left, bottom - top))
        shift = SIDE / 2 - scale * np.array([left + right, top + bottom]) / 2
        turn = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        points = self._network(image, turn).reshape(-1, 3)[-POINTS:] * SIDE / 2
        points[:, :2] += SIDE / 2 - shift
        return points / scale


class _Akd(FaceMetric):
    """Mean distance between landmarks, pixels."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Mean distance over (N, D) landmarks."""
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


class AkdInsightFace(_Akd):
    """AKD of 68 landmarks in 3D by insightface, detected in each image independently; depth counts, too."""

    @staticmethod
    def network() -> AtLandmarks:
        """Load the network from the file in the environment variable; it is applied at dlib's landmarks."""
        return AtLandmarks(_landmarks_3d)


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


def _landmarks_3d() -> Landmarks3D:
    return Landmarks3D(named_file("AKD", INSIGHTFACE_VARIABLE, INSIGHTFACE_REMEDY))


def insightface_needs(config: object, device: str) -> Iterator[Need]:
    """The network's file, and dlib, which detects faces for it."""
    what = "insightface's 3D landmarks, for AKD"
    yield network_need(what, INSIGHTFACE_VARIABLE, INSIGHTFACE_REMEDY, _landmarks_3d)
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
AKD_INSIGHTFACE = _spec("akd-insightface", 68, "insightface", "AkdInsightFace", "akd:insightface_needs")
