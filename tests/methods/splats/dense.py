"""A brute-force renderer: every splat at every pixel, float64, straight from the definitions.

It shares no code and few formulas with the backends: covariances are inverted by a library, nothing is tiled and nothing
is culled but by depth and the alpha threshold.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from headbench.methods.benchmarks.splats import SplatScene


class Dense(NamedTuple):
    """What `render_dense` gives."""

    image: Tensor  # (H, W, C) float64
    alpha: Tensor  # (H, W) float64
    safe: Tensor  # (H, W) bool: no alpha or transmittance so near a threshold that float32 might fall on the other side


def render_dense(
    scene: SplatScene,
    *,
    near: float = 0.01,
    eps2d: float = 0.3,
    antialiased: bool = False,
    alpha_min: float = 1 / 255,
    transmittance_min: float = 1e-4,
) -> Dense:
    """Render without gradients. Memory is (N, H W); keep both small."""
    s = SplatScene(*(v.detach().double() if isinstance(v, Tensor) else v for v in scene))
    camera = s.means @ s.viewmat[:3, :3].T + s.viewmat[:3, 3]
    order = torch.argsort(camera[:, 2], stable=True)
    order = order[camera[order, 2] > near]
    x, y, z = camera[order].unbind(1)

    fx, fy, cx, cy = (float(s.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    low_x, high_x = -(cx + 0.15 * s.width) / fx, (s.width - cx + 0.15 * s.width) / fx
    low_y, high_y = -(cy + 0.15 * s.height) / fy, (s.height - cy + 0.15 * s.height) / fy
    jacobian = torch.zeros(len(order), 2, 3, dtype=torch.float64)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = fx / z, fy / z
    jacobian[:, 0, 2] = -fx * (x / z).clamp(low_x, high_x) / z
    jacobian[:, 1, 2] = -fy * (y / z).clamp(low_y, high_y) / z
    quats = s.quats[order][:, [1, 2, 3, 0]]
    quats[(quats == 0).all(1), 3] = 1.0
    rotation = torch.from_numpy(Rotation.from_quat(quats.numpy()).as_matrix())
    covariance = rotation @ torch.diag_embed(s.scales[order] ** 2) @ rotation.transpose(1, 2)
    to_image = jacobian @ s.viewmat[:3, :3]
    sharp = to_image @ covariance @ to_image.transpose(1, 2)
    covariance = sharp + eps2d * torch.eye(2, dtype=torch.float64)
    opacities = s.opacities[order]
    if antialiased:
        opacities = opacities * (torch.linalg.det(sharp) / torch.linalg.det(covariance)).clamp(min=0).sqrt()
    inverse = torch.linalg.inv(covariance)
    center = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)

    image = torch.zeros(s.height, s.width, s.colors.shape[1], dtype=torch.float64)
    light = torch.ones(s.height, s.width, dtype=torch.float64)
    done = torch.zeros_like(light, dtype=torch.bool)
    margin = torch.full_like(light, torch.inf)
    centers = [torch.arange(n, dtype=torch.float64) + 0.5 for n in (s.height, s.width)]
    rows, columns = torch.meshgrid(*centers, indexing="ij")
    for k, splat in enumerate(order):
        d = torch.stack([columns - center[k, 0], rows - center[k, 1]], -1)
        raw = opacities[k] * torch.exp(-0.5 * ((d @ inverse[k]) * d).sum(-1))
        alpha = raw.clamp(max=0.99)
        passes = (alpha >= alpha_min) & ~done
        after = light * (1 - alpha)
        for value, threshold, matters in (
            (raw, alpha_min, ~done),
            (raw, 0.99, ~done),
            (after, transmittance_min, passes),
        ):
            distance = (value / threshold - 1).abs()
            margin = torch.where(matters, torch.minimum(margin, distance), margin)
        done |= passes & (after <= transmittance_min)
        drawn = passes & ~done
        image += torch.where(drawn, alpha * light, 0)[..., None] * s.colors[splat]
        light = torch.where(drawn, after, light)
    return Dense(image + light[..., None] * s.background, 1 - light, margin > 1e-3)
