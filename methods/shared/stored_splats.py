"""What every mesh-bound avatar does with its stored splats each frame: carry them to the world, look up harmonics.

Prepared once when an avatar is loaded. The compiled kernel does the work where it can, torch elsewhere; they agree up
to rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from . import avatar_kernel
from .binding import Frames, WorldSplats, apply_matrices, to_world
from .sh import sh_degree, sh_to_rgb


class Carrier:
    """Carries splats to the world: `binding.to_world`, with what no frame changes computed beforehand.

    Parameters
    ----------
    binding : (N,) int64, the triangle of each splat.
    log_scales, quats : (N, 3) and (N, 4), as most frames have them.
    """

    def __init__(self, binding: Tensor, log_scales: Tensor, quats: Tensor):
        self._binding, self._log_scales, self._quats = binding, log_scales, quats
        self._fast = avatar_kernel.usable(quats)
        if self._fast:
            self._known = _unit(quats), log_scales.exp()

    def __call__(self, frames: Frames, means: Tensor, log_scales: Tensor, quats: Tensor) -> WorldSplats:
        """Splats in the world; log-scales and quaternions may be others than the known ones."""
        if not self._fast:
            return to_world(frames, self._binding, means, log_scales, quats)
        units, scales = self._known
        if quats is not self._quats:
            units = _unit(quats)
        if log_scales is not self._log_scales:
            scales = log_scales.exp()
        return avatar_kernel.carry(frames, self._binding, means, units, scales)


class HarmonicColors:
    """Colours by spherical harmonics, up to the degree that the coefficients have.

    Parameters
    ----------
    dc, rest : (N, 3) and (N, 3, K - 1) coefficients along the ways from the camera to the splats.
    """

    def __init__(self, dc: Tensor, rest: Tensor):
        self._dc, self._rest = dc, rest
        self._packed = avatar_kernel.pack_harmonics(dc, rest) if avatar_kernel.usable(dc) else None

    def along(self, directions: Tensor) -> Tensor:
        """Colours (N, 3) >= 0 along (N, 3) unit vectors from the camera to the splats."""
        return sh_to_rgb(self._dc, self._rest, directions, sh_degree(self._rest))

    def __call__(
        self, means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        """Colours (N, 3) >= 0 of splats at (N, 3) means as a camera at ``center`` sees them.

        ``turns`` (F, 3, 3) are applied to the directions of the splats that ``binding`` (N,) gives to each triangle.
        """
        if self._packed is not None:
            return avatar_kernel.shade(self._packed, means, center, turns, binding)
        directions = torch.nn.functional.normalize(means - center, dim=1)
        if turns is not None and binding is not None:
            directions = apply_matrices(turns.reshape(-1, 9).index_select(0, binding), directions)
        return self.along(directions)


def _unit(quats: Tensor) -> Tensor:
    return quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
