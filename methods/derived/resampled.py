"""Planes and lines with fewer samples: those from which interpolation gives back the most of what there was."""

from __future__ import annotations

import torch
from torch import Tensor

from ..shared.triplane import PAIRS


def coarser_planes(tensors: dict[str, Tensor], resolution: int) -> dict[str, Tensor]:
    """The same tensors with (resolution^2, C) planes; unchanged where they have no more samples."""
    result = dict(tensors)
    for name, _, _ in PAIRS:
        key = f"plane_{name}"
        if key in result:
            result[key] = _coarser_plane(result[key], resolution)
    return result


def coarser_lines(tensors: dict[str, Tensor], resolution: int) -> dict[str, Tensor]:
    """The same tensors with lines of (K, 3, resolution, C); unchanged where they have no more samples."""
    lines = tensors.get("lines")
    if lines is None or lines.shape[2] <= resolution:
        return dict(tensors)
    fit = fitting_matrix(lines.shape[2], resolution).to(lines)
    return {**tensors, "lines": torch.einsum("rl,kalc->karc", fit, lines).contiguous()}


def _coarser_plane(plane: Tensor, resolution: int) -> Tensor:
    side = round(len(plane) ** 0.5)
    if side <= resolution:
        return plane
    fit = fitting_matrix(side, resolution).to(plane)
    image = plane.reshape(side, side, -1)
    return torch.einsum("ry,sx,yxc->rsc", fit, fit, image).reshape(resolution**2, -1).contiguous()


def fitting_matrix(samples: int, fewer: int) -> Tensor:
    """(fewer, samples) float64: takes samples to the fewer ones that interpolate back to them in least squares.

    Samples lie evenly with the outermost on the ends (align-corners), ``fewer`` from 2 to ``samples``.
    """
    places = torch.linspace(0, fewer - 1, samples, dtype=torch.float64)
    nodes = torch.arange(fewer, dtype=torch.float64)
    interpolation = (1 - (places[:, None] - nodes).abs()).clamp_min(0)
    return torch.linalg.pinv(interpolation)
