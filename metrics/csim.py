"""CSIM: cosine similarity of the identity that a network recognises in a render and in the ground truth.

Papers compute it by other networks, ArcFace above all, whose weights are not free to use, so that the name says which.
"""

from __future__ import annotations

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.specs import MetricSpec
from .faces import DlibIdentity, FaceMetric

CSIM_DLIB = MetricSpec(
    name="csim-dlib",
    label="CSIM",
    unit="",
    higher_is_better=True,
    digits=3,
    implementation="headbench.metrics.csim:CsimDlib",
    summary="Cosine similarity of dlib's face descriptors, at most 1; frames in which no face is found are left out and counted.",
    needs="headbench.metrics.faces:dlib_needs",
)


class CsimDlib(FaceMetric):
    """Cosine similarity of the 128 numbers by which dlib recognises people."""

    def network(self) -> DlibIdentity:
        """dlib's network."""
        return DlibIdentity()

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Cosine of the angle between two (N,) descriptors."""
        return float(found @ truth / (np.linalg.norm(found) * np.linalg.norm(truth)))
