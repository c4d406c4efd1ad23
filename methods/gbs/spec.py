"""Spec and settings of GaussianBlendshapes; the implementation is not imported.

The defaults are the published values; times are on the scale of the published run of 40,000 iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import Capacity, DensifiedTraining, HarmonicsTraining, check_range


@dataclass(frozen=True)
class BlendshapeTraining(DensifiedTraining):
    """Training of the neutral splats; lengths are in metres, the extent of the scene is 1.

    Opacities are never reset. The published code also intends to remove splats of a radius above 20 pixels, but clears
    the radii before the test, as 3DGS does; there is no such rule here.
    """

    schedule_length: int = 40_000
    position_lr: float = 1.6e-4
    position_lr_final: float = 1.6e-6
    scale_lr: float = 0.005
    densify_from: int = 500
    densify_every: int = 100
    densify_until: int = 15_000
    densify_gradient: float = 1e-3
    prune_extent_from: int = 3_000
    reset_every: int | None = None
    reset_at_start: bool = False


@dataclass(frozen=True)
class GBSConfig(HarmonicsTraining):
    """GaussianBlendshapes (SIGGRAPH 2024, arXiv 2404.19398): neutral splats plus differences for expressions."""

    splats: BlendshapeTraining = field(default_factory=BlendshapeTraining)
    capacity: Capacity = field(default_factory=Capacity)

    samples: int = 50_000
    teeth_samples: int = 5_000
    """Initial number of splats on the head and on each row of teeth; upper limits if ``sample_spacing`` is set."""
    sample_spacing: float = 0.0
    """Initial distance of neighbouring splats in pixels, on average over the training cameras. 0 uses ``samples`` unchanged, as
    published."""
    expressions: int = 50
    """Number of leading expression coefficients with differences; all, if there are fewer."""
    difference_sh_degree: int = 3
    """Degree up to which the differences change the harmonics."""
    difference_position_lr: float = 3.2e-7
    difference_sh_lr: float = 1.25e-3
    difference_scale_lr: float = 5e-4
    difference_rotation_lr: float = 1e-4
    difference_opacity_lr: float = 5e-5
    """Learning rates of the differences; the same for harmonics of all degrees."""
    position_settles: int = 30_000
    """Iteration (published scale) at which the learning rate of positions has reached its final value."""
    teeth_densify_gradient: float = 2e-4
    """``densify_gradient`` for the teeth."""
    mask_floor_mm: float = 0.0237277
    mask_full_mm: float = 5.7035
    """Displacement of the surface by one expression, at coefficient 1, up to which its differences are zero and not stored, and
    from which they have full weight. The published values are a tenth of the largest displacement by FLAME's 50th expression,
    and the largest by its first."""
    alpha_weight: float = 10.0
    """Weight of the mean squared difference of alpha and mask; ignored without masks."""
    teeth_weight: float = 100.0
    """Weight of the penalty on teeth that leave the mouth (`MouthCylinder`), the mean over each row, summed."""
    correctives_variant: Literal["paper", "official"] = "paper"
    """"paper" interpolates the pose correctives of a triangle's corners. "official" sums them as the authors' program does,
    which makes them three times too strong."""
    lower_teeth_variant: Literal["paper", "official"] = "paper"
    """"paper" lets the lower teeth follow only the jaw. "official" also lets them follow root and neck by 5.6 % as the authors'
    program does."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "at least 1", "samples")
        check_range(self, "at least 0", "teeth_samples", "expressions", "sample_spacing")
        if not 0 <= self.difference_sh_degree <= self.sh_degree:
            raise ValueError("difference_sh_degree must be 0 to sh_degree")
        if not 0 <= self.mask_floor_mm < self.mask_full_mm:
            raise ValueError("mask_floor_mm must be at least 0 and less than mask_full_mm")


SHORT: dict[str, Any] = {
    "sample_spacing": 2.0,
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 1e-3,
    "difference_sh_degree": 0,
    "difference_position_lr": 1e-5,
    "difference_sh_lr": 0.01,
    "difference_scale_lr": 2e-3,
    "difference_rotation_lr": 1e-3,
    "difference_opacity_lr": 5e-3,
}
"""Learning rates of runs much shorter than published (docs/explanation/methods/gbs.md, "Presets")."""
NO_DIFFERENCES = {name: 0.0 for name in SHORT if name.startswith("difference_") and name.endswith("_lr")}
SHORT_SPLATS: dict[str, Any] = {
    "initial_opacity": 0.5,
    "final_rate": 0.1,
    "position_lr": 4e-4,
    "position_lr_final": 4e-6,
    "scale_lr": 0.05,
    "rotation_lr": 0.01,
}


def _preset(iterations: int, samples: int, teeth: int, max_splats: int | None, **more: int) -> dict[str, Any]:
    splats = SHORT_SPLATS if max_splats is None else {**SHORT_SPLATS, "max_splats": max_splats}
    sizes = {"samples": samples, "teeth_samples": teeth, "splats": splats}
    return {"budget": {"iterations": iterations}, **SHORT, **more, **sizes}


PRESETS: dict[str, dict[str, Any]] = {
    "smoke": _preset(60, 3_000, 300, None),
    "quick": _preset(900, 6_000, 300, 10_000),
    "demo": _preset(2_000, 12_000, 600, 20_000),
    "fast": _preset(2_650, 30_000, 1_500, 40_000, difference_sh_degree=1),
    "gpu": {"budget": {"iterations": 30_000}},
    "paper": {"budget": {"iterations": 40_000}},
}

GBS = MethodSpec(
    name="gbs",
    demo=True,
    version="5",
    summary="GaussianBlendshapes: splats of a neutral head plus linear differences for each expression, skinned.",
    implementation="headbench.methods.gbs.method:GBS",
    config="headbench.methods.gbs.spec:GBSConfig",
    variants="headbench.methods.avatars.derived.recipes:gbs_variants",
    needs="headbench.methods.shared.method:splats",
    ablations={"no-differences": NO_DIFFERENCES},
    mechanism=Mechanism(
        "learnt differences", "position, opacity and colour by the learnt differences", "no-differences"
    ),
    presets=PRESETS,
    head_models=("flame2020", "procedural2020", "ict-facekit"),
    monocular=True,
    conversion="published",
    source="3D Gaussian Blendshapes for Head Avatar Animation, SIGGRAPH 2024, arXiv 2404.19398",
    bibtex=r"""@inproceedings{ma2024blendshapes,
  title     = {{3D} {Gaussian} Blendshapes for Head Avatar Animation},
  author    = {Ma, Shengjie and Weng, Yanlin and Shao, Tianjia and Zhou, Kun},
  booktitle = {ACM SIGGRAPH 2024 Conference Papers},
  year      = {2024},
  eprint    = {2404.19398},
}""",
)
