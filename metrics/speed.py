"""Speed: how fast an avatar is animated, driven and seen anew every frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..bench.contracts import Avatar, Camera, HeadPose, Measurement
from ..bench.errors import InputError


@dataclass(frozen=True)
class Speed:
    """Distribution of the time per frame, milliseconds of wall clock, over ``frames`` timed frames."""

    frames: int
    mean_ms: float
    median_ms: float
    p5_ms: float
    p95_ms: float

    @property
    def fps(self) -> float:
        """Frames per second: 1000 / mean time. The mean of per-frame rates would flatter a jittery method."""
        return 1000.0 / self.mean_ms


def measure_speed(
    render: Callable[[Camera, HeadPose], Any],
    workload: Sequence[tuple[Camera, HeadPose]],
    *,
    frames: int = 300,
    warm_up: int = 10,
    limit_s: float | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Speed:
    """Time ``render`` from driving signal to image in host memory, one frame after the other.

    The workload is walked in order, over and over, through warm-up and measurement alike, so that every frame
    brings a camera and a pose other than the last: nothing cached for the last frame can be used again.

    Parameters
    ----------
    render : renders one frame and returns when it is in host memory (`Avatar.render` does).
    workload : cameras and poses; neighbours must differ (the last and the first are neighbours, too).
    frames : how many frames to time, at least 1.
    warm_up : frames rendered before, untimed.
    limit_s : stop early once the timed frames took this long, with however many were timed (at least 1).
    clock : seconds, monotonic; wall clock by default.
    """
    if frames < 1 or warm_up < 0:
        raise InputError(
            "speed", "frames", "at least 1 timed frame, warm-up of 0 or more", f"{frames}, {warm_up}"
        )
    if len(workload) < 2:
        raise InputError("speed", "workload", "two or more pairs of camera and pose", str(len(workload)))
    for index, (camera, pose) in enumerate(workload):
        previous_camera, previous_pose = workload[index - 1]
        if camera is previous_camera and pose is previous_pose:
            found = f"entries {(index - 1) % len(workload)} and {index} are the same"
            raise InputError("speed", "workload", "a new camera or pose every frame", found)
    for index in range(warm_up):
        render(*workload[index % len(workload)])
    times: list[float] = []
    total = 0.0
    for index in range(warm_up, warm_up + frames):
        start = clock()
        render(*workload[index % len(workload)])
        times.append(clock() - start)
        total += times[-1]
        if limit_s is not None and total >= limit_s:
            break
    milliseconds = 1000.0 * np.asarray(times)
    p5, median, p95 = np.percentile(milliseconds, [5, 50, 95])
    return Speed(len(times), float(milliseconds.mean()), float(median), float(p5), float(p95))


def fps(avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]]) -> Measurement:
    """Frames per second of `Avatar.render` over ``workload``: up to 300 frames, or those of 10 s if fewer.

    What counts is all that animation takes: driving signal to mesh, mesh to primitives, rasterisation, and the
    image in host memory. Details: the fields of `Speed`. Numbers of different machines do not compare.
    """
    speed = measure_speed(avatar.render, workload, warm_up=3, limit_s=10.0)
    return Measurement(speed.fps, asdict(speed))
