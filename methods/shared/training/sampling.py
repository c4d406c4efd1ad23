"""Which training image each iteration sees, as a pure function of seed and iteration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np

from ....bench.contracts import IntArray
from ..seeds import numpy_generator

BLOCK = 1024  # draws with replacement are made in blocks of this many


class Sampler(Protocol):
    """Gives the index of the image for an iteration. Holds no state that training changes."""

    def __call__(self, iteration: int) -> int: ...


class ShuffledEpochs:
    """Every image once per epoch, in an order of its own each epoch. Iterations count from 1."""

    def __init__(self, count: int, seed: int):
        self._count = count
        self._order = lru_cache(maxsize=2)(
            lambda epoch: numpy_generator(seed, "epoch", epoch).permutation(count)
        )

    def __call__(self, iteration: int) -> int:
        epoch, position = divmod(iteration - 1, self._count)
        return int(self._order(epoch)[position])


class Weighted:
    """Draws with replacement by probability. Iterations count from 1.

    Parameters
    ----------
    weights : (n,) not negative, not all zero.
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


def balanced_weights(timestep_of_image: IntArray, class_of_timestep: dict[int, int]) -> np.ndarray:
    """Weight of each image: 1 / (number of timesteps in its class).

    So a class of expressions has the same share however often it was recorded; "3D Gaussian Head Avatars with
    Expressive Dynamic Appearances", section 3.4.
    """
    sizes: dict[int, int] = {}
    for label in class_of_timestep.values():
        sizes[label] = sizes.get(label, 0) + 1
    return np.array([1.0 / sizes[class_of_timestep[int(t)]] for t in timestep_of_image])
