"""Feature planes sampled at points, with an adjoint written for the CPU.

A plane is kept as (R * R, C): row ``y * R + x`` holds the C channels of one sample side by side, so that a point
reads four short rows instead of 4 C scattered numbers.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

PAIRS = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
"""Planes in the order of their features: name, coordinate along the width, coordinate along the height."""


class _SamplePlane(torch.autograd.Function):
    """Bilinear, align-corners, border padding, as ``torch.nn.functional.grid_sample`` defines them."""

    @staticmethod
    def forward(ctx: Any, plane: Tensor, coordinates: Tensor, resolution: int) -> Tensor:
        position = (coordinates + 1) * (0.5 * (resolution - 1))
        clipped = position.clamp(0, resolution - 1)
        corner = clipped.floor().clamp_max(resolution - 2)
        fraction = clipped - corner
        u, v = fraction.unbind(1)
        column, row = corner.to(torch.int64).unbind(1)
        first = row * resolution + column
        indices = torch.stack([first, first + 1, first + resolution, first + resolution + 1], dim=1)
        weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=1)
        ctx.save_for_backward(plane, indices, weights, fraction, position == clipped)
        ctx.resolution = resolution
        return torch.nn.functional.embedding_bag(indices, plane, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plane, indices, weights, fraction, inside = ctx.saved_tensors
        gradient = grads[0]
        by_plane = by_coordinates = None
        if ctx.needs_input_grad[0]:
            by_plane = torch.zeros_like(plane)
            for corner in range(4):
                by_plane.index_add_(0, indices[:, corner], gradient * weights[:, corner : corner + 1])
        if ctx.needs_input_grad[1]:
            a, b, c, d = (
                (plane.index_select(0, indices[:, corner]) * gradient).sum(1) for corner in range(4)
            )
            u, v = fraction.unbind(1)
            slopes = torch.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], dim=1)
            by_coordinates = slopes * inside * (0.5 * (ctx.resolution - 1))
        return by_plane, by_coordinates, None


FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
ENCODING_SIZE = 3 + 2 * 3 * len(FREQUENCIES)


def sample_plane(plane: Tensor, coordinates: Tensor, resolution: int) -> Tensor:
    """Features (N, C) of a (R * R, C) plane at (N, 2) coordinates in [-1, 1], width first; clamped outside."""
    return _SamplePlane.apply(plane, coordinates, resolution)  # type: ignore[no-untyped-call]


def sample_triplane(planes: dict[str, Tensor], points: Tensor, resolution: int) -> Tensor:
    """Concatenated features of the three planes at (N, 3) points in [-1, 1], in the order of `PAIRS`."""
    features = [
        sample_plane(planes[name], points[:, [width, height]], resolution) for name, width, height in PAIRS
    ]
    return torch.cat(features, dim=1)


def encode_directions(directions: Tensor) -> Tensor:
    """(N, 27) positional encoding of (N, 3) unit vectors: identity, then sin and cos at 1, 2, 4, 8 (no pi)."""
    frequencies = directions.new_tensor(FREQUENCIES)
    angles = frequencies[:, None] * directions[:, None, :]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=2)
    return torch.cat([directions, waves.flatten(1)], dim=1)
