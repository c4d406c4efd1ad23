"""Spec and settings of FlashAvatar; the implementation is not imported.

The defaults are those of the authors' program; iterations are on the scale of its 150,000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import HarmonicsTraining, SurfaceSettings, check_range


@dataclass(frozen=True)
class FlashAvatarConfig(SurfaceSettings, HarmonicsTraining):
    """FlashAvatar (CVPR 2024): splats on a mesh, translated, rotated and scaled by a network of the tracked parameters."""

    schedule_length: int = 150_000
    samples: int = 13_500

    frequencies: int = 8
    """Number of frequencies of the positional encoding of a splat's point on the neutral mesh: 1, 2, 4, ... radians a metre."""
    layers: int = 6
    """Number of the network's hidden layers."""
    hidden: int = 256

    zero_output: bool = False
    """Initialise the last layer with zeros, so that the network has no effect at first. The authors' program initialises it at
    random, like the other layers."""
    hyper_gaussians: int = 0
    """Number of latents that the network emits instead of the outputs, which are then conditional means of Gaussians that every
    splat has over outputs and latents (HyperGaussians, arXiv 2507.02803: 8 in the paper, 32 in the program). They start at zero
    regardless of ``zero_output``, and have the rate ``network_lr``. 0 disables them."""
    offset_m: float = 1.0
    """Maximum offset of a splat from its point on the surface along each axis of the head, metres."""
    scale_variant: Literal["official", "product"] = "official"
    """"product" multiplies the size of a splat by exp(tanh), which is within a factor of e. "official" does as the authors'
    program, which multiplies its logarithm by that: a size s in metres becomes s^c, with c from 1/e to e."""
    sh_every: int = 500

    mouth_weight: float = 40.0
    """Weight of the Huber loss within the mouth mask, whose cache uses up to another half of ``mesh_cache_mb``. 0 disables it,
    as does a head model without the region "lips"."""
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM, which is added to the loss; 0 as published."""
    scale_lr: float = 0.005
    network_lr: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        HarmonicsTraining.__post_init__(self)
        check_range(self, "at least 1", "layers")
        bounds = {"frequencies": 16, "layers": 100, "hidden": 1_024, "hyper_gaussians": 128}
        for name, most in bounds.items():
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be 0 to {most}, found {getattr(self, name)}")
        if not 0 < self.offset_m <= 100:
            raise ValueError(f"offset_m must be above 0 and up to 100, found {self.offset_m}")
        check_range(self, "at least 0", "mouth_weight", "ssim_weight")


SHORT: dict[str, Any] = {
    "initial_opacity": 0.5,
    "layers": 3,
    "hidden": 64,
    "zero_output": True,
    "offset_m": 0.05,
    "ssim_weight": 0.2,
    "scale_lr": 0.05,
    "rotation_lr": 0.01,
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 1e-3,
    "network_lr": 1e-3,
    "final_rate": 0.1,
}
"""Settings of runs much shorter than published (docs/explanation/methods/flashavatar.md, "Presets")."""
PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"budget": {"iterations": 60}, **SHORT, "samples": 3_000},
    "quick": {"budget": {"iterations": 480}, **SHORT, "samples": 10_000},
    "demo": {"budget": {"iterations": 1_000}, **SHORT, "samples": 20_000},
    "fast": {"budget": {"iterations": 1_450}, **SHORT, "samples": 40_000},
    "gpu": {"budget": {"iterations": 30_000}},
    "paper": {"budget": {"iterations": 150_000}},
}

FLASHAVATAR = MethodSpec(
    name="flashavatar",
    version="2",
    summary="FlashAvatar: splats on the mesh, moved, turned and scaled by a network of the tracked parameters.",
    implementation="headbench.methods.flashavatar.method:FlashAvatar",
    config="headbench.methods.flashavatar.spec:FlashAvatarConfig",
    variants="headbench.methods.avatars.derived.recipes:flashavatar_variants",
    needs="headbench.methods.shared.method:splats",
    ablations={"no-offsets": {"zero_output": True, "network_lr": 0.0}},
    mechanism=Mechanism("offset network", "offsets of the splats from the mesh", "no-offsets"),
    presets=PRESETS,
    source="FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding, CVPR 2024, arXiv 2312.02214",
    bibtex=r"""@inproceedings{xiang2024flashavatar,
  title     = {{FlashAvatar}: High-fidelity Head Avatar with Efficient {Gaussian} Embedding},
  author    = {Xiang, Jun and Gao, Xuan and Guo, Yudong and Zhang, Juyong},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024},
  eprint    = {2312.02214},
}""",
)
