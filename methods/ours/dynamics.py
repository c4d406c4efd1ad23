"""What an expression may change about a splat: its opacity as published, or, for the ablation, everything else.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
arXiv 2504.14967), section 3.3 and Table 4: offsets on position, rotation and scale win novel views and lose novel
expressions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .config import Dynamic

WIDTHS: Mapping[Dynamic, int] = {"opacity": 1, "position": 3, "rotation": 4, "scale": 3, "color": 3}
"""Numbers per splat of each thing that may change."""


class LocalSplats(NamedTuple):
    """Splats in their triangles' frames, before an expression changes them or after.

    Attributes
    ----------
    means : (N, 3) in units of the triangle's size.
    log_scales : (N, 3) logarithms in the same unit.
    quats : (N, 4), real part first, of any length.
    logits : (N,) of the opacities.
    color_change : (N, 3) added to the colours before they are cut at 0; None where nothing is added.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logits: Tensor
    color_change: Tensor | None = None


def offset_width(dynamic: Sequence[Dynamic]) -> int:
    """Outputs of the offset network."""
    return sum(WIDTHS[name] for name in dynamic)


def apply_offsets(splats: LocalSplats, offsets: Tensor, dynamic: Sequence[Dynamic]) -> LocalSplats:
    """Add (N, `offset_width`) offsets, in the order of ``dynamic``: to logits, local means, quaternions, log-scales."""
    parts = dict(zip(dynamic, offsets.split([WIDTHS[name] for name in dynamic], dim=1)))
    changed = splats
    if "opacity" in parts:
        changed = changed._replace(logits=splats.logits + parts["opacity"][:, 0])
    if "position" in parts:
        changed = changed._replace(means=splats.means + parts["position"])
    if "rotation" in parts:
        changed = changed._replace(quats=splats.quats + parts["rotation"])
    if "scale" in parts:
        changed = changed._replace(log_scales=splats.log_scales + parts["scale"])
    return changed._replace(color_change=parts.get("color"))


def changed_colors(colors: Tensor, splats: LocalSplats) -> Tensor:
    """(N, 3) >= 0."""
    return colors if splats.color_change is None else torch.relu(colors + splats.color_change)
