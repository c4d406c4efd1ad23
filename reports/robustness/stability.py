"""How steady an avatar stays where there is no ground truth: measures of one frame, and limits to them.

Every limit is relative to a frame of the same avatar that is not extreme, so that hair, which is translucent, or a
low resolution, whose edges are, does not count against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...bench.contracts import Camera, FloatArray, Frame

COVERED, SOLID = 0.05, 0.95
VISIBLE_OPACITY = 0.05
NEAR_M = 0.01
SIGMAS = 3.0

MEASURES = ("non_finite", "coverage", "translucent", "largest_splat", "mean_opacity")


@dataclass(frozen=True)
class Measures:
    """What one frame shows.

    Attributes
    ----------
    non_finite : share of the colours, the alpha and the splats' numbers that are infinite or not a number.
    coverage : sum of alpha over the pixels.
    translucent : of the pixels with alpha above 0.05, the share below 0.95.
    largest_splat : radius (three deviations along its longest axis, projected) of the largest splat on screen
        that has an opacity of at least 0.05, as a share of the image's height; None without splats.
    mean_opacity : mean over the splats; None without splats.
    """

    non_finite: float
    coverage: float
    translucent: float
    largest_splat: float | None = None
    mean_opacity: float | None = None


@dataclass(frozen=True)
class Limits:
    """How far a frame may differ from its reference.

    Attributes
    ----------
    coverage : least and largest ratio of the coverages.
    translucent_rise : by how much the translucent share may rise.
    splat_growth, splat_share : the largest splat may have this many times the radius of the reference's, and in
        any case this share of the image's height.
    opacity : least and largest ratio of the mean opacities.
    """

    coverage: tuple[float, float] = (0.8, 1.25)
    translucent_rise: float = 0.1
    splat_growth: float = 2.0
    splat_share: float = 0.1
    opacity: tuple[float, float] = (0.67, 1.5)


EXPRESSION_LIMITS = Limits()
"""Against the mean expression in the same view: a silhouette that hardly moves."""

VIEW_LIMITS = Limits(coverage=(0.5, 2.0), translucent_rise=0.2)
"""Against the median over interpolated views: a head is larger from the side than from the front."""


@dataclass(frozen=True)
class Verdict:
    """One measure of one frame and its limits. ``value`` is None where it cannot be measured, ``absent`` says why."""

    measure: str
    value: float | None
    lower: float
    upper: float
    absent: str = "the avatar gives no splats"

    @property
    def passed(self) -> bool:
        """Whether the limits hold; a value that is not a number breaks them."""
        return self.value is None or self.lower <= self.value <= self.upper

    def __str__(self) -> str:
        return f"{self.measure} is {self.value:.3g}, limits {self.lower:.3g} to {self.upper:.3g}"


def measure(frame: Frame, camera: Camera, splats: Any = None) -> Measures:
    """Measure one frame. ``splats`` has means, scales, opacities as numpy arrays, None where there are none."""
    alpha = np.asarray(frame.alpha, np.float64)
    arrays = [np.asarray(frame.rgb), alpha]
    covered = alpha > COVERED
    count = int(covered.sum())
    translucent = float((covered & (alpha < SOLID)).sum() / count) if count else 0.0
    if splats is None:
        return Measures(_non_finite(arrays), float(alpha.sum()), translucent)
    arrays += [np.asarray(a) for a in (splats.means, splats.scales, splats.quats, splats.opacities)]
    opacities = np.asarray(splats.opacities, np.float64)
    return Measures(
        _non_finite(arrays),
        float(alpha.sum()),
        translucent,
        largest_splat(np.asarray(splats.means), np.asarray(splats.scales), opacities, camera),
        float(opacities.mean()) if opacities.size else 0.0,
    )


def largest_splat(means: FloatArray, scales: FloatArray, opacities: FloatArray, camera: Camera) -> float:
    """Projected radius of the largest visible splat as a share of the image's height; 0 where none is on screen.

    A perspective projection along the axis is taken for the size, which is exact at the image's centre.
    """
    motion = np.asarray(camera.world_to_camera, np.float64)
    local = means.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
    seen = (local[:, 2] > NEAR_M) & (opacities >= VISIBLE_OPACITY)
    local = local[seen]
    radius = (
        SIGMAS * scales[seen].max(axis=1, initial=0.0) * max(camera.K[0, 0], camera.K[1, 1]) / local[:, 2]
    )
    x = camera.K[0, 0] * local[:, 0] / local[:, 2] + camera.K[0, 2]
    y = camera.K[1, 1] * local[:, 1] / local[:, 2] + camera.K[1, 2]
    inside = (x > -radius) & (x < camera.width + radius) & (y > -radius) & (y < camera.height + radius)
    return float(radius[inside].max(initial=0.0) / camera.height)


def typical(measures: Sequence[Measures]) -> Measures:
    """Median of each measure."""

    def median(name: str) -> float | None:
        values = [getattr(m, name) for m in measures]
        return None if any(v is None for v in values) else float(np.median(values))

    return Measures(
        median("non_finite") or 0.0,
        median("coverage") or 0.0,
        median("translucent") or 0.0,
        median("largest_splat"),
        median("mean_opacity"),
    )


def judge(found: Measures, reference: Measures, limits: Limits) -> list[Verdict]:
    """Hold a frame to its limits; one verdict a measure, in the order of `MEASURES`.

    Coverage and mean opacity are given as ratios to the reference. A reference that shows nothing makes the ratio
    infinite, or 1 where the frame shows nothing either.
    """
    largest = max(limits.splat_share, limits.splat_growth * (reference.largest_splat or 0.0))
    return [
        Verdict("non_finite", found.non_finite, 0.0, 0.0),
        Verdict("coverage", _ratio(found.coverage, reference.coverage), *limits.coverage),
        Verdict("translucent", found.translucent, 0.0, reference.translucent + limits.translucent_rise),
        Verdict("largest_splat", found.largest_splat, 0.0, largest),
        Verdict("mean_opacity", _ratio(found.mean_opacity, reference.mean_opacity), *limits.opacity),
    ]


def _ratio(value: float | None, reference: float | None) -> float | None:
    if value is None or reference is None:
        return None
    if reference == 0.0:
        return 1.0 if value == 0.0 else float("inf")
    return value / reference


def _non_finite(arrays: Sequence[FloatArray]) -> float:
    total = sum(a.size for a in arrays)
    return sum(int(a.size - np.isfinite(a).sum()) for a in arrays) / max(total, 1)
