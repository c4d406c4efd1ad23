"""Parts of a head that INSTA treats on their own."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset
from .warp import touching

MOUTH = ("lips", "teeth", "mouth_socket")
HAIR = ("hair", "scalp", "boundary")


def mouth_triangles(head: HeadAsset) -> Tensor:
    """(F,) bool: lips and what the head has inside the mouth."""
    return _any(head, MOUTH)


def bare_triangles(head: HeadAsset) -> Tensor:
    """(F,) bool: where the mesh is the visible surface; hair stands off it, and the boundary is cut."""
    hair = _any(head, HAIR)
    return ~hair | torch.from_numpy(touching(head, "face"))


def _any(head: HeadAsset, regions: tuple[str, ...]) -> Tensor:
    return torch.from_numpy(np.logical_or.reduce([touching(head, region) for region in regions]))
