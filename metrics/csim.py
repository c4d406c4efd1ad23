"""CSIM: cosine similarity of the identity embeddings of a render and the ground truth.

Papers use several networks, most of them ArcFace, whose weights are licensed for non-commercial research only. The name of the
metric states the network.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.specs import MetricSpec, Need
from .faces import AtLandmarks, DlibIdentity, FaceMetric, dlib_needs, named_file, network_need

if TYPE_CHECKING:
    from .arcface import ArcFace

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
    from .arcface import ArcFace

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
