"""Training schedules: iterations of the published run as fractions of the budget."""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch

from ...bench.contracts import IntArray
from .config import DensifiedTraining, HarmonicsTraining


@dataclass(frozen=True)
class Timeline:
    """Maps iterations of the published run onto a run of ``total`` iterations, numbered from 1.

    ``published``: iterations of the run that the settings were written for.
    """

    total: int
    published: int

    def at(self, moment: int) -> int:
        """Iteration of the actual run that corresponds to a published one."""
        return round(moment * self.total / self.published)

    def every(self, interval: int, minimum: int = 1) -> int:
        """Interval of the actual run that corresponds to a published one, at least ``minimum``."""
        return max(minimum, self.at(interval), 1)

    def fraction(self, iteration: int) -> float:
        """Relative position of an iteration in the run, in (0, 1]."""
        return iteration / self.total

    def decay(self, iteration: int, final: float) -> float:
        """Factor of a learning rate that falls from 1 to ``final``, log-linear over the last half of the run."""
        return log_linear(1.0, final, 2 * self.fraction(iteration) - 1)

    def sh_degree(self, settings: HarmonicsTraining, iteration: int) -> int:
        """Degree of the spherical harmonics in an iteration."""
        return min(settings.sh_degree, iteration // self.every(settings.sh_every, settings.min_sh_every))


def log_linear(start: float, end: float, fraction: float) -> float:
    """Interpolate the logarithm; the position learning rate of 3DGS. ``fraction`` is clipped to [0, 1]."""
    fraction = min(max(fraction, 0.0), 1.0)
    return math.exp((1 - fraction) * math.log(start) + fraction * math.log(end))


RECOVERY = 1_000
"""Minimum iterations after a reset in runs shorter than published: opacities take several hundred to recover."""


@dataclass(frozen=True)
class DensifySchedule:
    """Rounds of densification and opacity reset in one run.

    With the published 600,000 iterations: rounds at 12,000, 14,000, ... 598,000; resets at 10,000, 60,000,
    120,000, ... 540,000. A shorter run keeps the fractions until an interval would fall below its minimum; a run
    shorter than the minimum reset interval has no reset at all, and the last `RECOVERY` iterations have none.
    """

    start: int
    every: int
    stop: int  # first iteration without rounds or resets
    reset_stop: int  # first iteration without resets
    reset_every: int | None
    first_reset: int | None
    prune_extent_from: int

    @classmethod
    def of(cls, settings: DensifiedTraining, timeline: Timeline, *, white: bool) -> DensifySchedule:
        """Scale the published schedule to a run; ``white`` is whether splats are trained on a white background."""
        long_enough = timeline.total > settings.min_reset_every
        whole = timeline.total >= settings.schedule_length
        settle, recovery = (1, 1) if whole else (settings.min_settle, RECOVERY)
        start = timeline.at(settings.densify_from)
        stop = min(timeline.at(settings.densify_until), timeline.total - settle + 1)
        return cls(
            start=start,
            every=timeline.every(settings.densify_every, settings.min_densify_every),
            stop=stop,
            reset_stop=min(stop, timeline.total - recovery + 1),
            reset_every=settings.reset_every
            and timeline.every(settings.reset_every, settings.min_reset_every),
            first_reset=start if settings.reset_at_start and white and long_enough else None,
            prune_extent_from=timeline.at(settings.prune_extent_from),
        )

    def gathers(self, iteration: int) -> bool:
        """Whether gradients of this iteration are used by a later round."""
        return iteration < self.stop

    def is_round(self, iteration: int) -> bool:
        """Whether this iteration clones, splits and prunes."""
        return self.start < iteration < self.stop and iteration % self.every == 0

    def is_reset(self, iteration: int) -> bool:
        """Whether this iteration resets opacities."""
        if iteration >= self.reset_stop:
            return False
        regular = self.reset_every is not None and iteration % self.reset_every == 0
        return regular or iteration == self.first_reset

    def prunes_large(self, iteration: int) -> bool:
        """Whether a round at this iteration also removes splats that are large in the world."""
        return iteration > self.prune_extent_from


BLOCK = 1024  # draws with replacement are made in blocks of this many


class Sampler(Protocol):
    """Returns the image index for an iteration. Has no state that training changes."""

    def __call__(self, iteration: int) -> int: ...


class ShuffledEpochs:
    """Every image once per epoch, in a new random order each epoch. Iterations are numbered from 1."""

    def __init__(self, count: int, seed: int):
        self._count = count
        self._order = lru_cache(maxsize=2)(
            lambda epoch: numpy_generator(seed, "epoch", epoch).permutation(count)
        )

    def __call__(self, iteration: int) -> int:
        epoch, position = divmod(iteration - 1, self._count)
        return int(self._order(epoch)[position])


class Weighted:
    """Draws with replacement by probability. Iterations are numbered from 1.

    ``weights``: (n,) non-negative, at least one positive.
    """

    def __init__(self, weights: Sequence[float] | np.ndarray, seed: int):
        probabilities = np.asarray(weights, dtype=np.float64)
        probabilities = probabilities / probabilities.sum()
        self._draws = lru_cache(maxsize=2)(
            lambda block: numpy_generator(seed, "draws", block).choice(
                len(probabilities), size=BLOCK, p=probabilities
            )
        )

    def __call__(self, iteration: int) -> int:
        block, position = divmod(iteration - 1, BLOCK)
        return int(self._draws(block)[position])


class Batches:
    """Batches of up to ``size`` images, numbered from 1; a derived class draws them.

    As a `Sampler` it gives the images of the batches one after another; every batch occupies ``size`` numbers.
    """

    def __init__(self, size: int):
        self._size = size

    def batch(self, iteration: int) -> tuple[int, ...]:
        """The images of a batch; depends on ``iteration`` alone."""
        raise NotImplementedError

    def positions(self, iteration: int) -> list[tuple[int, int]]:
        """Position (as numbered by the sampler) and index of each image of a batch."""
        batch, end = self.batch(iteration), iteration * self._size
        numbers = [*range(end - self._size + 1, end - self._size + len(batch)), end]
        return list(zip(numbers, batch))

    def __call__(self, iteration: int) -> int:
        batch, member = divmod(iteration - 1, self._size)
        images = self.batch(batch + 1)
        return images[min(member, len(images) - 1)]


class GroupedBatches(Batches):
    """Each image once per epoch, in a new random order each epoch.

    - ``groups``: (n,) group of each image, such as its timestep.
    - ``size``: images of a batch; the last one of an epoch may have fewer.
    - ``together``: number of consecutive images from one group, if it has that many.
    """

    def __init__(self, groups: Sequence[int], size: int, together: int, seed: int):
        super().__init__(size)
        self._groups, self._together, self._seed = np.asarray(groups), together, seed
        self._epoch = -(-len(groups) // size)
        self._order = lru_cache(maxsize=2)(self._batches)

    def batch(self, iteration: int) -> tuple[int, ...]:
        """The images of a batch."""
        epoch, position = divmod(iteration - 1, self._epoch)
        return self._order(epoch)[position]

    def _batches(self, epoch: int) -> list[tuple[int, ...]]:
        random = numpy_generator(self._seed, "batches", epoch)
        order = random.permutation(len(self._groups))
        chunks = []
        for group in np.unique(self._groups):
            images = order[self._groups[order] == group]
            chunks += [images[at : at + self._together] for at in range(0, len(images), self._together)]
        chunks = [chunks[at] for at in random.permutation(len(chunks))]
        # Incomplete groups come last, so that they do not shift those after them.
        images = np.concatenate(sorted(chunks, key=len, reverse=True))
        return [tuple(map(int, images[at : at + self._size])) for at in range(0, len(images), self._size)]


def balanced_weights(timestep_of_image: IntArray, class_of_timestep: dict[int, int]) -> np.ndarray:
    """Weight of each image: 1 / (number of timesteps in its class).

    All classes of expressions thus have the same share, regardless of their number of timesteps; "3D Gaussian Head
    Avatars with Expressive Dynamic Appearances", section 3.4.
    """
    sizes = Counter(class_of_timestep.values())
    return np.array([1.0 / sizes[class_of_timestep[int(t)]] for t in timestep_of_image])


def numpy_generator(seed: int, stream: str, position: int = 0) -> np.random.Generator:
    """Generator for one draw (or one block of draws) of a stream."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode()), position])


def torch_generator(seed: int, stream: str, position: int = 0) -> torch.Generator:
    """CPU generator for one draw of a stream; drawing on the CPU gives the same numbers for every device."""
    state = int(numpy_generator(seed, stream, position).integers(2**63))
    return torch.Generator().manual_seed(state)
