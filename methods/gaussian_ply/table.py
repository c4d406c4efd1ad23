"""The PLY of 3D Gaussian splatting (Kerbl et al. 2023), as viewers know it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from ...bench.contracts import FloatArray
from ..ga.storage import COLUMNS
from ..shared.bound_avatar import PosedSplats
from ..shared.ply import write_ply

STANDARD = COLUMNS[:-1]
"""62 float32: position, zero normals, harmonics (the rest channel by channel), opacity logit, log-scales, wxyz."""

OPACITY_MARGIN = 1e-6  # logits stay finite


def write_gaussians(path: Path, splats: PosedSplats, dc: Tensor, rest: Tensor) -> None:
    """Write splats in the world, with (N, 3) and (N, 3, 15) harmonics along world directions."""
    opacities = splats.opacities.astype(np.float64).clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns: list[FloatArray] = [
        splats.means,
        np.zeros_like(splats.means),
        dc.cpu().numpy(),
        rest.flatten(1).cpu().numpy(),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(np.maximum(splats.scales, np.finfo(np.float32).tiny)),
        splats.quats,
    ]
    write_ply(path, STANDARD, np.concatenate(columns, axis=1).astype(np.float32))
