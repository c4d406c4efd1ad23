"""Emission and absorption along rays: Max, "Optical models for direct volume rendering", 1995."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Composite(NamedTuple):
    """What rays gather."""

    color: Tensor  # (R, C) weighted sums of the samples' values
    transmittance: Tensor  # (R,) what is left of the light behind
    distance: Tensor  # (R,) weighted sums of the samples' distances, metres


def composite(
    thickness: Tensor, values: Tensor, distances: Tensor, rays: Tensor, entering: Tensor
) -> Composite:
    """Sums over samples of ``T (1 - exp(-thickness)) value``, T the transmittance in front of a sample.

    Optical depths are summed in float64, since a ray's are differences of a sum over all rays.

    Parameters
    ----------
    thickness : (N,) density times the length of each sample; samples ray by ray, in order of distance.
    values, distances : (N, C) and (N,).
    rays : (N,) int64, not descending.
    entering : (R,) transmittance in front of the first of these samples.
    """
    count = len(entering)
    depth = thickness.double()
    total = depth.cumsum(0)
    before = total - depth
    firsts = torch.searchsorted(rays, torch.arange(count, device=rays.device))
    lasts = torch.searchsorted(rays, torch.arange(count, device=rays.device), right=True)
    bounds = torch.cat([total.new_zeros(1), total])
    ahead = (before - bounds[firsts[rays]]).to(thickness.dtype)
    weights = entering[rays] * torch.exp(-ahead) * -torch.expm1(-thickness)
    leaving = entering * torch.exp(bounds[firsts] - bounds[lasts]).to(thickness.dtype)
    rows = torch.cat([values, distances[:, None]], dim=1) * weights[:, None]
    summed = rows.new_zeros(count, rows.shape[1]).index_add(0, rays, rows)
    return Composite(summed[:, :-1], leaving, summed[:, -1])
