"""The renderer in plain torch: the reference implementation that every faster backend is tested against.

Elliptical weighted average splatting (Zwicker et al., "EWA Splatting", TVCG 2002) of 3D Gaussians (Kerbl
et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023), with gsplat's
conventions (Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", arXiv 2409.06765).
Works in float32 and float64; all gradients come from autograd. Pixels are composited tile by tile and
recomputed in the backward pass, so memory grows with the image and the splats, not with their product.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .request import ALPHA_MAX, FRUSTUM_MARGIN, QUATERNION_MIN, RADIUS_MAX, TILE, Rendering, Request

CHUNK = 1024
"""Splats composited at once within a tile."""


class Footprints(NamedTuple):
    """M splats on the image plane. Pixels, with pixel centres at half-integers."""

    means: Tensor  # (M, 2)
    covariances: Tensor  # (M, 3): xx, xy, yy, low-pass filter included
    determinants: Tensor  # (M,) of the covariances
    depths: Tensor  # (M,) camera z, metres
    opacities: Tensor  # (M,) compensated for the low-pass filter if requested


def rasterize_reference(request: Request) -> Rendering:
    """Render ``request``; see `rasterize` for the meaning of every field."""
    with torch.no_grad():
        drawn, extents, radii = _find_drawn(request)
    footprints = project(request, drawn)
    order = torch.argsort(footprints.depths.detach(), stable=True)
    drawn, extents = drawn[order], extents[order]
    footprints = Footprints(*(value[order] for value in footprints))
    colors = request.colors[drawn]

    rows = []
    cut_offs = request.alpha_min, request.transmittance_min
    for top in range(0, request.height, TILE):
        bottom = min(top + TILE, request.height)
        row = []
        for left in range(0, request.width, TILE):
            right = min(left + TILE, request.width)
            touching = _touching(footprints.means.detach(), extents, left, top, right, bottom)
            pixels = _pixel_centers(left, top, right, bottom).to(request.means)
            splats = Footprints(*(value[touching] for value in footprints))
            tile = _composite_tile(splats, colors[touching], request.background, pixels, cut_offs)
            row.append(tile.reshape(bottom - top, right - left, -1))
        rows.append(torch.cat(row, dim=1))
    image_and_alpha = torch.cat(rows, dim=0)
    return Rendering(image_and_alpha[..., :-1], image_and_alpha[..., -1], lambda: radii)


@torch.no_grad()
def pixel_weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float = 0.01,
) -> tuple[Tensor, Tensor, Tensor]:
    """Weight of each splat in each pixel that it contributes to; the arguments are those of `rasterize`.

    Returns (P,) int64 splats, (P,) int64 pixels, counted row by row, and the (P,) weight of each pair: alpha times the transmittance
    before the splat. The colour of a pixel is the sum of weights times colours, plus the rest times the background.
    """
    request = Request(
        *(means, quats, scales, opacities, means[:, :1], viewmat, K),
        *(means.new_zeros(1), width, height),
        near=near,
    )
    drawn, extents, _ = _find_drawn(request)
    footprints = project(request, drawn)
    means, (_, xy, yy) = footprints.means, footprints.covariances.unbind(1)
    size = torch.tensor([request.width, request.height], device=means.device)
    # Pixels in the bounding box of each splat, which is extended by a pixel for rounding.
    first = torch.minimum((means - extents - 1).floor().clamp(min=0), size)
    sides = (torch.minimum((means + extents + 1).ceil(), size) - first).clamp(min=0)
    count = sides.prod(1).long()
    each = torch.arange(len(drawn), device=means.device)
    row = torch.repeat_interleave(each, count)
    within = torch.arange(len(row), device=means.device) - (count.cumsum(0) - count).index_select(0, row)
    # Separate components are gathered several times faster than rows.
    shapes = torch.stack([*means.T, yy / footprints.determinants, xy / yy, 1 / yy, footprints.opacities])
    mean_x, mean_y, steepness, slant, flatness, opacity = shapes.index_select(1, row).unbind()
    left, top, wide = torch.stack([*first.T, sides[:, 0]]).double().index_select(1, row).unbind()
    down = ((within + 0.5) / wide).floor()
    x, y = left + (within - down * wide), top + down
    dx, dy = (x + 0.5).to(mean_x) - mean_x, (y + 0.5).to(mean_y) - mean_y
    distance = steepness * (dx - slant * dy) ** 2 + flatness * dy * dy
    alpha = (opacity * torch.exp(-0.5 * distance)).clamp(max=ALPHA_MAX)
    kept = (alpha >= request.alpha_min).nonzero().squeeze(1)
    row, pixel = row.index_select(0, kept), (y * request.width + x).index_select(0, kept).long()
    # Front to back in every pixel; sums of logarithms are differences of running sums over all pixels.
    rank = torch.empty_like(each)
    rank[torch.argsort(footprints.depths, stable=True)] = each
    order = torch.argsort(pixel * len(drawn) + rank.index_select(0, row))
    row, pixel = row.index_select(0, order), pixel.index_select(0, order)
    alpha = alpha.index_select(0, kept.index_select(0, order)).double()
    dimmed = torch.log1p(-alpha)
    before = dimmed.cumsum(0) - dimmed
    _, index, number = torch.unique_consecutive(pixel, return_inverse=True, return_counts=True)
    start = number.cumsum(0) - number
    light = torch.exp(before - before.index_select(0, start).index_select(0, index))
    shown = light * (1 - alpha) > request.transmittance_min
    return drawn[row[shown]], pixel[shown], (alpha * light)[shown].to(means.dtype)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Convert quaternions (N, 4), wxyz of any length, to rotation matrices (N, 3, 3); zero gives the identity.

    The largest component is divided out first, so that no square overflows or underflows.
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True).clamp(min=QUATERNION_MIN)
    scaled = quats / largest
    norm = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True).clamp(min=1.0)
    w, x, y, z = (scaled / norm).unbind(-1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=-1).reshape(-1, 3, 3)


def project(request: Request, subset: Tensor | slice) -> Footprints:
    """Project the splats ``subset`` (indices, or a slice) of ``request`` onto the image plane.

    The covariance is factored as ``Q Qᵀ + eps2d I`` with ``Q = J W R S`` (EWA Splatting, eq. 24-31: J the
    Jacobian of the perspective division, W the camera's rotation, R S the splat's axes). By the
    Cauchy-Binet formula its determinant is a sum of squares without cancellation for needles:
    ``|q0 x q1|² + eps2d (|q0|² + |q1|²) + eps2d²``.
    """
    rotation, translation = request.viewmat[:3, :3], request.viewmat[:3, 3]
    fx, fy, cx, cy = request.K[0, 0], request.K[1, 1], request.K[0, 2], request.K[1, 2]

    x, y, z = (request.means[subset] @ rotation.T + translation).unbind(-1)
    means = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    if request.means2d_offset is not None:
        means = means + request.means2d_offset[subset]

    # Far outside the image the linearisation degenerates, so slopes are clamped as in gsplat.
    margin_x = FRUSTUM_MARGIN * 0.5 * request.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * request.height / fy
    slope_x = torch.clamp(x / z, min=-cx / fx - margin_x, max=(request.width - cx) / fx + margin_x)
    slope_y = torch.clamp(y / z, min=-cy / fy - margin_y, max=(request.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = (fx / z, zero, -fx * slope_x / z), (zero, fy / z, -fy * slope_y / z)
    jacobian = torch.stack([torch.stack(row, -1) for row in rows], dim=-2)

    axes = rotation_matrices(request.quats[subset]) * request.scales[subset][:, None, :]
    q0, q1 = (jacobian @ rotation @ axes).unbind(-2)
    xx, xy, yy = (q0 * q0).sum(-1), (q0 * q1).sum(-1), (q1 * q1).sum(-1)
    area = torch.linalg.cross(q0, q1).square().sum(-1)
    eps = request.eps2d
    determinants = area + eps * (xx + yy) + eps * eps
    opacities = request.opacities[subset]
    if request.antialiased:
        opacities = opacities * torch.sqrt(area / determinants)
    return Footprints(means, torch.stack([xx + eps, xy, yy + eps], dim=-1), determinants, z, opacities)


def _find_drawn(request: Request) -> tuple[Tensor, Tensor, Tensor]:
    """Indices (M,) of the splats to draw, half sizes (M, 2) of their bounding boxes, and radii (N,) of all splats.

    Conditions are written so that NaN culls the splat.
    """
    subset = _in_depth(request).nonzero().squeeze(-1)
    footprints = project(request, subset)
    radii = torch.zeros(len(request.means), dtype=torch.int32, device=request.means.device)
    radii[subset] = _published_radii(request, footprints)

    # alpha falls to alpha_min on the ellipse at Mahalanobis distance sqrt(2 ln(opacity / alpha_min)).
    level = 2 * torch.log(footprints.opacities / request.alpha_min)
    extents = torch.sqrt(level[:, None].clamp(min=0) * footprints.covariances[:, [0, 2]])
    reach = torch.ceil(extents)
    size = torch.tensor([request.width, request.height], device=reach.device)
    inside = (footprints.means + reach > 0).all(-1) & (footprints.means - reach < size).all(-1)
    opaque = footprints.opacities >= request.alpha_min
    keep = inside & _resolved(footprints) & opaque & (reach.amax(-1) < RADIUS_MAX)
    return subset[keep], extents[keep], radii


@torch.no_grad()
def published_radii(request: Request) -> Tensor:
    """(N,) radii, as `Rendering.radii` defines them, of all splats of a request."""
    # Computed for all splats, since selecting those in depth would make training wait for a GPU.
    radii = _published_radii(request, project(request, slice(None)))
    return torch.where(_in_depth(request), radii, 0)


def _in_depth(request: Request) -> Tensor:
    """(N,) mask of splats between the near and the far plane."""
    depths = request.means @ request.viewmat[2, :3] + request.viewmat[2, 3]
    return (depths > request.near) & (depths < request.far)


def _published_radii(request: Request, footprints: Footprints) -> Tensor:
    """(M,) int32 radii of preprocessCUDA in diff-gaussian-rasterization (Kerbl et al. 2023), independent of opacity.

    Three standard deviations along the longest axis, or 0 if the square of that half side around the mean intersects
    no tile. Pixel centres are integers there, half a pixel from those here.
    """
    xx, xy, yy = footprints.covariances.unbind(-1)
    spread = torch.sqrt((0.25 * (xx - yy) ** 2 + xy * xy).clamp(min=0.1))
    radii = torch.ceil(3 * torch.sqrt(0.5 * (xx + yy) + spread))
    width, height = (-(-side // TILE) * TILE for side in (request.width, request.height))
    low, high = footprints.means - radii[:, None], footprints.means + radii[:, None]
    in_view = (high >= 1.5).all(-1) & (low[:, 0] < width + 0.5) & (low[:, 1] < height + 0.5)
    keep = in_view & _resolved(footprints) & (radii < RADIUS_MAX)
    return torch.where(keep, radii, 0).to(torch.int32)


def _resolved(footprints: Footprints) -> Tensor:
    return (footprints.determinants > 0) & torch.isfinite(footprints.determinants)


def _touching(means: Tensor, extents: Tensor, left: int, top: int, right: int, bottom: int) -> Tensor:
    """Indices of the splats whose bounding box, extended by a pixel for rounding, intersects the tile."""
    low, high = means - extents - 1, means + extents + 1
    meets_x = (high[:, 0] > left) & (low[:, 0] < right)
    meets_y = (high[:, 1] > top) & (low[:, 1] < bottom)
    return (meets_x & meets_y).nonzero().squeeze(-1)


def _pixel_centers(left: int, top: int, right: int, bottom: int) -> Tensor:
    """Centres (P, 2) of a tile's pixels, row by row."""
    y, x = torch.meshgrid(torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij")
    return torch.stack([x.reshape(-1), y.reshape(-1)], dim=-1)


def _composite_tile(
    splats: Footprints, colors: Tensor, background: Tensor, pixels: Tensor, cut_offs: tuple[float, float]
) -> Tensor:
    """Composite depth-sorted splats front to back onto ``pixels`` (P, 2); returns (P, C + 1), alpha last.

    ``cut_offs`` are the minimum alpha and transmittance.
    """
    image = pixels.new_zeros(len(pixels), colors.shape[1])
    transmittance = pixels.new_ones(len(pixels))
    running = torch.ones_like(transmittance, dtype=torch.bool)
    # At least one chunk, so that the result depends on the inputs, with zero gradient.
    for start in range(0, max(len(colors), 1), CHUNK):
        part = slice(start, start + CHUNK)
        image, transmittance, running = checkpoint(
            _composite_chunk,
            *(image, transmittance, running, pixels),
            *(splats.means[part], splats.covariances[part], splats.determinants[part]),
            *(splats.opacities[part], colors[part], cut_offs),
            use_reentrant=False,
            preserve_rng_state=False,
        )
    image = image + transmittance[:, None] * background
    return torch.cat([image, 1 - transmittance[:, None]], dim=1)


def _composite_chunk(
    image: Tensor,
    transmittance: Tensor,
    running: Tensor,
    pixels: Tensor,
    means: Tensor,
    covariances: Tensor,
    determinants: Tensor,
    opacities: Tensor,
    colors: Tensor,
    cut_offs: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend one chunk behind the previous ones (3D Gaussian Splatting, eq. 3).

    The exponent ``dᵀ Σ⁻¹ d`` is written as the sum of squares ``Σ_yy/det (dx - Σ_xy/Σ_yy dy)² + dy²/Σ_yy``,
    which rounding cannot make negative.
    """
    dx, dy = (pixels[:, None, :] - means).unbind(-1)
    xy, yy = covariances[:, 1], covariances[:, 2]
    distance = yy / determinants * (dx - xy / yy * dy) ** 2 + dy * dy / yy
    alpha = (opacities * torch.exp(-0.5 * distance)).clamp(max=ALPHA_MAX)
    alpha_min, transmittance_min = cut_offs
    alpha = torch.where(alpha >= alpha_min, alpha, 0)

    after = transmittance.detach()[:, None] * torch.cumprod(1 - alpha.detach(), dim=1)
    drawn = running[:, None] & (after > transmittance_min)
    alpha = torch.where(drawn, alpha, 0)
    light = torch.cumprod(torch.cat([transmittance[:, None], 1 - alpha], dim=1), dim=1)
    running = torch.cat([running[:, None], drawn], dim=1)[:, -1]
    return image + (alpha * light[:, :-1]) @ colors, light[:, -1], running
