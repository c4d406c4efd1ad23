"""Cameras as tensors, and the size of the scene that they stand around."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera


@dataclass(frozen=True)
class View:
    """A camera as tensors."""

    camera: Camera
    world_to_camera: Tensor
    K: Tensor
    center: Tensor


def view_of(camera: Camera, device: str) -> View:
    """Put a camera on a device."""

    def tensor(values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

    return View(camera, tensor(camera.world_to_camera), tensor(camera.K), tensor(camera.center))


def scene_extent(cameras: Mapping[str, Camera]) -> float:
    """1.1 times the largest distance of a training camera from their mean centre, metres.

    A single camera has no such radius; half its distance to the origin stands in, so that learning rates and
    size thresholds keep their scale.
    """
    centers = np.stack([camera.center for camera in cameras.values()])
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    if radius < 1e-6:
        radius = 0.5 * float(np.linalg.norm(centers[0]))
    return 1.1 * max(radius, 1e-3)
