"""Settings of GaussianAvatars; imports neither torch nor numpy."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..shared.config import Capacity, HarmonicsTraining, SplatTraining


@dataclass(frozen=True)
class GAConfig(HarmonicsTraining):
    """GaussianAvatars: spherical harmonics per splat, and tracking refined with the avatar."""

    splats: SplatTraining = field(default_factory=SplatTraining)
    capacity: Capacity = field(default_factory=Capacity)

    refine_tracking: bool = True
    """Whether to optimise expression, poses and translation of the training timesteps."""
    expression_lr: float = 1e-3
    pose_lr: float = 1e-5
    translation_lr: float = 1e-6
    """Learning rates of the refined expression coefficients, joint rotations and translation."""
