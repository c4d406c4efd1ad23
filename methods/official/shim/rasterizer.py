"""headbench's CPU renderer with the interface of ``diff_gaussian_rasterization`` (Kerbl et al. 2023)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ...ops.harmonics import C0, harmonic_colors
from ...splats import rasterize

NEAR = 0.2
"""Metres; nearer splats are not drawn, as published."""


class GaussianRasterizationSettings(NamedTuple):
    """The published settings; matrices multiply row vectors from the right. ``prefiltered`` and ``debug`` have no effect."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool = False


class GaussianRasterizer(nn.Module):
    """The published module."""

    def __init__(self, raster_settings: GaussianRasterizationSettings):
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        alpha_point_id: int | None = None,
    ) -> tuple[Tensor, ...]:
        """Render (N,) splats.

        - ``means3D``, ``scales``, ``rotations``: (N, 3), (N, 3), (N, 4) wxyz; metres.
        - ``means2D``: (N, 3) values that do not affect the image. Their gradient is the one with respect to the projected means
          in normalised device units, with a zero third column.
        - ``opacities``: (N, 1) or (N,) in [0, 1].
        - ``shs``, ``colors_precomp``: (N, K, 3) harmonics of which ``sh_degree`` are used, or (N, 3) colours; exactly one of
          them.
        - ``alpha_point_id``: argument of GaussianBlendshapes' fork; 0 also returns the coverage by all splats.
        - Returns image (3, H, W); coverage (H, W) if requested; radii (N,), positive for every splat in view, regardless of its
          opacity.
        """
        to = self.raster_settings
        if (shs is None) == (colors_precomp is None):
            raise ValueError("expected either shs or colors_precomp")
        if cov3D_precomp is not None or scales is None or rotations is None:
            raise ValueError("expected scales and rotations; the shim does not support covariances")
        if alpha_point_id not in (None, 0):
            raise ValueError("expected alpha_point_id 0; the shim supports only the coverage by all splats")
        if shs is not None:
            colors_precomp = _colors(shs, means3D - to.campos, to.sh_degree)
        assert colors_precomp is not None
        width, height = int(to.image_width), int(to.image_height)
        # The value of means2D has no effect: the difference is zero, its gradient is not.
        half = means3D.new_tensor([0.5 * width, 0.5 * height])
        offset = (means2D - means2D.detach())[:, :2] * half
        rendering = rasterize(
            *(means3D, rotations, to.scale_modifier * scales, opacities.reshape(-1), colors_precomp),
            *(to.viewmatrix.detach().T, self.intrinsics(), width, height),
            background=to.bg,
            near=NEAR,
            means2d_offset=offset,
            check_values=False,
        )
        image = rendering.image.permute(2, 0, 1)
        return (
            (image, rendering.radii) if alpha_point_id is None else (image, rendering.alpha, rendering.radii)
        )

    def intrinsics(self) -> Tensor:
        """(3, 3): the principal point is the middle of the image."""
        width, height = float(self.raster_settings.image_width), float(self.raster_settings.image_height)
        focal = width / (2 * self.raster_settings.tanfovx), height / (2 * self.raster_settings.tanfovy)
        return torch.tensor([[focal[0], 0, width / 2], [0, focal[1], height / 2], [0, 0, 1]])

    def markVisible(self, positions: Tensor) -> Tensor:
        """(N,) whether positions are beyond the near plane."""
        view = self.raster_settings.viewmatrix
        return positions @ view[:3, 2] + view[3, 2] > NEAR


def _colors(shs: Tensor, vectors: Tensor, degree: int) -> Tensor:
    """(N, 3) colours of harmonics along (N, 3) vectors from the camera."""
    if degree == 0:
        return torch.relu(0.5 + C0 * shs[:, 0])
    return harmonic_colors(shs[:, 0].contiguous(), shs[:, 1:].transpose(1, 2).contiguous(), vectors, degree)


PUBLIC: dict[str, Any] = {
    "GaussianRasterizationSettings": GaussianRasterizationSettings,
    "GaussianRasterizer": GaussianRasterizer,
}
