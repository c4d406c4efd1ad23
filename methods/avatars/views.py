"""Views of splats from all around, and the contribution of each splat to a view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, Clip, FloatArray, HeadPose, SplatAvatar, Splats
from ...bench.protocol import evenly_with_ends
from ..ops.splats import WorldSplats
from ..shared.rendering import pixel_sums, view_of

FIELD_OF_VIEW = 30.0
"""Field of view of the cameras of `orbit_camera`, degrees."""
SIZE = 128
"""Image size of `visibility`, pixels."""


def contribution(splats: Splats, camera: Camera) -> Tensor:
    """(N,) blending weights of each splat, summed over all pixels of one view, see `pixel_sums`.

    Used as importance for pruning by Fang and Wang, "Mini-Splatting", ECCV 2024, section 4.
    """
    return _sums(splats, camera, torch.ones(camera.height, camera.width, 1))[:, 0]


def _sums(splats: Splats, camera: Camera, targets: Tensor) -> Tensor:
    geometry = splats.means, splats.quats, splats.scales, splats.opacities
    *world, opacities = (torch.tensor(np.asarray(values, np.float32)) for values in geometry)
    return pixel_sums(WorldSplats(*world), opacities, view_of(camera, "cpu"), targets)


VIEWS = 64


def training_views(clip: Clip, count: int = VIEWS) -> list[tuple[Camera, HeadPose]]:
    """At most ``count`` training frames, evenly spread over their sorted keys."""
    keys = evenly_with_ends(sorted(clip.splits["train"]), count)
    return [(clip.cameras[key.camera], clip.poses[key.timestep]) for key in keys]


def squared_contribution(splats: Splats, camera: Camera, generator: torch.Generator) -> Tensor:
    """(N,) squared blending weights of each splat, summed over all pixels of one view and divided by their number.

    This is the mean squared error of the picture per unit of squared error of the splat's colour. It is estimated from
    derivatives of sums of pixels with random signs, since all other products of weights have the expectation 0 (M.
    Hutchinson, Communications in Statistics 18, 1989); three channels are three draws.
    """
    signs = 2.0 * torch.randint(0, 2, (camera.height, camera.width, 3), generator=generator) - 1.0
    weights = _sums(splats, camera, signs)
    return (weights**2).mean(1) / (camera.width * camera.height)


def importance(avatar: SplatAvatar, views: Sequence[tuple[Camera, HeadPose]]) -> FloatArray:
    """(N,) mean of `squared_contribution` over views; equal calls give equal numbers."""
    generator = torch.Generator().manual_seed(0)
    weights = [squared_contribution(avatar.splats(pose), camera, generator) for camera, pose in views]
    return torch.stack(weights).mean(0).numpy().astype(np.float64)


def visibility(splats: Splats, directions: FloatArray) -> Tensor:
    """(N, M) visibility of each splat from (M, 3) unit vectors to the camera, relative to its maximum."""
    middle = splats.means.mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(splats.means - middle, axis=1), 0.99))
    distance = max(radius, 1e-3) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    weights = torch.stack(
        [contribution(splats, orbit_camera(d, distance, middle, SIZE)) for d in directions], dim=1
    )
    return weights / weights.amax(dim=1, keepdim=True).clamp_min(1e-6)


def direction_of(azimuth: float, elevation: float) -> FloatArray:
    """(3,) unit vector to a camera at angles in radians, 0 from the front."""
    around = np.cos(elevation)
    return np.array([np.sin(azimuth) * around, np.sin(elevation), np.cos(azimuth) * around])


def camera_at(place: FloatArray) -> Camera:
    """A camera of which only the position is used, (3,) metres."""
    motion = np.eye(4)
    motion[:3, 3] = -np.asarray(place, np.float64)
    return Camera("place", 8, 8, np.eye(3), motion)


def orbit_camera(direction: FloatArray, distance: float, target: FloatArray, size: int) -> Camera:
    """An upright square view of a target; (3,) unit vector to the camera, not vertical."""
    ahead = -np.asarray(direction, np.float64)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    motion = np.eye(4)
    motion[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    motion[:3, 3] = -motion[:3, :3] @ (target - distance * ahead)
    focal = size / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera("view", size, size, K, motion)
