"""Choice of the size of an avatar by short trainings that are evaluated on held-out training timesteps.

A method defines its sizes and smaller values to try; a smaller one is chosen if the held-out frames lose at most a
tolerance against the configured sizes. Test frames are not used.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...bench.contracts import Avatar, Budget, Clip, FrameKey, Progress
from ...bench.io.files import digest
from ...bench.io.images import quantise
from ...bench.protocol import evenly_with_ends
from .config import Capacity
from .loop import Fit
from .losses import picture_ssim, psnr, squared_error

log = logging.getLogger(__name__)
Config = TypeVar("Config")
FRAMES = 48
"""Maximum number of held-out frames that evaluate a trial, evenly spaced."""
HELD_OUT_SHARE = 8
"""Number of parts of each training sequence, of which the last is held out. A whole sequence does not represent the
others: with one held out, half the expressions seemed enough for `gbs`, and lost 0.7 dB in self-reenactment
(`docs/explanation/methods/gbs.md`)."""
LEAST_ITERATIONS = 500
"""Minimum iterations of a trial, if the training has as many, since shorter ones do not show what is learned later."""
FOLDER = "trials"


@dataclass(frozen=True)
class Size:
    """A size of an avatar: dotted name of the setting, and smaller values to try, descending.

    ``used`` returns the size that an avatar actually has. Values that the avatar with the configured sizes does not
    exceed are not tried, since its training was too short to test them. None stands for the configured size.
    """

    name: str
    values: tuple[int, ...]
    used: Callable[[Any], int] | None = None


@dataclass(frozen=True)
class Trial:
    """A setting and value that was tried, the result on the held-out frames, and whether it was chosen."""

    name: str
    value: int | None
    psnr: float
    ssim: float
    taken: bool


class HeldOut:
    """A `Clip` without the ends of its training sequences."""

    def __init__(self, clip: Clip):
        self._clip = clip
        self.held_out = held_out_frames(clip)
        left_out = frozenset(self.held_out)
        train = tuple(key for key in clip.splits["train"] if key not in left_out)
        self.splits = {"train": train}
        self.fingerprint = digest(clip.fingerprint, "held out", self.held_out)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clip, name)


def held_out_frames(clip: Clip) -> tuple[FrameKey, ...]:
    """The training frames of the last timesteps of each sequence with two or more; () without such sequences."""
    train = clip.splits["train"]
    sequences: dict[str, set[int]] = {}
    for key in train:
        sequences.setdefault(key.sequence, set()).add(key.timestep)
    chosen: set[int] = set()
    for timesteps in sequences.values():
        count = min(max(1, round(len(timesteps) / HELD_OUT_SHARE)), len(timesteps) - 1)
        chosen |= set(sorted(timesteps)[len(timesteps) - count :])
    return tuple(key for key in train if key.timestep in chosen)


def choose_sizes(
    fit: Fit,
    config: Config,
    capacity: Capacity,
    sizes: Sequence[Size],
    train: Callable[[Config, Clip, Path, Budget, Progress], Avatar],
) -> tuple[Config, tuple[Trial, ...]]:
    """The configuration with the smallest sufficient sizes, chosen one after the other, and the trials.

    Parameters
    ----------
    sizes : Sequence[Size]
        Sizes to choose one after another; for each, values are tried until the loss is too large.
    train : Callable
        Trains an avatar with a configuration on a clip into a folder, and resumes it after a kill.
    """
    clip = HeldOut(fit.clip)
    if not clip.held_out or not clip.splits["train"]:
        log.warning("only one timestep of training, so none can be held out; the configured sizes are used")
        return config, ()
    frames = evenly_with_ends(clip.held_out, FRAMES)
    budget = Budget(
        _trial_iterations(fit.budget.iterations, capacity.share),
        None if fit.budget.seconds is None else fit.budget.seconds * capacity.share,
    )

    def trained(candidate: Config, name: str = "", value: int | None = None) -> Avatar:
        what = "the configured sizes" if value is None else f"{name} {value}"

        def report(done: int, total: int, note: str = "") -> None:
            fit.progress(0, fit.budget.iterations or 1, f"trying {what}: {done} of {total}")

        folder = fit.out / FOLDER / digest(asdict(candidate))[:12]  # type: ignore[call-overload]
        return train(candidate, clip, folder, budget, report)

    configured = trained(config)
    most_psnr, most_ssim = _quality(configured, fit.clip, frames)
    trials = [Trial("", None, most_psnr, most_ssim, taken=True)]
    for size in sizes:
        for value in size.values:
            if size.used and value >= size.used(configured):
                continue
            candidate = with_size(config, size.name, value)
            psnr, ssim = _quality(trained(candidate, size.name, value), fit.clip, frames)
            holds = most_psnr - psnr <= capacity.tolerance_db and most_ssim - ssim <= capacity.tolerance_ssim
            trials.append(Trial(size.name, value, psnr, ssim, holds))
            log.info(
                "%s %d: %s", size.name, value, f"{psnr:.2f} dB" + ("" if holds else ", the loss is too large")
            )
            if not holds:
                break
            config = candidate
    return config, tuple(trials)


def _trial_iterations(iterations: int | None, share: float) -> int | None:
    return None if iterations is None else min(iterations, max(round(iterations * share), LEAST_ITERATIONS))


def with_size(config: Config, name: str, value: int) -> Config:
    """A configuration with another value of a setting, which may be in a group."""
    group, _, last = name.rpartition(".")
    changed = {last: value} if not group else {group: replace(getattr(config, group), **{last: value})}
    return replace(config, **changed)  # type: ignore[type-var]


def halves(configured: int | None, least: int, count: int = 2) -> tuple[int, ...]:
    """A half, a quarter and so on of a number, down to ``least``; none for None."""
    values = () if configured is None else tuple(configured >> power for power in range(1, count + 1))
    return tuple(value for value in values if value >= least)


def _quality(avatar: Avatar, clip: Clip, frames: Sequence[FrameKey]) -> tuple[float, float]:
    """Mean PSNR (dB, 100 at most) and SSIM of 8-bit renders over frames."""
    background = tuple(map(float, clip.background))
    found = []
    for key in frames:
        render = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], background)
        picture, truth = quantise(render.rgb), clip.image(key)
        found.append((min(psnr(squared_error(picture, truth)), 100.0), picture_ssim(picture, truth)))
    decibels, similarity = np.mean(found, axis=0)
    return float(decibels), float(similarity)
