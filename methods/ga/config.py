"""Settings of GaussianAvatars. Light: neither torch nor numpy is imported here."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..shared.config import Capacity, SplatTraining


@dataclass(frozen=True)
class GAConfig:
    """GaussianAvatars: spherical harmonics per splat, and tracking refined with the avatar.

    Attributes
    ----------
    sh_degree, sh_every, min_sh_every : int
        Final degree of the spherical harmonics; it is raised by one every ``sh_every`` iterations
        (published scale), but at least ``min_sh_every`` of the actual run.
    sh_dc_lr, sh_rest_lr : float
        Learning rates of the constant term and of the higher degrees of the spherical harmonics.
    refine_tracking : bool
        Whether to optimise expression, poses and translation of the training timesteps.
    expression_lr, pose_lr, translation_lr : float
        Learning rates of the refined expression coefficients, joint rotations and translation.
    """

    splats: SplatTraining = field(default_factory=SplatTraining)
    capacity: Capacity = field(default_factory=Capacity)
    sh_degree: int = 3
    sh_every: int = 1_000
    min_sh_every: int = 100
    sh_dc_lr: float = 0.0025
    sh_rest_lr: float = 0.000125
    refine_tracking: bool = True
    expression_lr: float = 1e-3
    pose_lr: float = 1e-5
    translation_lr: float = 1e-6

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree must be 0 to 3, found {self.sh_degree}")
