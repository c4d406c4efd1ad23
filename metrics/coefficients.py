"""AED and APD: distances of expression and head pose between a render and the ground truth, or the driving frame.

Both compare coefficients that Deep3DFaceRecon estimates in the two images. Papers print two definitions of AED under one name: the
mean of the 64 differences, and their sum.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.specs import MetricSpec, Need
from .faces import AtLandmarks, FaceMetric, dlib_needs, named_file, network_need

if TYPE_CHECKING:
    from .deep3d import Deep3D

VARIABLE = "HEADBENCH_DEEP3D"
EXPRESSIONS = 64
REMEDY = (
    f"Set {VARIABLE} to the weights epoch_20.pth to which the page of the project Deep3DFaceRecon_pytorch (sicxu on GitHub, MIT "
    "licence) links, and put the project's file BFM/similarity_Lm3D_all.mat beside it."
)


class _Coefficients(FaceMetric):
    """Compares coefficients of expression and rotation, detected in each image independently."""

    @staticmethod
    def network() -> AtLandmarks:
        """Load the network from the file in the environment variable; it is applied at dlib's landmarks."""
        return AtLandmarks(_deep3d)


class Aed(_Coefficients):
    """Mean absolute difference of the 64 coefficients of the expression."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Mean over expressions of (67,) coefficients."""
        return float(np.abs(found - truth)[:EXPRESSIONS].mean())


class AedSum(_Coefficients):
    """Sum of the absolute differences of the 64 coefficients of the expression, 64 times AED."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Sum over expressions of (67,) coefficients."""
        return float(np.abs(found - truth)[:EXPRESSIONS].sum())


class Apd(_Coefficients):
    """Mean absolute difference of the three angles of the head, radians."""

    def score(self, found: FloatArray, truth: FloatArray) -> float:
        """Mean over angles of (67,) coefficients."""
        return float(np.abs(found - truth)[EXPRESSIONS:].mean())


def _deep3d() -> Deep3D:
    return _loaded(named_file("AED and APD", VARIABLE, REMEDY))


@functools.cache
def _loaded(path: Path) -> Deep3D:
    from .deep3d import Deep3D

    return Deep3D(path)


def needs(config: object, device: str) -> Iterator[Need]:
    """The network's files, and dlib, which detects faces for it."""
    yield network_need("Deep3DFaceRecon's weights and landmarks, for AED and APD", VARIABLE, REMEDY, _deep3d)
    yield from dlib_needs(config, device)


def _spec(name: str, label: str, unit: str, implementation: str, what: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label=label,
        unit=unit,
        higher_is_better=False,
        digits=3,
        implementation=f"headbench.metrics.coefficients:{implementation}",
        summary=f"{what} by Deep3DFaceRecon; frames in which no face is found are left out and counted.",
        needs="headbench.metrics.coefficients:needs",
    )


AED = _spec("aed", "AED", "", "Aed", "Mean absolute difference of the 64 coefficients of the expression")
AED_SUM = _spec(
    "aed-sum",
    "AED (sum)",
    "",
    "AedSum",
    "Sum of the absolute differences of the 64 coefficients of the expression",
)
APD = _spec("apd", "APD", "rad", "Apd", "Mean absolute difference of the three angles of the head")
