"""The training loop of all methods: budget, sampling, steps, progress, checkpoints."""

from __future__ import annotations

import gc
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Budget, ByteArray, Clip, FrameKey, Progress
from ...bench.errors import InputError
from ...bench.io.files import reading
from ...bench.native.dispatch import is_cuda, pinned, to_device
from ..splats.cpu import instruction_sets
from .optimisation import Optimiser
from .schedule import Sampler, Timeline
from .tensor_files import REMEDY, load_checkpoint, save_checkpoint
from .threads import torch_on_one_thread

CHECKPOINT = "checkpoint.safetensors"
log = logging.getLogger(__name__)
TIMED_STEPS = 5  # steps timed to turn seconds into iterations
COST_GROWTH = 1.6  # estimated cost of a late step relative to an early one, because there are more splats
ESTIMATED_AGAIN = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4)
"""Fractions of a time budget at which iterations are re-estimated: the first steps also read images and fill caches."""
REPORT_EVERY = 10  # iterations between reads of the loss, each of which waits for the device


class Trainable(Protocol):
    """Trainable part of a method. Random numbers are drawn by iteration (`schedule`), never from a global state."""

    @property
    def optimiser(self) -> Optimiser: ...

    def begin(self, timeline: Timeline) -> None:
        """Scale schedules to the length of the run. Called first, possibly more than once."""

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss for training image ``index``. Must not change the state of training."""

    def after_backward(self, iteration: int) -> None:
        """Hook between gradients and step: densification, resets, learning rates."""

    def state(self) -> dict[str, Any]:
        """All state that training changes, as tensors and plain containers."""

    def load_state(self, state: dict[str, Any]) -> None: ...

    def note(self) -> str:
        """Short description of the state of training, for progress."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Request to train a method."""

    clip: Clip

    out: Path
    """Folder of the avatar, its checkpoint and its record."""
    budget: Budget
    device: str
    seed: int
    progress: Progress

    run: str
    """Digest of everything that affects training; a checkpoint with another digest is refused."""
    clock: Callable[[], float] = time.monotonic
    """Clock in seconds with any origin, for budgets in seconds."""
    began: float | None = None
    """Reading of the clock before anything was prepared for the training, so that the preparation counts as training time; by
    default counting begins with the first iteration."""
    capacity: Mapping[str, Any] | None = None
    """The planned sizes, for the record."""


@dataclass(frozen=True)
class TrainingSummary:
    """Summary of a training: iterations done and planned, and seconds including interrupted parts.

    ``losses`` are pairs of an iteration and the loss of its image, from every `REPORT_EVERY`-th iteration, the first and the last planned one.
    """

    iterations: int
    planned: int
    seconds: float
    losses: Sequence[tuple[int, float]] = ()


def train(
    trainable: Trainable,
    sampler: Sampler,
    fit: Fit,
    *,
    published_length: int,
    checkpoint_every_s: float,
    cost_growth: float = COST_GROWTH,
) -> TrainingSummary:
    """Train until the budget is spent; continue from the checkpoint in ``fit.out`` if it is of the same run.

    One iteration is: loss of one image, gradients, `after_backward` (densification), Adam step; the last
    iteration has no Adam step, as published. A killed and continued run gives bit-identical results to an
    uninterrupted one on the same machine, unless the budget is in seconds, where the number of iterations depends on
    the clock.

    - ``published_length``: iterations of the published run (`Timeline`).
    - ``cost_growth``: estimated cost of a late step relative to an early one, to turn a budget in seconds into iterations; 1
      for a constant number of splats. The estimate is repeated after the parts `ESTIMATED_AGAIN` of the seconds.
    """
    budget, clock = fit.budget, fit.clock
    check_budget(budget)
    path, compiled = fit.out / CHECKPOINT, bool(instruction_sets())
    wait = synchroniser(fit.device)
    saved = load_checkpoint(path, fit.run, fit.device)
    # For a resumed training, preparation was counted before.
    started = clock() if fit.began is None or saved is not None else fit.began
    losses: list[tuple[int, float]] = []
    if saved is None:
        iteration, spent = 0, 0.0
        total = budget.iterations
        if total is None:
            assert budget.seconds is not None
            left = budget.seconds - (clock() - started)
            with torch_on_one_thread(compiled):
                total = _estimate(trainable, sampler, left, published_length, cost_growth, clock, wait)
        trainable.begin(Timeline(total, published_length))
    else:
        with reading(path, "the state of this method", "state", REMEDY):
            iteration, total, spent = int(saved["iteration"]), int(saved["total"]), float(saved["seconds"])
            trainable.begin(Timeline(total, published_length))
            trainable.load_state(saved["trainable"])
            losses += [(int(at), float(value)) for at, value in saved["losses"]]
    estimated = "" if budget.iterations else f"{total} iterations estimated; "

    def seconds() -> float:
        return spent + clock() - started

    last_save = clock()
    timed_from = iteration, seconds()
    limit = 0.0 if budget.iterations else budget.seconds or 0.0
    moments = [moment for part in ESTIMATED_AGAIN if (moment := part * limit) > timed_from[1]]
    with torch_on_one_thread(compiled), _collecting_new_objects():
        while iteration < total:
            if budget.seconds is not None:
                now = seconds()
                if now >= budget.seconds and iteration > 0:
                    break
                if moments and now >= moments[0] and iteration > timed_from[0]:
                    wait()
                    now = seconds()
                    moments = [moment for moment in moments if moment > now]
                    pace = (now - timed_from[1]) / (iteration - timed_from[0])
                    left = max(budget.seconds - now, 0.0)
                    # The remaining growth, which is less than that over a whole run.
                    more = _in_seconds(left, pace * cost_growth ** (left / budget.seconds))
                    total, timed_from = iteration + more, (iteration, now)
                    trainable.begin(Timeline(total, published_length))
                    estimated = f"{total} iterations estimated; "
            iteration += 1
            loss = trainable.loss(iteration, sampler(iteration))
            loss.backward()
            note = ""
            if iteration % REPORT_EVERY == 0 or iteration in (1, total):
                value = loss.item()
                if not math.isfinite(value):
                    remedy = "Training diverged; check the tracking (NaN?) or lower the learning rates."
                    raise InputError(fit.out, f"iteration {iteration}", "a finite loss", str(value), remedy)
                losses.append((iteration, value))
                note = f"{estimated}loss {value:.4f}; "
            trainable.after_backward(iteration)
            if iteration < total:
                trainable.optimiser.step()
            trainable.optimiser.zero_grad()
            if clock() - last_save >= checkpoint_every_s and iteration < total:
                done = {"iteration": iteration, "total": total, "seconds": seconds(), "losses": losses}
                save_checkpoint(path, fit.run, {**done, "trainable": trainable.state()})
                last_save = clock()
            fit.progress(iteration, total, note + trainable.note() if note else "")
    wait()
    if iteration == 1 and limit:
        log.warning("the limit of %g s left no time for a step: the avatar is as it was at the start", limit)
    return TrainingSummary(iteration, total, seconds(), losses)


@contextmanager
def _collecting_new_objects() -> Iterator[None]:
    """Exempt all existing objects from garbage collection, which would traverse the imported modules every few iterations."""
    gc.collect()  # frozen garbage, such as an earlier cell's, would stay in memory
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def synchroniser(device: str) -> Callable[[], None]:
    """Function that waits for the work of a CUDA device; it does nothing for other devices."""
    return partial(torch.cuda.synchronize, device) if is_cuda(device) else lambda: None


def check_budget(budget: Budget) -> None:
    """Raise `InputError` for a budget without a limit."""
    if budget.iterations is None and budget.seconds is None:
        raise InputError("budget", "", "iterations, seconds or both", "neither")
    for name in ("iterations", "seconds"):
        value = getattr(budget, name)
        if value is not None and not value > 0:
            raise InputError("budget", name, "a positive number", str(value))


def _estimate(
    trainable: Trainable,
    sampler: Sampler,
    seconds: float,
    published_length: int,
    cost_growth: float,
    clock: Callable[[], float],
    wait: Callable[[], None],
) -> int:
    """Number of iterations in a number of seconds, at least one, estimated from a few steps whose effect is discarded."""
    trainable.begin(Timeline(published_length, published_length))
    # With a constant number of splats, steps late in the run have all parts of the model.
    step_number = 1 if cost_growth > 1 else published_length
    durations = []
    for step in range(1, TIMED_STEPS + 2):
        wait()
        before = clock()
        trainable.loss(step_number, sampler(step)).backward()
        trainable.optimiser.zero_grad()
        wait()
        durations.append(clock() - before)
    # The first step pays for lazy initialisation; the median of the rest is robust to an outlier.
    typical = sorted(durations[1:])[TIMED_STEPS // 2]
    return _in_seconds(seconds, typical * cost_growth)


def _in_seconds(seconds: float, cost: float) -> int:
    """Number of iterations of a ``cost`` in seconds, at least one."""
    return max(1, int(seconds / max(cost, 1e-6)))


class TrainingImages:
    """Images of a clip by index. Keeps at most two images; the clip may cache others.

    ``clip.image`` and ``clip.mask`` are called from a thread, one call at a time.

    ``masks``: whether images have a fourth channel, the foreground coverage.
    """

    def __init__(
        self, clip: Clip, keys: Sequence[FrameKey], sampler: Sampler, device: str, *, masks: bool = False
    ):
        self._clip, self._keys, self._sampler, self._device = clip, keys, sampler, device
        self._masks = masks
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
        self._ahead: tuple[int, Future[Tensor]] | None = None

    def get(self, iteration: int, index: int) -> Tensor:
        """(H, W, 3 or 4) float32 in [0, 1]; starts decoding the image of the next iteration."""
        if self._ahead is None or self._ahead[0] != index:
            self._ahead = (index, self._pool.submit(self._load, index))
        image = self._ahead[1].result()
        following = self._sampler(iteration + 1)
        self._ahead = (following, self._pool.submit(self._load, following))
        return to_device(image, self._device).to(torch.float32).div_(255)

    def close(self) -> None:
        """Stop the decoding thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _load(self, index: int) -> Tensor:
        key = self._keys[index]
        image = self._clip.image(key)
        camera = self._clip.cameras[key.camera]
        image = _checked(key, "image", image, (camera.height, camera.width, 3))
        if self._masks:
            image = np.dstack([image, _checked(key, "mask", self._clip.mask(key), image.shape[:2])])
        # A clip's images may be read-only and shared; torch requires writable arrays.
        return pinned(torch.from_numpy(np.array(image, copy=True)), self._device)


def _checked(key: FrameKey, name: str, pixels: ByteArray | None, shape: tuple[int, ...]) -> ByteArray:
    if pixels is None or pixels.shape != shape or pixels.dtype != np.uint8:
        found = "none" if pixels is None else f"{pixels.dtype} of shape {pixels.shape}"
        raise InputError(str(key), name, f"uint8 of shape {shape}", found)
    return pixels


def recomposited(image: Tensor, coverage: Tensor, recorded_on: Tensor, background: Tensor) -> Tensor:
    """Colours (..., 3) on another background than the recorded one; ``coverage`` is (..., 1) in [0, 1]."""
    return image + (1 - coverage) * (background - recorded_on)


def check_training_split(clip: Clip) -> None:
    """Raise `InputError` unless the clip has training frames, and all have a pose of its head model and a camera."""
    where, version = f"clip of {clip.subject}", clip.head.version
    if not clip.splits.get("train"):
        raise InputError(where, "splits[train]", "at least one frame", "none")
    for key in clip.splits["train"]:
        if key.camera not in clip.cameras:
            raise InputError(where, str(key), "a known camera", repr(key.camera))
        pose = clip.poses.get(key.timestep)
        if pose is None:
            raise InputError(where, str(key), "a tracked pose", "none")
        if pose.head_model != version:
            raise InputError(where, f"poses[{key.timestep}].head_model", repr(version), repr(pose.head_model))
