"""Random numbers as pure functions of the run's seed, a named stream and a position in it.

Nothing draws from a global generator, and no generator lives longer than the call it serves. So a resumed run
needs no generator state: what iteration 1000 draws does not depend on how training came to iteration 1000.
"""

from __future__ import annotations

import zlib

import numpy as np
import torch


def numpy_generator(seed: int, stream: str, position: int = 0) -> np.random.Generator:
    """Generator for one draw (or one block of draws) of a stream."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode()), position])


def torch_generator(seed: int, stream: str, position: int = 0) -> torch.Generator:
    """CPU generator for one draw of a stream; drawing on the CPU gives the same numbers for every device."""
    state = int(numpy_generator(seed, stream, position).integers(2**63))
    return torch.Generator().manual_seed(state)
