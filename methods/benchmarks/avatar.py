"""``headbench doctor bench avatar``: frames of an untrained avatar of `ours` beside those of one of `ga` with the same splats."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from itertools import cycle, pairwise
from statistics import median

import torch

from ...bench.contracts import Progress, StagedAvatar
from ...bench.doctor import Row, findings, take_turns
from ...bench.specs import CommandResult
from ..shared.threads import torch_threads
from .untrained import MemoryClip, beside_ga, untrained

SIZES = ((20_000, 144, 208), (20_000, 550, 802), (60_000, 550, 802))
QUICK_SIZES = ((2_000, 72, 104),)
ROUNDS, QUICK_ROUNDS = 50, 3


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Time whole frames and their stages, a new pose and camera every frame."""
    sizes, rounds = (QUICK_SIZES, QUICK_ROUNDS) if quick else (SIZES, ROUNDS)
    frames: list[Row] = []
    stages: list[Row] = []
    for number, (count, width, height) in enumerate(sizes):
        progress(number, len(sizes), f"{count} splats, {width}x{height}")
        clip, ours = untrained(count, width, height)
        avatars = {"ours": ours, "ga": beside_ga(ours)}
        size = {"splats": count, "image": f"{width}x{height}"}
        for threads in (1, 2):
            runs = {name: frames_of(avatar, clip) for name, avatar in avatars.items()}
            with torch_threads(threads), torch.no_grad():
                seconds = take_turns(runs, rounds, time.process_time)
            ms = {f"{name} ms": 1e3 * median(each) for name, each in seconds.items()}
            frames.append({**size, "threads": threads, **ms, "ratio": ms["ours ms"] / ms["ga ms"]})
        stages += [
            {**size, "method": name, **stage_times(avatar, clip, rounds)} for name, avatar in avatars.items()
        ]
    note = (
        "Medians of processor ms, all threads together; of frames that take turns, of stages with one thread."
    )
    return findings({"Frames": frames, "Stages": stages}, note)


def frames_of(avatar: StagedAvatar, clip: MemoryClip) -> Callable[[], object]:
    """A function that draws the next frame, with a new pose and a new camera each time."""
    frames = zip(cycle(clip.cameras.values()), cycle(clip.poses.values()))
    return lambda: avatar.render(*next(frames))


def stage_times(avatar: StagedAvatar, clip: MemoryClip, rounds: int) -> dict[str, float]:
    """Medians of the stages that the avatar reports, in ms of one thread."""
    taken: defaultdict[str, list[float]] = defaultdict(list)
    marks: list[tuple[str, float]] = []

    def mark(name: str) -> None:
        marks.append((name, time.thread_time()))

    frames = zip(cycle(clip.cameras.values()), cycle(clip.poses.values()))
    with torch_threads(1), torch.no_grad():
        for _ in range(rounds):
            marks.clear()
            mark("begin")
            avatar.read_back(avatar.draw(*next(frames), (1.0, 1.0, 1.0), mark))
            mark("read back")
            for (_, before), (name, after) in pairwise(marks):
                taken[name].append(after - before)
    return {name: 1e3 * median(values) for name, values in taken.items()}
