"""Settings of FlashAvatar. Light: neither torch nor numpy is imported here.

The defaults are those of the authors' program; iterations are on the scale of its 150,000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..shared.config import HarmonicsTraining, check_at_least_one


@dataclass(frozen=True)
class FlashAvatarConfig(HarmonicsTraining):
    """FlashAvatar (CVPR 2024): splats on a mesh, moved, turned and scaled by a network of the tracked parameters.

    Attributes
    ----------
    schedule_length : int
        Iterations of the published run; ``sh_every`` below is on its scale.
    samples : int
        Number of splats, about.
    uv_chart : bool
        One splat for each texel of the head model's chart of texture coordinates, as published, in a resolution that gives
        about ``samples``. Without it, and on a head model without a chart, splats are spread evenly over the surface.
    initial_opacity : float
        Opacity of every splat at the start, between 0 and 1.
    frequencies : int
        Number of frequencies of the positional encoding of a splat's point on the neutral mesh: 1, 2, 4, ...
        radians a metre.
    layers, hidden : int
        Number and width of the network's hidden layers.
    zero_output : bool
        Start with a last layer of zeros, so that the network changes nothing at first. The authors' program
        starts it at random like the other layers.
    hyper_gaussians : int
        Number of latents that the network emits instead of the outputs, which are then conditional means of Gaussians
        that every splat has over outputs and latents (HyperGaussians, arXiv 2507.02803: 8 in the paper, 32 in the
        program). They start at zero, whatever ``zero_output``, and have the rate ``network_lr``. 0: none.
    offset_m : float
        Maximum offset of a splat from its point on the surface along each axis of the head, metres.
    scale_variant : Literal['official', 'product']
        "product" multiplies the size of a splat by exp(tanh), which is within a factor of e. "official" does
        as the authors' program, which multiplies its logarithm by that: a size s in metres becomes s^c, with c
        from 1/e to e.
    mouth_weight : float
        Weight of the Huber loss of the images times the mask of the mouth. 0 disables it, as does a head
        model without the region "lips".
    ssim_weight : float
        Weight of 1 - SSIM, which is added to the loss; 0 as published.
    opacity_lr, scale_lr, rotation_lr, network_lr : float
        Initial learning rates.
    final_rate : float
        Final learning rates relative to the initial ones, log-linear over the last half of the run; 1 keeps
        them constant, as published.
    mesh_cache_mb : int
        Memory for the posed surfaces of known timesteps and the masks of the mouth.
    checkpoint_every_s : float
        Seconds between checkpoints of the training.
    """

    schedule_length: int = 150_000
    samples: int = 13_500
    uv_chart: bool = True
    initial_opacity: float = 0.1
    frequencies: int = 8
    layers: int = 6
    hidden: int = 256
    zero_output: bool = False
    hyper_gaussians: int = 0
    offset_m: float = 1.0
    scale_variant: Literal["official", "product"] = "official"
    sh_every: int = 500
    mouth_weight: float = 40.0
    ssim_weight: float = 0.0
    opacity_lr: float = 0.05
    scale_lr: float = 0.005
    rotation_lr: float = 0.001
    network_lr: float = 1e-4
    final_rate: float = 1.0
    mesh_cache_mb: int = 512
    checkpoint_every_s: float = 120.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least_one(self, "schedule_length", "samples", "layers", "hidden")
        if not 0 < self.initial_opacity < 1 or not 0 < self.final_rate <= 1:
            raise ValueError("initial_opacity must lie between 0 and 1, and final_rate in (0, 1]")
        bounds = {"frequencies": 16, "layers": 100, "hidden": 1_024, "hyper_gaussians": 128}
        for name, most in bounds.items():
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be 0 to {most}, found {getattr(self, name)}")
        if not 0 < self.offset_m <= 100:
            raise ValueError(f"offset_m must be above 0 and up to 100, found {self.offset_m}")
        if not 0 <= self.mouth_weight or not 0 <= self.ssim_weight:
            raise ValueError("mouth_weight and ssim_weight must not be negative")
