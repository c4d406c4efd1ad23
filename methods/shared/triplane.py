"""Feature planes sampled at points.

A plane is kept as (R * R, C): row ``y * R + x`` holds the C channels of one sample side by side, so that a point
reads four short rows instead of 4 C scattered numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .row_sums import sum_rows

PAIRS = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
"""Planes in the order of their features: name, coordinate along the width, coordinate along the height."""


FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
ENCODING_SIZE = 3 + 2 * 3 * len(FREQUENCIES)


def sample_plane(plane: Tensor, coordinates: Tensor, resolution: int) -> Tensor:
    """Features (N, C) of a (R * R, C) plane at (N, 2) coordinates in [-1, 1], width first; clamped outside.

    Bilinear, align-corners, border padding, as ``torch.nn.functional.grid_sample`` defines them.
    """
    position = ((coordinates + 1) * (0.5 * (resolution - 1))).clamp(0, resolution - 1)
    corner = position.detach().floor().clamp_max(resolution - 2)
    u, v = (position - corner).unbind(1)
    column, row = corner.to(torch.int64).unbind(1)
    first = row * resolution + column
    indices = torch.stack([first, first + 1, first + resolution, first + resolution + 1], dim=1)
    weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=1)
    return sum_rows(plane, indices, weights)


def sample_triplane(planes: dict[str, Tensor], points: Tensor, resolution: int) -> tuple[Tensor, ...]:
    """Features of the three planes at (N, 3) points in [-1, 1], in the order of `PAIRS`."""
    return tuple(
        sample_plane(planes[name], points[:, [width, height]], resolution) for name, width, height in PAIRS
    )


def encode(values: Tensor) -> Tensor:
    """(N, 9 D) positional encoding of (N, D) values: identity, then sin and cos at 1, 2, 4, 8 (no pi)."""
    frequencies = values.new_tensor(FREQUENCIES)
    angles = frequencies[:, None] * values[:, None, :]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=2)
    return torch.cat([values, waves.flatten(1)], dim=1)


def encode_directions(directions: Tensor) -> Tensor:
    """(N, 27) positional encoding of (N, 3) unit vectors."""
    return encode(directions)
