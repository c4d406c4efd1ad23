"""Points of the tracked face, and how much expression and head pose have a say about a place near them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ...bench.errors import InputError

FACIAL = ("face", "lips", "eye_region", "nose", "forehead", "left_ear", "right_ear")
"""Regions that the published landmarks and mesh points cover."""


def landmark_vertices(head: HeadAsset, neutral: FloatArray, count: int) -> IntArray:
    """Vertices of the face, each the farthest from those before it; as many as there are, if fewer.

    The published points are 66 detected landmarks and each hundredth vertex of the tracked face; farthest points
    cover the same surface evenly on any head model.

    Parameters
    ----------
    neutral : (V, 3) neutral head of the subject.

    Raises
    ------
    InputError
        Where the head has no face region.
    """
    if "face" not in head.regions:
        known = ", ".join(sorted(head.regions)) or "no regions"
        raise InputError(f"head model {head.version!r}", "regions", "a region 'face'", known)
    facial = np.unique(np.concatenate([head.regions[name] for name in FACIAL if name in head.regions]))
    points = np.asarray(neutral, np.float64)[facial]
    # Farthest from the middle first: a start that needs no choice.
    chosen = [int(np.argmax(np.square(points - points.mean(0)).sum(1)))]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        nearest = np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(1))
        chosen.append(int(np.argmax(nearest)))
    return facial[chosen]


def mouth_box(lips: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre and half sides, (3,) each, of the box for points inside the mouth.

    Its centre is the mean of the (L, 3) lip points, but as far back as the hindmost of them; its half sides are 0.8
    of their largest distance from that centre along each axis, as published.
    """
    center = lips.mean(0)
    center[2] = lips[:, 2].min()
    return center, 0.8 * np.abs(lips - center).max(0)


class Influence(NamedTuple):
    """Which points a controller acts on, (n,) int64, and its (n,) weights there in (0, 1]."""

    rows: Tensor
    weights: Tensor


def influences(
    points: Tensor, landmarks: Tensor, near_squared: float, far_squared: float
) -> tuple[Influence, Influence]:
    """Influence of expression and of head pose on (N, 3) points; their weights add up to 1.

    Expression rules up to ``near_squared`` from the nearest of the (L, 3) landmarks, pose from ``far_squared`` on,
    and in between the weights are linear in the squared distance.
    """
    with torch.no_grad():
        # |a - b|^2 without |a|^2, which is the same for all landmarks of a point. `min` is three times as fast as
        # `argmin` on the CPU.
        nearest = torch.addmm(landmarks.square().sum(1), points, landmarks.t(), alpha=-2).min(1).indices
    squared = (points - landmarks.index_select(0, nearest)).square().sum(1)
    weight = ((far_squared - squared) / (far_squared - near_squared)).clamp(0, 1)
    near, far = (weight.detach() > 0).nonzero().squeeze(1), (weight.detach() < 1).nonzero().squeeze(1)
    return (
        Influence(near, weight.index_select(0, near)),
        Influence(far, 1 - weight.index_select(0, far)),
    )
