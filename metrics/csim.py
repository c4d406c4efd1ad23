"""CSIM: cosine similarity of the identity embeddings of a render and the ground truth.

Papers use several networks, most of them ArcFace, whose weights are licensed for non-commercial research only. The name of the
metric states the network.

ArcFace's embedding is computed by a network in an ONNX file: Deng, Guo, Xue, Zafeiriou, "ArcFace: Additive Angular Margin Loss for
Deep Face Recognition", CVPR 2019. Crop and colours are those of the insightface project.

Formats read:

- ArcFace (`w600k_r50.onnx` of `buffalo_l.zip`). Written by deepinsight/insightface. Not checked on a file of the program.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.specs import MetricSpec, Need
from .faces import AtLandmarks, DlibIdentity, FaceMetric, OnnxNetwork, dlib_needs, named_file, network_need

SIDE = 112
"""Side of the network's input, pixels."""
PLACES = np.array(
    [[38.2946, 51.6963], [73.5318, 51.5014], [56.0252, 71.7366], [41.5493, 92.3655], [70.7299, 92.2041]]
)
"""Positions of the eyes, the tip of the nose and the corners of the mouth in the crop, pixels."""
LENGTH = 512


class ArcFace:
    """The network in an ONNX file."""

    def __init__(self, path: Path):
        self._network = OnnxNetwork(path, SIDE, LENGTH, 127.5, 127.5)

    def __call__(self, image: ByteArray, landmarks: FloatArray) -> FloatArray:
        """(512,) embedding of the face in an (H, W, 3) 8-bit RGB image with (68, 2) landmarks of 300-W, pixels."""
        return self._network(image, alignment(five_points(landmarks), PLACES))


def five_points(landmarks: FloatArray) -> FloatArray:
    """(5, 2) centres of the eyes, tip of the nose and corners of the mouth, from (68, 2) landmarks of 300-W."""
    eyes = landmarks[36:42].mean(axis=0), landmarks[42:48].mean(axis=0)
    return np.stack([*eyes, landmarks[30], landmarks[48], landmarks[54]])


def alignment(points: FloatArray, places: FloatArray) -> FloatArray:
    """(2, 3) similarity transform of (N, 2) points to ``places`` with the least sum of squared distances."""
    start, end = points @ (1, 1j), places @ (1, 1j)  # rotation and scale are one factor of complex numbers
    away = start - start.mean()
    factor = np.vdot(away, end) / np.vdot(away, away)
    shift = end.mean() - factor * start.mean()
    return np.array([[factor.real, -factor.imag, shift.real], [factor.imag, factor.real, shift.imag]])


VARIABLE = "HEADBENCH_ARCFACE"
REMEDY = (
    f"Set {VARIABLE} to the file w600k_r50.onnx of the archive buffalo_l.zip, which the project insightface (deepinsight on GitHub) "
    "publishes with its releases; its weights are for research that is not commercial."
)


class _Csim(FaceMetric):
    """Cosine similarity of descriptors."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Cosine of the angle between two (N,) descriptors."""
        return float(found @ truth / (np.linalg.norm(found) * np.linalg.norm(truth)))


class CsimDlib(_Csim):
    """Cosine similarity of dlib's 128-dimensional face embeddings."""

    network = DlibIdentity


class CsimArcFace(_Csim):
    """Cosine similarity of ArcFace's 512-dimensional embeddings."""

    @staticmethod
    def network() -> AtLandmarks:
        """Load the network from the file in the environment variable; it is applied at dlib's landmarks."""
        return AtLandmarks(_arcface)


def _arcface() -> ArcFace:
    return ArcFace(named_file("CSIM", VARIABLE, REMEDY))


def arcface_needs(config: object, device: str) -> Iterator[Need]:
    """The network's file, and dlib, which detects faces for it."""
    yield network_need("ArcFace's network, for CSIM", VARIABLE, REMEDY, _arcface)
    yield from dlib_needs(config, device)


def _spec(name: str, network: str, implementation: str, needs: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label=f"CSIM ({network})",
        unit="",
        higher_is_better=True,
        digits=3,
        implementation=f"headbench.metrics.csim:{implementation}",
        summary=f"Cosine similarity of the face descriptors of {network}, at most 1; frames in which no face is found are left out and counted.",
        needs=f"headbench.metrics.{needs}",
    )


CSIM_DLIB = _spec("csim-dlib", "dlib", "CsimDlib", "faces:dlib_needs")
CSIM_ARCFACE = _spec("csim-arcface", "ArcFace", "CsimArcFace", "csim:arcface_needs")
