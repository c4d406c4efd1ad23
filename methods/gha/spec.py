"""Spec and settings of Gaussian Head Avatar; the implementation is not imported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec, ResolutionRule
from ..shared.config import PAPER_ITERATIONS, check_range


@dataclass(frozen=True)
class GHAConfig:
    """Gaussian Head Avatar (CVPR 2024). The defaults are the published values.

    Lengths are canonical units: the head's own frame, ``unit`` metres each.
    """

    schedule_length: int = 600_000
    """Iterations of the published run; settings in iterations are on its scale."""
    mesh_fraction: float = 0.05
    """Fraction of the budget for the mesh phase."""
    unit: float = 0.1
    """Metres per canonical unit."""
    landmarks: int = 424
    """Number of points of the tracked face that define where expression has an effect."""
    near_squared: float = 0.1
    far_squared: float = 0.25
    """Squared distances from the nearest landmark up to which only expression has an effect, and from which only head pose has
    (0.1 and 0.25 units squared are 3.2 and 5 cm)."""
    start: Literal["sphere", "mesh"] = "sphere"
    """Shape that the signed distance is fitted to before the mesh phase: "sphere", as published, or "mesh", the tracked mesh,
    which saves iterations in a short run."""
    start_steps: int = 300
    """Number of steps of that fit."""
    grid_vertices: int = 277_410
    """Number of vertices of the tetrahedral grid around the head."""
    subdivide: bool = True
    """Whether to take the Gaussians from a grid of half the spacing, as published."""
    max_points: int | None = None
    """Maximum number of points taken from the mesh; None keeps all."""
    mouth_points: int = 3_000
    """Number of further points, drawn in a box behind the lips."""
    features: int = 128
    channels: int = 32
    """Number of features of a point, and of channels that are splatted; the first three are a colour."""
    geometry_hidden: tuple[int, ...] = (256,) * 5
    expression_color_hidden: tuple[int, ...] = (256, 256)
    pose_color_hidden: tuple[int, ...] = (128,)
    expression_deform_hidden: tuple[int, ...] = (256,) * 5
    pose_deform_hidden: tuple[int, ...] = (256, 256)
    expression_attribute_hidden: tuple[int, ...] = (256, 256, 256)
    pose_attribute_hidden: tuple[int, ...] = (128, 128)
    """Widths of the networks' hidden layers."""
    sr_widths: tuple[int, ...] = (128, 64, 32)
    """Widths of the super-resolution network's blocks. The first works at the splatted size, each further one at twice the size
    of the one before: their number decides how much smaller than the image splats are rendered."""
    residual: bool = False
    """Whether super-resolution adds to the splatted colours instead of replacing them, as published. A short run then starts
    from the result of splatting, with the colours of the mesh phase."""
    neutral_jaw: float = 0.0
    """Opening of the jaw in the neutral head, radians about the first axis. Displacements depend on position, so lips that
    touch could not separate; published landmarks start at an arbitrary first timestep."""
    motion_steps: int = 0
    """Steps that fit the deformation by expression to the head model's own (`TrackedMotion`) before the mesh phase; 0 as
    published."""
    motion_weight: float = 0.0
    """Weight of the same error in both phases, relative to the vertices' motion; 0 as published."""
    appearance_margin: float | None = None
    """How far the networks of colour and attributes follow each driving value beyond its training range, as a fraction of that
    range; None, as published, sets no limit. Values far outside of training otherwise tint a face."""
    zero_initialised: bool = False
    """Whether expression and pose initially have no effect, with zero deformation and attribute outputs, instead of small
    random ones: inputs that do not occur in a short capture then have no effect."""
    angle_unit: float = 1.0
    """Radians of jaw and eye angles that correspond to 1 in the expression code. Expression coefficients are of the order of 1,
    and a short run hardly responds to much smaller angles."""
    expression_noise: float = 0.0
    """Standard deviation of noise on each driving value of the networks of colour and attributes in training, drawn in every
    iteration. Few timesteps leave most directions of the code unseen; noise regularises the networks there. 0 as published."""
    displacement_scale: float = 0.3
    attribute_scale: float = 0.2
    """Factors of the networks' outputs."""
    initial_opacity: float = 0.3
    """Opacity of every Gaussian at the start, between 0 and 1."""
    mesh_views: int = 4
    mesh_size: int = 256
    """Views of a timestep in one iteration of the mesh phase, and the longer side of their images in pixels; smaller images are
    not resized."""
    landmark_weight: float = 1.0
    """Weight of the mean squared distance, in square units, between moved and tracked landmarks."""
    landmark_timesteps: int = 1
    """Number of timesteps with landmarks in one iteration of the mesh phase. Published is only the timestep of its images, but
    landmarks cost little, and a short run sees each timestep rarely."""
    mesh_lr: float = 1e-3
    landmark_lr: float = 1e-4
    """Learning rates of the mesh phase."""
    network_lr: float = 1e-4
    position_lr: float = 1e-5
    feature_lr: float = 1e-5
    rotation_lr: float = 1e-5
    scale_lr: float = 3e-5
    opacity_lr: float = 1e-4
    correction_lr: float = 1e-5
    """Learning rates of the Gaussian phase, the last one for the corrections of the tracked head pose, one for each training
    timestep."""
    final_rate: float = 1.0
    """Final learning rate of the Gaussian phase's tensors relative to the initial one, log-linear over the last half of the
    phase; 1 keeps it constant, as published."""
    low_weight: float = 1.0
    structure_weight: float = 0.1
    """Weights of the L1 loss at the splatted size and of 1 - SSIM at full size. The latter replaces the published 0.1 LPIPS,
    whose backbone cannot be distributed here."""
    low_image_variant: Literal["paper", "official"] = "paper"
    """"paper" compares the splatted colours with area means of the image; "official" with every fourth pixel, as the authors'
    program does."""
    augment: bool = True
    """Whether to rescale the feature image by 0.8 to 1.25 before super-resolution and crop or place it at random, as published."""
    checkpoint_every_s: float = 120.0
    """Seconds between checkpoints of the training."""

    def __post_init__(self) -> None:
        check_range(
            self, "at least 1", "schedule_length", "landmarks", "grid_vertices", "features", "max_points"
        )
        check_range(self, "at least 1", "mesh_views", "mesh_size", "landmark_timesteps")
        check_range(self, "in (0, 1)", "mesh_fraction", "initial_opacity")
        check_range(self, "in (0, 1]", "final_rate")
        check_range(self, "above 0", "unit", "angle_unit")
        check_range(self, "at least 0", "mouth_points", "start_steps", "expression_noise", "motion_steps")
        check_range(self, "at least 0", "motion_weight", "appearance_margin")
        if not 3 <= self.channels <= 32:
            raise ValueError(f"channels must be 3 to 32, found {self.channels}")
        if not 0 <= self.near_squared < self.far_squared:
            raise ValueError("near_squared must not be negative and far_squared must be larger")
        if not self.sr_widths or min(self.sr_widths) < 1:
            raise ValueError(f"sr_widths must have at least one width, all above 0, found {self.sr_widths}")

    @property
    def upscale(self) -> int:
        """Ratio of the image's size to the splatted size."""
        return 2 ** (len(self.sr_widths) - 1)


SHORT: dict[str, Any] = {
    "start": "mesh",
    "mesh_fraction": 0.12,
    "start_steps": 600,
    "grid_vertices": 12_000,
    "max_points": 8_000,
    "mouth_points": 600,
    "features": 32,
    "channels": 16,
    "geometry_hidden": (64, 64, 64),
    "expression_color_hidden": (64, 64),
    "pose_color_hidden": (32,),
    "expression_deform_hidden": (64, 64, 64),
    "pose_deform_hidden": (64, 64),
    "expression_attribute_hidden": (64, 64),
    "pose_attribute_hidden": (32,),
    "sr_widths": (16,),
    "residual": True,
    "initial_opacity": 0.7,
    "neutral_jaw": 0.15,
    "motion_steps": 1_500,
    "motion_weight": 0.1,
    "appearance_margin": 0.25,
    "zero_initialised": True,
    "angle_unit": 0.2,
    "expression_noise": 0.1,
    "mesh_views": 2,
    "mesh_size": 96,
    "landmark_weight": 100.0,
    "landmark_timesteps": 1,
    "mesh_lr": 2e-3,
    "network_lr": 5e-4,
    "position_lr": 5e-4,
    "feature_lr": 1e-2,
    "rotation_lr": 5e-3,
    "scale_lr": 1e-2,
    "opacity_lr": 2e-2,
    "final_rate": 0.1,
    "augment": False,
}
"""Settings of the short presets, which scale with the capture, for CPUs (docs/explanation/methods/gha.md)."""
NO_EXPRESSION = {"near_squared": 0.0, "far_squared": 1e-12, "motion_steps": 0, "motion_weight": 0.0}
"""Every point, and not only those far from the landmarks, depends on the head's pose alone."""
SHORT_PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        "budget": {"iterations": 60},
        **SHORT,
        "max_points": 2_000,
        "start_steps": 200,
        "motion_steps": 200,
    },
    "quick": {
        "budget": {"iterations": 200},
        **SHORT,
        "start_steps": 200,
        "motion_steps": 400,
        "max_points": 3_500,
        "mouth_points": 300,
    },
    "demo": {"budget": {"iterations": 1_500}, **SHORT},
    "fast": {"budget": {"iterations": 600}, **SHORT, "max_points": 20_000, "sr_widths": (32, 16)},
}


GHA = MethodSpec(
    name="gha",
    demo=True,
    version="4",
    summary="Gaussian Head Avatar: splats driven by networks, drawn as features, sharpened by another network.",
    implementation="headbench.methods.gha.method:GHA",
    config="headbench.methods.gha.spec:GHAConfig",
    variants="headbench.methods.avatars.derived.recipes:gha_variants",
    needs="headbench.methods.shared.method:splats",
    ablations={"no-expression": NO_EXPRESSION},
    mechanism=Mechanism(
        "expression networks", "position, opacity and colour by the expression", "no-expression"
    ),
    presets={
        **SHORT_PRESETS,
        "gpu": {"budget": {"iterations": 30_000}},
        "paper": {"budget": {"iterations": PAPER_ITERATIONS}},
    },
    preset_resolutions=dict.fromkeys(
        ("gpu", "paper"), ResolutionRule(square="pad", size=(2048, 2048), speed_size=(1024, 1024))
    ),
    source="Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians, CVPR 2024, arXiv 2312.03029",
    bibtex=r"""@inproceedings{xu2024gaussianheadavatar,
  title     = {{Gaussian} Head Avatar: Ultra High-fidelity Head Avatar via Dynamic {Gaussians}},
  author    = {Xu, Yuelang and Chen, Benwang and Li, Zhe and Zhang, Hongwen and Wang, Lizhen and Zheng, Zerong and
               Liu, Yebin},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024},
  eprint    = {2312.03029},
}""",
)
