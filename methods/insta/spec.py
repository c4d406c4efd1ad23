"""Spec and settings of INSTA; the implementation is not imported."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import check_range

INSTANT_NGP_STEP = math.sqrt(3) / 1024


@dataclass(frozen=True)
class InstaConfig:
    """INSTA (Zielonka, Bolkart, Thies, CVPR 2023). The defaults are the published values, with these exceptions.

    Density is limited to a shell around the mesh (the official program marches a whole cube), so hair may be at most
    ``shell_outside`` away from the tracked surface. The occupancy at the mouth is sampled with the coefficients of
    training frames (official: with ones). Rows of the hash table without a gradient are updated by Adam like the
    others (official: they are skipped). Rays stop at a transmittance of 1e-3 (official: 1e-2 when rendering), and an
    iteration's rays come from ``images_per_iteration`` images.

    Iterations (``..._from``) are on the scale of ``schedule_length`` and mapped to the budget.
    """

    schedule_length: int = 20_000
    """Iterations of the published run; settings in iterations are on its scale."""
    levels: int = 16
    level_features: int = 8
    log2_table: int = 18
    base_resolution: int = 16
    finest_resolution: int = 2048
    """Multi-resolution hash encoding (Mueller et al., SIGGRAPH 2022): levels, features each (1, 2, 4 or 8), largest rows per
    level, samples per side of the unit cube on the first and the last level."""
    hidden: int = 64
    density_layers: int = 2
    color_layers: int = 3
    latent: int = 16
    """Width and number of hidden layers of the two networks, and number of outputs that the first passes to the second."""
    conditions: int = 16
    """Number of leading expression coefficients that the density network receives if the nearest triangle belongs to the mouth.
    Elsewhere it receives ones."""
    density_bias: float = 0.0
    prior_depth: float = 0.0
    prior_scale: float = 0.004
    """The logarithm of the density per metre is offset by ``density_bias - min(distance / prior_scale, prior_depth)``, with the
    distance from the mesh in metres. Not published (0 there): a short run cannot find the surface, so it starts with a density
    that is highest at the mesh."""
    step: float = INSTANT_NGP_STEP
    """Metres between samples of a ray."""
    shell_outside: float = 0.05
    shell_inside: float = 0.02
    """Maximum distance of density from the surface, metres, on both of its sides."""
    jaw_opening: float = 0.2094
    """Opening of the jaw in the canonical mesh, radians, so that the lips are apart."""
    warp_variant: Literal["paper", "official"] = "paper"
    """"paper" transforms points by the mean of the transforms of the nearest triangle and of those across its edges, weighted
    by exp(-4 d) in metres, each with the root of the ratio of areas as its scale (paper, section 3.2). "official" is the
    authors' program: means only in the face region, exp(-d) for the own triangle, and a scale only in the eye region, by the
    ratio itself."""
    occupancy_resolution: int = 128
    occupancy_every: int = 16
    occupancy_decay: float = 0.95
    occupancy_threshold: float = 0.01
    """Cells along the longest side of the canonical box; iterations between refreshes; decay of an old value; optical thickness
    per ``step`` above which a cell is marched through."""
    occupancy_whole: int = 256
    """Iterations of the actual run in which a refresh visits all cells; later it visits a quarter."""
    samples_per_iteration: int = 2**18
    first_rays: int = 4096
    """Target number of samples that the number of rays is adapted to, and initial number of rays."""
    images_per_iteration: int = 16
    """Training images that share an iteration's rays; the authors' program uses all that it has loaded, up to 1,700."""
    round_samples: int = 16
    stop_transmittance: float = 1e-3
    """Samples per ray that are evaluated before rays with less transmittance than this stop."""
    huber: float = 0.1
    """Error at which the colour loss changes from quadratic to linear."""
    mouth_weight: float = 40.0
    mouth_from: int = 500
    """Weight of pixels that show lips or teeth, and the iteration from which it is used."""
    depth_weight: float = 1.25
    """Weight of the distance between the expected depth and the mesh, metres, outside hair and neck; 0 for none."""
    opacity_weight: float = 0.0
    """Weight of the mean opacity of a ray's samples, summed. Not published (0 there): in short runs it clears the space in
    front of the surface, which no other loss does, and so saves samples."""
    target_variant: Literal["paper", "official"] = "paper"
    """"paper" composites the truth over the random background as the prediction is, in sRGB. "official" does it in linear
    light, which differs at soft masks."""
    learning_rate: float = 1.75e-3
    final_rate: float = 1.0
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 1e-6
    ema: float = 0.95
    """Adam; final rate relative to the initial one, log-linear over the last half; decay of the networks' weights; decay of the
    running mean of parameters that is kept as the avatar."""
    mesh_cache_mb: int = 512
    image_cache_mb: int = 512
    """Memory for posed meshes and for training images."""
    checkpoint_every_s: float = 120.0
    """Seconds between checkpoints of the training."""

    def __post_init__(self) -> None:
        if self.level_features not in (1, 2, 4, 8):
            raise ValueError(f"level_features must be 1, 2, 4 or 8, found {self.level_features}")
        if not 1 <= self.log2_table <= 24:
            raise ValueError(f"log2_table must lie between 1 and 24, found {self.log2_table}")
        if not 2 <= self.base_resolution <= self.finest_resolution:
            raise ValueError("base_resolution must be at least 2 and at most finest_resolution")
        check_range(
            self, "at least 1", "schedule_length", "levels", "hidden", "density_layers", "color_layers"
        )
        check_range(self, "at least 1", "latent", "occupancy_resolution", "occupancy_every", "round_samples")
        check_range(self, "at least 1", "samples_per_iteration", "first_rays", "images_per_iteration")
        check_range(
            self, "above 0", "step", "shell_outside", "shell_inside", "prior_scale", "huber", "learning_rate"
        )
        check_range(self, "at least 0", "conditions", "mouth_weight", "depth_weight", "weight_decay")
        check_range(self, "at least 0", "prior_depth", "opacity_weight")
        check_range(self, "in [0, 1)", "occupancy_decay", "occupancy_threshold", "ema", "stop_transmittance")
        check_range(self, "in (0, 1]", "final_rate")


SHORT: dict[str, Any] = {
    "levels": 8,
    "level_features": 4,
    "log2_table": 15,
    "finest_resolution": 384,
    "hidden": 32,
    "density_layers": 1,
    "color_layers": 2,
    "density_bias": 4.5,
    "prior_depth": 4.0,
    "opacity_weight": 9e-4,
    "depth_weight": 3.75,
    "step": 0.004,
    "shell_outside": 0.04,
    "shell_inside": 0.006,
    "occupancy_resolution": 80,
    "occupancy_every": 8,
    "occupancy_decay": 0.8,
    "occupancy_whole": 100_000,
    "samples_per_iteration": 2**14,
    "first_rays": 1024,
    "images_per_iteration": 8,
    "round_samples": 8,
    "stop_transmittance": 0.01,
    "learning_rate": 1e-2,
    "final_rate": 0.05,
}
"""Settings for a few minutes on two cores (docs/explanation/methods/insta.md, "Presets")."""
INSTA = MethodSpec(
    name="insta",
    demo=True,
    version="2",
    summary="INSTA: a canonical hash-grid radiance field, warped by the nearest triangle of the tracked mesh.",
    implementation="headbench.methods.insta.method:Insta",
    config="headbench.methods.insta.spec:InstaConfig",
    devices=("cpu",),
    variants="headbench.methods.avatars.derived.recipes:insta_variants",
    needs="headbench.methods.shared.method:insta",
    ablations={"no-condition": {"conditions": 0}},
    mechanism=Mechanism(
        "expression condition",
        "opacity and colour of occupied cells at the mouth by the expression",
        "no-condition",
    ),
    presets={
        "smoke": {"budget": {"iterations": 40}, **SHORT},
        "quick": {
            "budget": {"iterations": 300},
            **SHORT,
            "samples_per_iteration": 2**13,
            "images_per_iteration": 2,
            "round_samples": 24,
            "occupancy_every": 16,
            "learning_rate": 2e-2,
        },
        "demo": {"budget": {"iterations": 400}, **SHORT},
        "fast": {"budget": {"iterations": 1_050}, **SHORT, "log2_table": 17, "finest_resolution": 768},
        "gpu": {"budget": {"iterations": 20_000}},
        "paper": {"budget": {"iterations": 20_000}},
    },
    monocular=True,
    source="Instant Volumetric Head Avatars, CVPR 2023, arXiv 2211.12499",
    bibtex=r"""@inproceedings{zielonka2023insta,
  title     = {Instant Volumetric Head Avatars},
  author    = {Zielonka, Wojciech and Bolkart, Timo and Thies, Justus},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2023},
  eprint    = {2211.12499},
}""",
)
