"""How much each splat of an avatar contributes to pictures."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, Clip, HeadPose
from ..shared.bound_avatar import PosedSplats
from ..shared.views import view_of
from ..splats import rasterize

VIEWS = 64


class SplatAvatar(Protocol):
    """An avatar that tells its splats."""

    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats: ...


def training_views(clip: Clip, count: int = VIEWS) -> list[tuple[Camera, HeadPose]]:
    """At most ``count`` training frames, evenly spread over their sorted keys."""
    keys = sorted(clip.splits["train"])
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).round().astype(int))
    return [(clip.cameras[keys[i].camera], clip.poses[keys[i].timestep]) for i in chosen]


def contributions(avatar: SplatAvatar, views: Iterable[tuple[Camera, HeadPose]]) -> Tensor:
    """(N,) blending weights of each splat, summed over all pixels of all views.

    The weight of a splat in a pixel is its alpha times the transmittance in front of it; the sum over pixels is the
    derivative of the sum of a one-channel image by the splat's colour. As importance for pruning: Fang and Wang,
    "Mini-Splatting", ECCV 2024, section 4.
    """
    total: Tensor | None = None
    for camera, pose in views:
        posed, view = avatar.splats(pose), view_of(camera, "cpu")
        means, quats, scales, opacities = map(
            torch.from_numpy, (posed.means, posed.quats, posed.scales, posed.opacities)
        )
        colors = torch.ones(len(means), 1, requires_grad=True)
        image = rasterize(
            *(means, quats, scales, opacities, colors),
            *(view.world_to_camera, view.K, camera.width, camera.height),
        ).image
        (weights,) = torch.autograd.grad(image.sum(), colors)
        total = weights[:, 0] if total is None else total + weights[:, 0]
    if total is None:
        raise ValueError("views: expected one at least, found none")
    return total


def most_contributing(weights: Tensor, fraction: float) -> Tensor:
    """Numbers, rising, of the given fraction of splats that contribute most; ties by number."""
    count = max(1, round(fraction * len(weights)))
    return torch.argsort(weights, descending=True, stable=True)[:count].sort().values
