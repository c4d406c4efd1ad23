"""Robustness tests: measures of one frame without ground truth, their limits, and the files of a test.

Every limit is relative to a frame of the same avatar that is not extreme, so that translucent hair, or translucent edges at
low resolution, do not count against the avatar.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..contracts import (
    Avatar,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadPose,
    SplatAvatar,
    Splats,
    TrueFrame,
)
from ..engine.adaptation import MethodNeeds
from ..engine.plan import Job
from ..errors import UnavailableError
from ..io.images import quantise, write_png
from ..io.provenance import RENDER
from ..protocol import Protocol, TaskWithoutTruth, make_protocol_without_truth, protocol_name
from ..registry import get
from ..rows import FULL, Row

log = logging.getLogger(__name__)
COVERED, SOLID = 0.05, 0.95
VISIBLE_OPACITY = 0.05
NEAR_M = 0.01
SIGMAS = 3.0


@dataclass(frozen=True)
class Measures:
    """Measures of one frame; those of splats are None for avatars without splats.

    The radius of the largest splat on screen with an opacity of at least 0.05 is three standard deviations along its longest
    axis, projected, relative to the image's height.
    """

    non_finite: float  # share of non-finite values in colours, alpha and splats
    coverage: float  # sum of alpha over the pixels
    translucent: float  # share of alpha below 0.95 among pixels with alpha above 0.05
    largest_splat: float | None = None
    mean_opacity: float | None = None


@dataclass(frozen=True)
class Limits:
    """Maximum differences of a frame from its reference."""

    coverage: tuple[float, float] = (0.8, 1.25)  # minimum and maximum ratio of coverages
    translucent_rise: float = 0.1  # maximum increase of the translucent share
    splat_growth: float = 2.0  # maximum ratio of the radii of the largest splats
    splat_share: float = 0.1  # radius, relative to the image's height, that is always allowed
    opacity: tuple[float, float] = (0.67, 1.5)  # minimum and maximum ratio of mean opacities


EXPRESSION_LIMITS = Limits()
"""Relative to the mean expression in the same view, whose silhouette is nearly the same."""

VIEW_LIMITS = Limits(coverage=(0.5, 2.0), translucent_rise=0.2)
"""Relative to the median over interpolated views, since a head is larger from the side than from the front."""


@dataclass(frozen=True)
class LimitCheck:
    """One measure of one frame over a region, and its limits. ``value`` is None if it cannot be measured, for the reason
    ``absent``."""

    measure: str
    value: float | None
    lower: float
    upper: float
    absent: str = "the avatar gives no splats"
    region: str = FULL

    @property
    def passed(self) -> bool:
        """Whether the limits are met; NaN violates them."""
        return self.value is None or self.lower <= self.value <= self.upper

    @property
    def outcome(self) -> tuple[str, str]:
        """Status and reason of its row."""
        if self.value is None:
            return "missing", self.absent
        return ("ok", "") if self.passed else ("failed", str(self))

    @property
    def name(self) -> str:
        """Measure and region: "psnr", or "psnr face"."""
        return self.measure if self.region == FULL else f"{self.measure} {self.region}"

    @property
    def worst_first(self) -> float:
        """Sort key, worst first: farthest beyond or nearest to a limit; without limits, the largest error."""
        value = math.nan if self.value is None else self.value
        if self.lower == -math.inf and self.upper == math.inf:
            return -value
        if self.upper == math.inf:
            return value
        return -value if self.lower <= 0.0 else -abs(math.log(value)) if value > 0.0 else -math.inf

    def __str__(self) -> str:
        return f"{self.name} is {self.value:.3g}, limits {self.lower:.3g} to {self.upper:.3g}"


def measure(frame: Frame, camera: Camera, splats: Splats | None = None) -> Measures:
    """Measure one frame. ``splats`` has means, scales, quats and opacities as numpy arrays, or is None."""
    alpha = np.asarray(frame.alpha, np.float64)
    arrays = [np.asarray(frame.rgb), alpha]
    covered = alpha > COVERED
    count = int(covered.sum())
    largest = opacity = None
    if splats is not None:
        arrays += [np.asarray(a) for a in (splats.means, splats.scales, splats.quats, splats.opacities)]
        opacities = np.asarray(splats.opacities, np.float64)
        largest = _largest_splat(np.asarray(splats.means), np.asarray(splats.scales), opacities, camera)
        opacity = float(opacities.mean()) if opacities.size else 0.0
    not_finite = sum(int(a.size - np.isfinite(a).sum()) for a in arrays)
    return Measures(
        not_finite / max(sum(a.size for a in arrays), 1),
        float(alpha.sum()),
        float((covered & (alpha < SOLID)).sum() / count) if count else 0.0,
        largest,
        opacity,
    )


def _largest_splat(means: FloatArray, scales: FloatArray, opacities: FloatArray, camera: Camera) -> float:
    """Projected radius of the largest visible splat, relative to the image's height; 0 if none is on screen.

    The size is that of a perspective projection along the axis, which is exact at the image's centre.
    """
    motion = np.asarray(camera.world_to_camera, np.float64)
    focal = np.diag(camera.K)[:2]
    local = means.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
    seen = (local[:, 2] > NEAR_M) & (opacities >= VISIBLE_OPACITY)
    local = local[seen]
    radius = SIGMAS * scales[seen].max(axis=1, initial=0.0) * focal.max() / local[:, 2]
    pixels = focal * local[:, :2] / local[:, 2:] + camera.K[:2, 2]
    inside = (pixels > -radius[:, None]) & (pixels < [camera.width, camera.height] + radius[:, None])
    return float(radius[inside.all(axis=1)].max(initial=0.0) / camera.height)


def typical(measures: Sequence[Measures]) -> Measures:
    """Median of each measure; None if one value is None."""
    columns = zip(*map(astuple, measures))
    return Measures(*(None if None in column else float(np.median(column)) for column in columns))  # type: ignore[arg-type]


def judge(found: Measures, reference: Measures, limits: Limits) -> list[LimitCheck]:
    """Compare a frame with its limits; one check per measure, in the order of `Measures`.

    Coverage and mean opacity are ratios to the reference. With an empty reference the ratio is infinite, or 1 if the
    frame is empty, too.
    """
    largest = max(limits.splat_share, limits.splat_growth * (reference.largest_splat or 0.0))
    return [
        LimitCheck("non_finite", found.non_finite, 0.0, 0.0),
        LimitCheck("coverage", _ratio(found.coverage, reference.coverage), *limits.coverage),
        LimitCheck("translucent", found.translucent, 0.0, reference.translucent + limits.translucent_rise),
        LimitCheck("largest_splat", found.largest_splat, 0.0, largest),
        LimitCheck("mean_opacity", _ratio(found.mean_opacity, reference.mean_opacity), *limits.opacity),
    ]


def _ratio(value: float | None, reference: float | None) -> float | None:
    if value is None or reference is None:
        return None
    if reference == 0.0:
        return 1.0 if value == 0.0 else float("inf")
    return value / reference


@dataclass(frozen=True)
class JudgedFrame:
    """A rendered frame, its checks, and optional checks of its change from another frame."""

    key: FrameKey
    checks: Sequence[LimitCheck]
    changes: Sequence[LimitCheck] = ()

    @property
    def broken(self) -> list[LimitCheck]:
        """The violated limits."""
        return [check for check in (*self.checks, *self.changes) if not check.passed]


class ShownFrames(NamedTuple):
    """Content of the protocol of rendered frames."""

    job: Job
    clips: Sequence[Clip]
    keys: Sequence[FrameKey]
    sizes: Sequence[tuple[int, int]]  # of the images, (width, height)
    condition: tuple[str, str]  # description of the rendered frames, and a fingerprint of it


def protocols_of(task: TaskWithoutTruth, shown: Sequence[ShownFrames]) -> dict[str, Protocol]:
    """The protocols of some avatars; methods with equal needs render the same frames and share a protocol."""
    named: dict[str, list[ShownFrames]] = {}
    for each in shown:
        named.setdefault(protocol_name(task, MethodNeeds.of(each.job.method.spec)), []).append(each)
    return {
        name: make_protocol_without_truth(
            task,
            [clip for each in keys for clip in each.clips],
            [key for each in keys for key in each.keys],
            [size for each in keys for size in each.sizes],
            dict(each.condition for each in keys),
        )
        for name, keys in named.items()
    }


def judged_rows(
    job: Job, keys: Sequence[FrameKey], judged: Callable[[], tuple[list[JudgedFrame], dict[str, Any]]]
) -> tuple[list[Row], dict[str, Any]]:
    """The rows of an avatar, and its record: a summary and the entries of ``judged``, which renders and evaluates.

    An avatar that cannot be rendered (`UnavailableError`) has missing rows, and its record has the reason.
    """
    (protocol,) = job.protocols.values()
    try:
        frames, details = judged()
    except UnavailableError as error:
        log.warning("%s is missing: %s", job.name, error)
        specs = get("conditions", job.condition.drive.name).metrics
        absent = {spec: LimitCheck(spec.name, None, 0.0, 0.0, str(error)) for spec in specs}
        checks, changes = ([absent[s] for s in specs if s.per_frame is each] for each in (True, False))
        frames, details = [JudgedFrame(key, checks, changes) for key in keys], {"missing": str(error)}
    record = {**_summary(job, frames), **details, "protocol": protocol.hash}
    return _rows(job, protocol, frames), record


def render_measured(
    avatar: Avatar, camera: Camera, pose: HeadPose, background: Sequence[float], splats: Splats | None = None
) -> tuple[Frame, Measures]:
    """Render and measure a frame, with the ``splats`` of its pose if they are known."""
    frame = avatar.render(camera, pose, background)
    return frame, measure(frame, camera, splats_of(avatar, pose) if splats is None else splats)


def splats_of(avatar: Avatar, pose: HeadPose) -> Splats | None:
    """Splats of a pose for splat avatars, else None."""
    return avatar.splats(pose) if isinstance(avatar, SplatAvatar) else None


def write_frame(path: Path, frame: Frame) -> None:
    """Write the frame as 8-bit PNG, unless it has non-finite values, which a PNG would hide."""
    if np.isfinite(frame.rgb).all():
        write_png(path, quantise(frame.rgb), RENDER)
    else:
        path.unlink(missing_ok=True)


def _rows(job: Job, protocol: Protocol, frames: Sequence[JudgedFrame]) -> list[Row]:
    """Rows of the checks; a violated limit has status "failed" with its name.

    Changes have one row per avatar: the mean over its frames, which fails if one of them fails.
    """
    method = job.method.spec
    whose = (method.name, method.version, job.seed)
    rows = []
    for frame in frames:
        place = (*whose, protocol.task, *frame.key)
        for check in frame.checks:
            value = math.nan if check.value is None else check.value
            rows.append(Row(*place, check.region, check.measure, value, protocol.hash, *check.outcome))
    of_avatar = (*whose, "", job.clip.subject, "", -1, "")
    for checks in _by_name(check for frame in frames for check in frame.changes).values():
        values = [check.value for check in checks if check.value is not None]
        mean = float(np.mean(values)) if values else math.nan
        broken = [check for check in checks if not check.passed]
        status, reason = broken[0].outcome if broken else ("ok", "") if values else checks[0].outcome
        if broken:
            reason = f"{len(broken)} of {len(checks)} frames; the first: {reason}"
        rows.append(Row(*of_avatar, FULL, checks[0].measure, mean, "", status, reason))
    return [replace(row, condition=job.condition.name) for row in rows]


def _by_name(checks: Iterable[LimitCheck]) -> dict[str, list[LimitCheck]]:
    named: dict[str, list[LimitCheck]] = {}
    for check in checks:
        named.setdefault(check.name, []).append(check)
    return named


def _summary(job: Job, frames: Sequence[JudgedFrame]) -> dict[str, Any]:
    """Number of frames of an avatar, frames that violate limits, and mean, worst value and failed frames of each measure."""
    broken = [frame for frame in frames if frame.broken]
    by_measure = _by_name(check for frame in frames for check in (*frame.checks, *frame.changes))
    return {
        "subject": job.clip.subject,
        "method": job.method.spec.name,
        "seed": job.seed,
        "frames": len(frames),
        "frames_broken": len(broken),
        "measures": {name: _measured(checks) for name, checks in by_measure.items()},
        "broken": [{"key": str(f.key), "limits": [str(check) for check in f.broken]} for f in broken],
    }


def _measured(checks: Sequence[LimitCheck]) -> dict[str, float | int | None]:
    """Mean, worst and number of finite values of a measure, and number of values that violate a limit."""
    measured = [check for check in checks if check.value is not None and math.isfinite(check.value)]
    return {
        "mean": float(np.mean([check.value for check in measured])) if measured else None,
        "worst": min(measured, key=lambda check: check.worst_first).value if measured else None,
        "frames": len(measured),
        "failed": sum(not check.passed for check in checks),
    }


FACE = "face"
MEASURED = ("depth", "normals")
NO_DEPTH, NO_FACE = "the avatar gives no depth", "no face in view"
NOT_SHOWN = "the avatar shows nothing where the face is"


def surface(depth: FloatArray | None, truth: TrueFrame, camera: Camera) -> list[LimitCheck]:
    """Mean errors of depth (mm) and normals (degrees) over the pixels of the face that the avatar covers.

    Pixels of the face that the avatar does not cover are ignored here; they reduce the overlap of masks. There are no limits:
    translucent splats show a mean depth behind the skin, which images do not determine.

    Parameters
    ----------
    depth : FloatArray | None
        (H, W) metres along the camera's axis, NaN where nothing is shown; None for an avatar that gives none.
    truth : TrueFrame
        Ground truth with depth.
    camera : Camera
        Camera of the (H, W) images.
    """
    if depth is None:
        return absent_surface(NO_DEPTH)
    assert truth.depth is not None
    true = np.where(truth.face & np.isfinite(truth.depth), truth.depth, np.nan).astype(np.float64)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    seen = np.isfinite(true) & np.isfinite(depth)
    if not seen.any():
        return absent_surface(NOT_SHOWN if np.isfinite(true).any() else NO_FACE)
    error = 1000 * np.abs(depth - true)[seen].mean()
    checks = [_unlimited("depth", float(error))]
    shown, right = normals(depth, camera), normals(true, camera)
    both = np.isfinite(shown).all(axis=2) & np.isfinite(right).all(axis=2)
    if not both.any():
        return [*checks, _unlimited("normals", None, NO_FACE)]
    cosines = np.clip((shown[both] * right[both]).sum(axis=1), -1.0, 1.0)
    return [*checks, _unlimited("normals", float(np.degrees(np.arccos(cosines)).mean()))]


def absent_surface(reason: str) -> list[LimitCheck]:
    """The measures of a frame without depth, with the reason."""
    return [_unlimited(name, None, reason) for name in MEASURED]


def _unlimited(name: str, value: float | None, reason: str = "") -> LimitCheck:
    return LimitCheck(name, value, -math.inf, math.inf, reason, FACE)


def normals(depth: FloatArray, camera: Camera) -> FloatArray:
    """(H, W, 3) unit normals, facing the camera, of an (H, W) depth map, by central differences; NaN next to missing depth."""
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=2) @ np.linalg.inv(camera.K).T
    points = depth[..., None] * rays
    down, right = np.gradient(points, axis=(0, 1))
    crossed = np.cross(down, right)
    return np.asarray(crossed / np.linalg.norm(crossed, axis=2, keepdims=True))
