"""Speed of an avatar with a new driving signal and camera in every frame.

One measurement, in this order: warm-up until frame times are stationary; latency, waiting for every frame;
throughput, with several frames in flight; the stages of a frame; and the same frame repeatedly, which shows
the effect of caching between frames. Latency and throughput are separate, as in MLPerf's single-stream and offline
scenarios (Reddi et al., "MLPerf Inference Benchmark", ISCA 2020).
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count, islice, repeat
from typing import Any, Protocol

import numpy as np

from ..bench.contracts import (
    STAGES,
    Avatar,
    Camera,
    FloatArray,
    HeadPose,
    Measurement,
    StagedAvatar,
    no_stage,
)
from ..bench.errors import InputError
from ..bench.specs import MetricSpec

FPS = MetricSpec(
    name="fps",
    label="Speed",
    unit="FPS",
    higher_is_better=True,
    digits=1,
    implementation="headbench.metrics.speed:fps",
    summary="Frames per second from driving signal to image in host memory, a new camera and pose every frame.",
    kind="avatar",
    tables=("comparison", "speed"),
    machine_bound=True,
    default=True,
)


def _milliseconds(name: str, label: str, detail: str, summary: str) -> MetricSpec:
    """One of the times measured with `FPS`."""
    return replace(
        FPS,
        name=name,
        label=label,
        unit="ms",
        higher_is_better=False,
        digits=2,
        detail=detail,
        summary=summary,
        tables=("speed",),
    )


LATENCY_P50 = _milliseconds("latency_p50", "p50", "p50_ms", "Median latency, one frame at a time.")
LATENCY_P95 = _milliseconds("latency_p95", "p95", "p95_ms", "95th percentile of the latency.")
LATENCY_P99 = _milliseconds("latency_p99", "p99", "p99_ms", "99th percentile of the latency.")
_STATIC = "Median latency if neither camera nor pose changes."
LATENCY_STATIC = _milliseconds("latency_static", "Static pose", "static_ms", _STATIC)
_PROCESSOR = "Processor time of a frame, all threads together."
PROCESSOR_TIME = _milliseconds("processor_time", "CPU", "processor_ms", _PROCESSOR)


def _stage(name: str, label: str, what: str) -> MetricSpec:
    return _milliseconds(f"stage_{name}", label, f"{name}_ms", f"Median time {what}.")


STAGE_DRIVE = _stage("drive", "Drive", "from driving signal to posed head model")
STAGE_DEFORM = _stage("deform", "Deform", "from there to primitives as the camera sees them")
STAGE_RASTERIZE = _stage("rasterize", "Rasterize", "from primitives to image")
STAGE_POST = _stage("post", "Post", "of the post-processing of the image")
STAGE_READ_BACK = _stage("read_back", "Read-back", "to bring the image into host memory")
THROUGHPUT = replace(
    FPS,
    name="throughput",
    label="Throughput",
    detail="throughput_fps",
    summary="Frames per second with up to 8 frames in flight.",
    tables=("speed",),
)

FPS_ONE_THREAD = replace(
    FPS,
    name="fps_one_thread",
    label="1 thread",
    detail="one_thread_fps",
    summary="Frames per second, as fps, on one thread.",
    tables=("speed",),
)
FPS_WITHOUT_HEAD = replace(
    FPS_ONE_THREAD,
    name="fps_without_head",
    label="1 thread, without head model",
    detail="without_head_fps",
    summary="Frames per second on one thread, from the posed mesh: without the stage from driving signal to posed head model.",
)

WHITE = (1.0, 1.0, 1.0)
HEAD_STAGE, READ_BACK = "drive", "read_back"
NUDGE = 1e-5  # added to every expression coefficient in each lap of the workload: an invisible change

Clock = Callable[[], float]
Frame = tuple[Camera, HeadPose]
Stream = Iterator[Frame]


class Drawing(Protocol):
    """The part of `StagedAvatar` that is timed."""

    def draw(
        self, camera: Camera, pose: HeadPose, background: Sequence[float], end_stage: Callable[[str], None]
    ) -> Any: ...
    def read_back(self, drawn: Any) -> Any: ...


class WholeFrames:
    """An avatar without stages: `draw` renders the whole frame."""

    def __init__(self, avatar: Avatar):
        self._avatar = avatar

    def draw(
        self, camera: Camera, pose: HeadPose, background: Sequence[float], end_stage: Callable[[str], None]
    ) -> Any:
        """Render the frame, on the avatar's own background."""
        return self._avatar.render(camera, pose)

    def read_back(self, drawn: Any) -> Any:
        """Return the rendered frame."""
        return drawn


@dataclass(frozen=True)
class SpeedProtocol:
    """Amount of timed work. Every loop ends after its number of frames, or after its seconds and at least one
    frame.
    """

    warm_up: int = 30
    """Minimum number of warm-up frames. Warm-up ends when the median of the last ``window`` frames lies within ``steady``
    (relative) of the median of the ``window`` before."""
    warm_up_limit: int = 200
    warm_up_s: float = 5.0
    window: int = 10
    steady: float = 0.02
    latency: int = 300
    latency_s: float = 10.0
    throughput: int = 300
    throughput_s: float = 4.0

    depth: int = 8
    """Number of frames in flight in the throughput loop."""
    stages: int = 60
    stages_s: float = 3.0
    static: int = 40
    static_s: float = 2.0
    one_thread: int = 300
    one_thread_s: float = 5.0


def fps(avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]]) -> Measurement:
    """Frames per second: 1000 / mean latency in ms over ``workload``, driving signal to image in host memory.

    The mean of per-frame rates would favour methods with uneven frame times. Details, in wall-clock time unless stated:
    ``frames``, ``mean_ms``, ``p5_ms``, ``p50_ms``, ``p95_ms``, ``p99_ms``, ``iqr_ms``, ``max_ms`` and ``processor_ms`` (mean
    time of all threads) of the latency; ``throughput_fps``; ``<stage>_ms``, the median of each stage if the avatar reports
    stages; ``one_thread_fps``, the rate of ``p50_ms`` if torch and the kernels have one thread, and ``without_head_fps``, that
    rate without the first stage, "drive", if the avatar reports stages; ``static_ms``, the median if neither camera nor pose
    changes; ``warm_up_frames``; ``stationary`` (1 or 0); ``load``, the mean number of busy processes of the last minute. A run
    adds the number of threads and of cores used by other processes.
    Values of different machines are not comparable.
    """
    return measure_speed(avatar, workload)


def measure_speed(
    avatar: Avatar,
    workload: Sequence[tuple[Camera, HeadPose]],
    protocol: SpeedProtocol | None = None,
    clock: Clock = time.perf_counter,
) -> Measurement:
    """Measure `fps` with another protocol or clock (seconds, monotonic)."""
    plan = protocol or SpeedProtocol()
    if len(workload) < 2:
        raise InputError("speed", "workload", "two or more pairs of camera and pose", str(len(workload)))
    for index, (camera, pose) in enumerate(workload):  # the last is followed by the first
        if camera is workload[index - 1][0] and pose is workload[index - 1][1]:
            found = f"entries {(index - 1) % len(workload)} and {index} are the same"
            raise InputError("speed", "workload", "a new camera or pose every frame", found)
    drawing: Drawing = avatar if isinstance(avatar, StagedAvatar) else WholeFrames(avatar)
    stream = fresh_frames(workload)
    warm_up_frames, stationary = warm_up(drawing, stream, plan, clock)
    processor = time.process_time()
    milliseconds = latencies(drawing, stream, plan.latency, plan.latency_s, clock)
    processor_ms = 1000 * (time.process_time() - processor) / len(milliseconds)
    percentiles = {f"p{p}_ms": float(np.percentile(milliseconds, p)) for p in (5, 25, 50, 75, 95, 99)}
    spread = percentiles.pop("p75_ms") - percentiles.pop("p25_ms")
    details: dict[str, float] = {
        "frames": len(milliseconds),
        "mean_ms": float(milliseconds.mean()),
        **percentiles,
        "iqr_ms": spread,
        "max_ms": float(milliseconds.max()),
        "processor_ms": processor_ms,
        "throughput_fps": throughput(drawing, stream, plan.throughput, plan.throughput_s, plan.depth, clock),
    }
    if drawing is avatar:
        medians = stage_times(drawing, stream, plan.stages, plan.stages_s, clock)
        details |= {f"{stage}_ms": value for stage, value in medians.items()}
    with one_thread():
        waited = latencies(drawing, stream, plan.one_thread, plan.one_thread_s, clock)
        alone = float(np.median(waited))
        details["one_thread_fps"] = 1000 / alone
        if drawing is avatar:
            medians = stage_times(drawing, stream, plan.stages, plan.stages_s, clock)
            whole = sum(medians.values())
            details["without_head_fps"] = 1000 / (alone * (1 - medians.get(HEAD_STAGE, 0.0) / whole))
    static = latencies(drawing, repeat(next(stream)), plan.static, plan.static_s, clock)
    details |= {
        "static_ms": float(np.median(static)),
        "warm_up_frames": warm_up_frames,
        "stationary": float(stationary),
        "load": os.getloadavg()[0],
    }
    return Measurement(1000 / details["mean_ms"], {k: v for k, v in details.items() if np.isfinite(v)})


def fresh_frames(workload: Sequence[tuple[Camera, HeadPose]]) -> Stream:
    """The workload repeated endlessly as a live signal: no pose occurs twice.

    Every lap adds `NUDGE` to the expression once more, and no pose has subject and timestep, so that nothing
    cached for a known or earlier pose can be used.
    """
    for lap in count(1):
        for camera, pose in workload:
            expression = np.asarray(pose.expression) + lap * NUDGE
            yield camera, replace(pose, expression=expression, subject="", timestep=None)


def warm_up(drawing: Drawing, stream: Stream, plan: SpeedProtocol, clock: Clock) -> tuple[int, bool]:
    """Draw until frame times are stationary; return the number of frames, and whether they became
    stationary."""
    times: list[float] = []
    for seconds in _waited_for(drawing, stream, plan.warm_up_limit, plan.warm_up_s, clock):
        times.append(seconds)
        if len(times) >= max(plan.warm_up, 2 * plan.window):
            last = float(np.median(times[-plan.window :]))
            before = float(np.median(times[-2 * plan.window : -plan.window]))
            if abs(last - before) <= plan.steady * before:
                return len(times), True
    return len(times), False


def latencies(drawing: Drawing, stream: Stream, frames: int, limit_s: float, clock: Clock) -> FloatArray:
    """Milliseconds of each frame from driving signal to host memory, waiting for each frame."""
    return 1000 * np.asarray(list(_waited_for(drawing, stream, frames, limit_s, clock)))


def _waited_for(
    drawing: Drawing, stream: Stream, frames: int, limit_s: float, clock: Clock
) -> Iterator[float]:
    """Seconds of each synchronised frame, up to a number of frames or ``limit_s``."""
    synchronise = synchroniser()
    for frame in _within(islice(stream, frames), limit_s, clock):
        synchronise()
        start = clock()
        drawing.read_back(drawing.draw(*frame, WHITE, no_stage))
        yield clock() - start


def _within(frames: Iterable[Frame], limit_s: float, clock: Clock) -> Iterator[Frame]:
    """Render for a number of seconds, at least one frame."""
    begin = clock()
    for frame in frames:
        yield frame
        if clock() - begin >= limit_s:
            break


def throughput(
    drawing: Drawing, stream: Stream, frames: int, limit_s: float, depth: int, clock: Clock
) -> float:
    """Frames per second with up to ``depth`` frames in flight before the oldest is waited for."""
    under_way: deque[Any] = deque()
    drawn = 0
    synchroniser()()
    begin = clock()
    for frame in _within(islice(stream, frames), limit_s, clock):
        under_way.append(drawing.draw(*frame, WHITE, no_stage))
        drawn += 1
        if len(under_way) > depth:
            drawing.read_back(under_way.popleft())
    while under_way:
        drawing.read_back(under_way.popleft())
    return drawn / (clock() - begin)


def stage_times(
    drawing: Drawing, stream: Stream, frames: int, limit_s: float, clock: Clock
) -> dict[str, float]:
    """Median milliseconds of each stage and of reading back, with synchronisation after each.

    Synchronised stages cannot overlap, so their sum may exceed the time of a frame. Raises
    `InputError` for a stage that is not in `STAGES`.
    """
    times: dict[str, list[float]] = {}
    synchronise = synchroniser()
    last = clock()

    def end_stage(stage: str) -> None:
        nonlocal last
        if stage not in (*STAGES, READ_BACK):
            raise InputError("avatar", "draw, stage", ", ".join(STAGES), repr(stage))
        synchronise()
        times.setdefault(stage, []).append(1000 * (clock() - last))
        last = clock()

    for frame in _within(islice(stream, frames), limit_s, clock):
        synchronise()
        last = clock()
        # A copy started by `draw` after its last stage counts as reading back.
        drawing.read_back(drawing.draw(*frame, WHITE, end_stage))
        end_stage(READ_BACK)
    return {stage: float(np.median(values)) for stage, values in times.items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread, and with it the kernels, which use torch's number."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchroniser() -> Callable[[], None]:
    """Return a function that synchronises the accelerator; it does nothing if torch does not use one.

    It synchronises torch's current device, which `use_device` has set to the avatar's.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        wait: Callable[[], None] = torch.cuda.synchronize
        return wait
    return lambda: None
