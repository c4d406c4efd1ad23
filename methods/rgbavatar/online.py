"""Local-global sampling: training while frames arrive, with the published sizes of pools."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..shared.schedule import Batches, numpy_generator
from .config import LOCAL

GLOBAL = 1_000
"""Size of the global pool: frames kept of those older than the newest `LOCAL`."""
MOST_GLOBAL, RAMP = 0.7, 599
"""Maximum share of draws from the global pool, and the number of older frames at which it is reached."""


class OnlineBatches(Batches):
    """Batches of the images that have arrived so far, mostly the newest.

    Each draw is from the global pool with a probability that rises with the number of older images, else from the newest
    `LOCAL`, where newer ones are more probable. The global pool is a uniform sample of `GLOBAL` older images
    (reservoir sampling; Vitter, ACM TOMS 1985, algorithm R).

    Parameters
    ----------
    order : Sequence[int]
        Indices of the images in the order of their arrival.
    size : int
        Images of a batch, at most `LOCAL`; fewer before that many have arrived.
    trained : int
        Images trained on for each that arrives.
    """

    def __init__(self, order: Sequence[int], size: int, trained: int, seed: int):
        super().__init__(size)
        self._images, self._trained, self._seed = tuple(order), trained, seed
        self._kept: list[int] = []
        self._passed = 0

    def arrived(self, iteration: int) -> int:
        """Number of images available to a batch; those of the first batch are available from the start."""
        return min(len(self._images), self._size + (iteration - 1) * self._size // self._trained)

    def batch(self, iteration: int) -> tuple[int, ...]:
        """The images of a batch, each once."""
        random, arrived = numpy_generator(self._seed, "online", iteration), self.arrived(iteration)
        older = max(arrived - LOCAL, 0)
        size = min(self._size, arrived)
        share = MOST_GLOBAL * min(older / RAMP, 1.0)
        kept = self._older(older)
        from_older = min(int((random.random(size) < share).sum()), len(kept))
        newest = np.arange(older, arrived)
        weights = np.exp((np.arange(len(newest)) + LOCAL - len(newest)) / LOCAL)
        places = random.choice(newest, size - from_older, replace=False, p=weights / weights.sum()).tolist()
        places += random.choice(kept, from_older, replace=False).tolist() if from_older else []
        return tuple(self._images[place] for place in places)

    def _older(self, count: int) -> list[int]:
        """Places of the kept images among the first ``count``."""
        if count < self._passed:
            self._kept, self._passed = [], 0
        for place in range(self._passed, count):
            if place < GLOBAL:
                self._kept.append(place)
                continue
            replaced = int(numpy_generator(self._seed, "reservoir", place).integers(place + 1))
            if replaced < GLOBAL:
                self._kept[replaced] = place
        self._passed = count
        return self._kept
