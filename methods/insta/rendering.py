"""Rays through the field: marched in rounds, so that what is hidden is not evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .compositing import composite
from .field import Field, Parameters
from .marching import PosedSurface, Rays, Space


@dataclass(frozen=True, eq=False)
class Scene:
    """One pose of the head with rays into it.

    Attributes
    ----------
    condition : (K,) leading expression coefficients.
    """

    surface: PosedSurface
    condition: Tensor
    rays: Rays


class Rendered(NamedTuple):
    """What all rays of all scenes see, scene by scene."""

    color: Tensor  # (R, 3) not yet composited on anything
    transmittance: Tensor  # (R,)
    distance: Tensor  # (R,) metres, weighted by opacity
    fog: Tensor  # scalar, opacities of all samples added up
    samples: int


@dataclass(frozen=True)
class Marching:
    """How rays are sampled; see `InstaConfig`."""

    step: float
    round_samples: int
    stop_transmittance: float


def render_rays(
    field: Field,
    parameters: Parameters,
    scenes: Sequence[Scene],
    space: Space,
    mouth: Tensor,
    marching: Marching,
) -> Rendered:
    """March the rays of several poses together; differentiable in the parameters.

    Parameters
    ----------
    mouth : (F,) bool; where the nearest triangle is one of these the density depends on the expression.
    """
    device = parameters["table"].device
    counts = [len(scene.rays.origins) for scene in scenes]
    total = sum(counts)
    # The last row is what the density network sees outside the mouth.
    width = field.architecture.conditions
    conditions = torch.ones(len(scenes) + 1, width, device=device, dtype=parameters["table"].dtype)
    for number, scene in enumerate(scenes):
        conditions[number] = scene.condition[:width].to(conditions)
    color, fog = conditions.new_zeros(total, 3), conditions.new_zeros(())
    transmittance, distance = conditions.new_ones(total), conditions.new_zeros(total)
    first = [np.zeros(count, np.int32) for count in counts]
    evaluated = 0
    while any((numbers >= 0).any() for numbers in first):
        gathered = []
        offset = 0
        for number, scene in enumerate(scenes):
            if (first[number] >= 0).any():
                found = scene.surface.march(
                    scene.rays, first[number], marching.step, marching.round_samples, space
                )
                first[number] = found.next
                gathered.append((number, offset, found, scene.rays.jitter[found.rays]))
            offset += counts[number]
        if not any(len(found.rays) for _, _, found, _ in gathered):
            continue
        positions = _joined([found.positions for _, _, found, _ in gathered], device)
        directions = _joined([found.directions for _, _, found, _ in gathered], device)
        rays = _joined([found.rays.astype(np.int64) + start for _, start, found, _ in gathered], device)
        triangles = _joined([found.triangles.astype(np.int64) for _, _, found, _ in gathered], mouth.device)
        lengths = _joined(
            [(found.indices + j) * np.float32(marching.step) for _, _, found, j in gathered], device
        )
        owners = _joined([np.full(len(found.rays), number) for number, _, found, _ in gathered], device)
        rows = torch.where(mouth[triangles].to(device), owners, len(scenes))
        away = _joined([found.distances for _, _, found, _ in gathered], device)
        latent = field.latent(parameters, positions, conditions, rows)
        thickness = field.density(latent, away) * marching.step
        values = field.color(parameters, latent, directions)
        part = composite(thickness, values, lengths.to(thickness), rays, transmittance)
        color, distance = color + part.color, distance + part.distance
        transmittance = part.transmittance
        fog = fog - torch.expm1(-thickness).sum()
        evaluated += len(rays)
        finished = (transmittance.detach() < marching.stop_transmittance).cpu().numpy()
        offset = 0
        for number, count in enumerate(counts):
            first[number] = np.where(finished[offset : offset + count], np.int32(-1), first[number])
            offset += count
    return Rendered(color, transmittance, distance, fog, evaluated)


def _joined(parts: Sequence[np.ndarray], device: torch.device) -> Tensor:
    return torch.from_numpy(np.concatenate(parts)).to(device)
