"""Track the head model of a clip in its images."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ...bench.contracts import FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import Member, cached_arrays
from ...bench.io.files import digest
from ..clip import CaptureClip
from .fit import Fitter
from .images import FrameStack
from .landmarks import ImageLandmarks
from .rig import PoseColumns
from .solve import HeadState
from .views import Views
from .work import TRACKER_VERSION

MOST_TIMESTEPS, MOST_PIXELS = 64, 2.5e8
"""Timesteps, and pixels of all cameras, that are fitted together; this bounds the memory."""

LandmarkSource = Callable[[Sequence[int]], ImageLandmarks]
"""Finds the landmarks of some timesteps in all cameras."""


class TimestepResidual(NamedTuple):
    """Residual of a timestep after the fit."""

    timestep: int
    landmarks_px: float
    """Root mean square distance between landmarks and their projections, pixels."""
    colour_levels: float
    """Median difference of a colour from that of its surface point, 8-bit levels."""


@dataclass(frozen=True)
class TrackingReport:
    """Residuals and time of a tracking."""

    cameras: tuple[str, ...]
    residuals: tuple[TimestepResidual, ...]
    seconds: float
    """Time of the fit, including reading images but not landmark detection."""

    def to_json(self) -> dict[str, Any]:
        """The summary and every timestep as plain values."""
        return {**asdict(self), "residuals": [one._asdict() for one in self.residuals], **self.summary()}

    def summary(self) -> dict[str, float]:
        """Means over the timesteps."""
        return {
            "timesteps": len(self.residuals),
            "seconds_per_timestep": self.seconds / len(self.residuals),
            "landmarks_px": float(np.mean([residual.landmarks_px for residual in self.residuals])),
            "colour_levels": float(np.mean([residual.colour_levels for residual in self.residuals])),
        }


class Tracked(NamedTuple):
    """A tracked clip and its report."""

    clip: CaptureClip
    report: TrackingReport


def check_cameras(clip: CaptureClip, cameras: Sequence[str]) -> None:
    """Raise `InputError` if there is no camera or one is unknown."""
    unknown = [name for name in cameras if name not in clip.cameras]
    if unknown or not cameras:
        expected = f"at least one of {', '.join(clip.cameras) or 'none'}"
        raise InputError(f"clip of {clip.subject}", "cameras", expected, ", ".join(unknown) or "none")


# The linear algebra uses many small matrices, for which threads cost more time than they save.
@threadpool_limits.wrap(limits=1)
def track(
    clip: CaptureClip,
    cameras: Sequence[str],
    source: LandmarkSource,
    *,
    notes: Mapping[str, Any] | None = None,
    store: Path | None = None,
    progress: Progress = no_progress,
) -> Tracked:
    """Estimate shape and poses from images; recorded as a step. The static offset becomes zero.

    Neither shape, poses nor static offset of the clip are used, other than by ``source``. The shape is estimated with the
    first timesteps, spread over the clip, and kept for the others.

    Parameters
    ----------
    cameras : Sequence[str]
        Cameras whose images are used; one is enough.
    source : LandmarkSource
        Finds landmarks.
    notes : Mapping[str, Any] | None
        Recorded with the step.
    store : Path | None
        Folder that keeps the fit of every part, which a later call with the same images and landmarks does not repeat.
    """
    where = f"clip of {clip.subject}"
    check_cameras(clip, cameras)
    timesteps = sorted({timestep for timestep, _ in clip.frame_at})
    if not timesteps:
        raise InputError(where, "timesteps", "at least one frame", "none")
    missing = [(t, name) for t in timesteps for name in cameras if (t, name) not in clip.frame_at]
    if missing:
        found = f"none at timestep {missing[0][0]} of camera {missing[0][1]}"
        raise InputError(where, "frames", "an image of every camera at every timestep", found)

    views = Views([clip.cameras[name] for name in cameras])
    most = min(MOST_TIMESTEPS, max(1, int(MOST_PIXELS // views.sizes.prod(axis=1).sum())))
    blocks = -(-len(timesteps) // most)
    seen = [
        [camera.id, camera.width, camera.height, camera.K, camera.world_to_camera] for camera in views.cameras
    ]
    poses: dict[int, FloatArray] = {}
    residuals: list[TimestepResidual] = []
    shape: FloatArray | None = None
    seconds = 0.0
    for block in range(blocks):
        part = timesteps[block::blocks]
        landmarks = source(part)
        if not np.isfinite(landmarks.pixels).any():
            raise InputError(where, "landmarks", "a face in some image", "none")

        def report_block(done: int, total: int, note: str = "", block: int = block) -> None:
            progress(block * total + done, blocks * total, f"tracking, {note}")

        fit = partial(_fit_block, clip, cameras, views, part, landmarks, shape, report_block)
        if store is None:
            fitted = fit()
        else:
            mark = digest(
                TRACKER_VERSION, clip.fingerprint, clip.head.fingerprint(), seen, part, *landmarks, shape
            )
            fitted = cached_arrays(store / f"part-{block:05d}.npz", mark, _PART, fit, {"T": len(part)})
        shape = fitted["shape"]
        seconds += float(fitted["seconds"])
        rows = fitted["landmarks"].tolist(), fitted["colours"].tolist()
        residuals += [TimestepResidual(*row) for row in zip(part, *rows)]
        poses |= dict(zip(part, fitted["poses"]))
    assert shape is not None
    state = HeadState(np.asarray(shape, np.float32), np.stack([poses[timestep] for timestep in timesteps]))
    report = TrackingReport(tuple(cameras), tuple(sorted(residuals)), seconds)
    tracked = PoseColumns.of(clip.head).poses(state.poses, clip.head, clip.subject, timesteps)
    parameters = {"cameras": [*cameras], **(notes or {}), "residual": report.summary()}
    del parameters["residual"]["seconds_per_timestep"]  # which is different each time
    derived = clip.derive(
        "track",
        parameters,
        shape=state.shape,
        static_offset=np.zeros(np.shape(clip.head.template), np.float32),
        poses=dict(zip(timesteps, tracked)),
    )
    return Tracked(derived, report)


_PART = {
    "shape": Member("f", ("S",)),
    "poses": Member("f", ("T", "D")),
    **dict.fromkeys(("landmarks", "colours"), Member("f", ("T",))),
    "seconds": Member("f", ()),
}


def _fit_block(
    clip: CaptureClip,
    cameras: Sequence[str],
    views: Views,
    part: Sequence[int],
    landmarks: ImageLandmarks,
    shape: FloatArray | None,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Fit some timesteps with a given or a newly estimated shape; returns the arrays of `_PART`."""
    begin = time.perf_counter()
    fitter = Fitter(clip.head, views, landmarks)
    images = [clip.image(clip.frame_at[timestep, name]) for timestep in part for name in cameras]
    keep = shape is not None
    state = fitter.fit_landmarks(fitter.start(shape), keep_shape=keep)
    fitted = fitter.fit_colours(state, FrameStack(images), keep_shape=keep, progress=progress)
    return {
        "shape": fitted.state.shape,
        "poses": fitted.state.poses,
        "landmarks": fitted.landmarks,
        "colours": fitted.colours,
        "seconds": np.array(time.perf_counter() - begin),
    }
