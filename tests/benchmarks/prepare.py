"""How fast recordings are prepared, next to a plain OpenCV loop in the same run, and in how much memory.

The loop does for one camera after the other what prepare does to videos without masks: decode, average areas,
encode as PNG. Rounds of both take turns, so that other work on the machine meets both; ratios are of the best
rounds. Memory is the peak of a process of its own per length.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, Progress, no_progress
from ...bench.io.video import video_codec
from ...bench.machine import processor_count
from ...bench.specs import Findings
from ...datasets.nersemble.command import PrepareSettings, prepare_nersemble
from ...datasets.nersemble.re_record import RecordingWriter
from ...datasets.synthetic.plan import cameras

SUBJECT = "999"
SEQUENCE = "EMO-1-shout+laugh"
DOWNSCALE, EVERY = 4, 3
MEMORY_FRAMES = (30, 120)
MEMORY_MARGIN = 1.1
"""Largest ratio of the peaks of a long and a short sequence that counts as independent of the length."""


class _Size(NamedTuple):
    """How much is prepared: image size, cameras, frames of each video, rounds."""

    width: int
    height: int
    cameras: int
    frames: int
    rounds: int


_FULL, _QUICK = _Size(2200, 3208, 4, 45, 3), _Size(1100, 1604, 2, 18, 2)


class _Timed(NamedTuple):
    seconds: float
    processor_seconds: float
    images: int


def measure(quick: bool, progress: Progress = no_progress) -> Findings:
    """`BenchmarkSpec.speed`; passed where the peak memory does not grow with the length of the sequence."""
    size = _QUICK if quick else _FULL
    rows: dict[str, list[_Timed]] = {}
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        videos = _record(base / "videos", size, masks=False)
        images = _record(base / "images", size._replace(frames=size.frames // EVERY), masks=True)
        everyone = processor_count()
        ways: dict[str, Callable[[Path], int]] = {
            "video: plain OpenCV loop": lambda out: _plain_loop(videos, out, size),
            "video: prepare, 1 worker": lambda out: _prepare(videos, out, 1),
            f"video: prepare, {everyone} workers": lambda out: _prepare(videos, out, everyone),
            f"images, masks, stills, colours: prepare, {everyone} workers": lambda out: _prepare(
                images, out, everyone, every=1
            ),
        }
        total = size.rounds * len(ways) + len(MEMORY_FRAMES)
        for number in range(size.rounds):
            for position, (name, way) in enumerate(ways.items()):
                out = base / f"out-{number}-{position}"
                rows.setdefault(name, []).append(_time(way, out))
                progress(number * len(ways) + position + 1, total, name)
        peaks = {}
        for number, frames in enumerate(MEMORY_FRAMES):
            small = size._replace(cameras=2, frames=frames)
            recording = _record(base / f"memory-{frames}", small, masks=False)
            peaks[frames] = _peak_of_prepare(recording, base / f"memory-out-{frames}")
            progress(size.rounds * len(ways) + number + 1, total, f"memory of {frames} frames")
    return _findings(size, rows, peaks)


def _record(root: Path, size: _Size, *, masks: bool) -> Path:
    """A recording of smooth moving noise, which costs about what faces do to decode and to encode."""
    rig = [*cameras(size.cameras, size.width, size.height, np.zeros(3)).values()]
    writer = RecordingWriter(root, SUBJECT, rig)
    writer.write_calibration()
    pattern = _pattern(size)
    for camera in rig:
        if masks:
            coverage = _coverage(camera)
            for number, frame in enumerate(_moving(pattern, size.frames)):
                writer.write_frame(SEQUENCE, camera.id, number, frame, coverage)
            writer.write_background(camera.id, np.full_like(pattern, 128))
        else:
            writer.write_video(SEQUENCE, camera.id, _moving(pattern, size.frames))
    if masks:
        rng = np.random.default_rng(1)
        matrices = {camera.id: np.eye(3, 11) + 0.01 * rng.normal(size=(3, 11)) for camera in rig}
        writer.write_colour(matrices)
    return root


def _pattern(size: _Size) -> ByteArray:
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 255, (12, 8, 3)).astype(np.float32)
    smooth = cv2.resize(coarse, (size.width, size.height), interpolation=cv2.INTER_CUBIC)
    grain = rng.normal(0, 6, (size.height, size.width, 1))
    return np.clip(smooth + grain, 0, 255).astype(np.uint8)


def _moving(pattern: ByteArray, frames: int) -> Iterator[ByteArray]:
    return (np.roll(pattern, 3 * number, axis=1) for number in range(frames))


def _coverage(camera: Camera) -> ByteArray:
    ellipse = np.zeros((camera.height, camera.width), np.uint8)
    center, axes = (camera.width // 2, camera.height // 2), (camera.width // 3, camera.height // 3)
    cv2.ellipse(ellipse, center, axes, 0, 0, 360, 255, -1)
    return cv2.GaussianBlur(ellipse, (0, 0), 3).astype(np.uint8)


def _plain_loop(root: Path, out: Path, size: _Size) -> int:
    """What one writes without a tool; frames in between are skipped without conversion, as prepare does."""
    small = (size.width // DOWNSCALE, size.height // DOWNSCALE)
    out.mkdir()
    written = 0
    for index, path in enumerate(sorted(root.rglob("cam_*.mp4"))):
        capture = cv2.VideoCapture(str(path))
        number = 0
        while capture.grab():
            if number % EVERY == 0:
                _, frame = capture.retrieve()
                reduced = cv2.resize(frame, small, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(out / f"{number // EVERY:05d}_{index:02d}.png"), reduced)
                written += 1
            number += 1
        capture.release()
    return written


def _prepare(root: Path, out: Path, workers: int, every: int = EVERY) -> int:
    settings = PrepareSettings(
        root=str(root),
        out=str(out),
        subjects=SUBJECT,
        sequences=SEQUENCE,
        downscale=DOWNSCALE,
        every=every,
        workers=workers,
    )
    written: int = prepare_nersemble(settings).data[SUBJECT]["written"]
    return written


def _time(way: Callable[[Path], int], out: Path) -> _Timed:
    start, processor = time.perf_counter(), time.process_time()
    images = way(out)
    return _Timed(time.perf_counter() - start, time.process_time() - processor, images)


def _peak_of_prepare(root: Path, out: Path) -> int:
    """Peak memory in bytes of a process that prepares with two workers."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_prepare_and_report, (root, out))


def _prepare_and_report(root: Path, out: Path) -> int:
    _prepare(root, out, 2)
    status = Path("/proc/self/status")
    if status.exists():  # getrusage's peak survives exec and so counts the parent's memory too
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _findings(size: _Size, rows: dict[str, list[_Timed]], peaks: dict[int, int]) -> Findings:
    best = {name: _Timed(*(min(column) for column in zip(*runs))) for name, runs in rows.items()}
    plain = next(iter(best.values()))
    lines = [
        f"{size.cameras} videos of {size.width}x{size.height}, {size.frames} frames, {video_codec()}; "
        + f"to 1/{DOWNSCALE}, every {EVERY}rd frame; best of {size.rounds} rounds",
        f"{'':62} images/s  against the loop  processor ms/image",
    ]
    data: dict[str, Any] = {"codec": video_codec(), "cores": processor_count(), "rows": {}, "peaks": peaks}
    for name, timed in best.items():
        rate = timed.images / timed.seconds
        ratio = plain.seconds / plain.images * rate
        cost = 1000 * timed.processor_seconds / timed.images
        lines.append(f"{name:62} {rate:8.1f} {ratio:16.2f}x {cost:19.1f}")
        data["rows"][name] = {"images_per_s": rate, "ratio": ratio, "processor_ms": cost}
    short, long = (peaks[frames] for frames in MEMORY_FRAMES)
    lines.append(
        f"Peak memory, 2 workers: {short / 1e6:.0f} MB at {MEMORY_FRAMES[0]} frames, {long / 1e6:.0f} MB at "
        f"{MEMORY_FRAMES[1]} frames."
    )
    return Findings("\n".join(lines), data, passed=long <= MEMORY_MARGIN * short)
