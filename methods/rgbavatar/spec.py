"""Spec and settings of RGBAvatar; the implementation is not imported.

The defaults are those of the authors' program for a monocular video (``config/offline.yaml``). Iterations are steps of the optimiser,
each over a batch; the program counts images, ten for each step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import SurfaceSettings, check_range

INPUTS = ("expression", "neck", "jaw", "eyes", "eyelids", "translation")
"""Tracked parameters that the weights may depend on."""
PUBLISHED_SAMPLES = 60_000
"""Number of splats to which the published initial size refers: texels of 256 x 256 covered by FLAME, rounded."""
LOCAL = 150
"""Size of the local pool of ``online``, the newest images; see `OnlineBatches`."""
OFFICIAL_LEAST = 0.1
"""Weight of a splat in a pixel above which the pixel counts for its initial colour in the authors' program."""


@dataclass(frozen=True)
class RGBAvatarConfig(SurfaceSettings):
    """RGBAvatar (CVPR 2025): splats on a mesh with a few blendshapes, whose weights are predicted by a small network."""

    schedule_length: int = 5_000
    samples: int = 60_000

    initial_scale_mm: float = 0.8
    """Size of every splat at the start, for 60,000 splats; fewer splats are larger, so that they cover as much."""
    initial_opacity: float = 0.5

    blendshapes: int = 20
    """Number of blendshapes of position, rotation and colour."""
    inputs: tuple[str, ...] = INPUTS
    """Tracked parameters that the weights of the blendshapes depend on, among expression, neck, jaw, eyes, eyelids and
    translation; those that the head model lacks are left out. The authors' program uses all of them for a video and only the
    expression for NeRSemble."""
    batch: int = 10
    together: int = 1
    """Images of a step, and how many of them show the same timestep, if it has that many cameras. The published batch draws its
    images independently, as 1 does."""
    online: bool = False
    """Train as if the images, sorted by timestep, arrived one after another, and draw mostly the newest (local-global
    sampling); blendshapes are trained from the start, and every splat is kept. Requires ``together`` = 1."""
    trained_per_arrival: int = 25
    """Images trained on for each that arrives in ``online``: 25 at the published 630 images a second and 25 frames a second.
    After 10 s of video 250 images have arrived in 625 steps of 10."""
    random_background: bool = True
    """Train on a random background for each image; ignored without masks."""
    ssim_weight: float = 0.0
    """The loss is ``(1 - w) L1 + w (1 - SSIM)``. The authors' program uses 0 for a video, 0.2 for NeRSemble."""
    join: int = 300
    """Step after which the blendshapes are trained."""
    position_lr: float = 8e-4
    position_lr_final: float = 8e-6
    position_settles: int = 3_000
    """Initial and final learning rate of positions in metres, log-linear up to the step ``position_settles``."""
    opacity_lr: float = 0.25
    scale_lr: float = 0.025
    rotation_lr: float = 0.005

    color_lr: float = 0.0125
    """Learning rate of colours."""
    position_share: float = 0.05
    rotation_share: float = 0.5
    color_share: float = 0.5
    """Learning rates of the blendshapes relative to those of the neutral splats."""
    color_weight: float = 0.1
    """A splat takes its initial colour from the images of the first step in which its weights over all pixels add up to more
    than this; 0 disables it."""
    color_every: int = 1
    """Steps between searches for splats without a colour, each of which costs as much as the step."""
    frame_variant: Literal["orthonormal", "official"] = "orthonormal"
    """Axes of positions and rotations of a splat. "orthonormal": an edge of its triangle, the normal, and their cross product.
    "official": tangent, bitangent and normal along the texture coordinates, which the head model must have; of unit length and
    not orthogonal, as in the authors' program."""
    color_init_variant: Literal["paper", "official"] = "paper"
    """Initial colours. "paper": means over all foreground pixels, set before the step of the optimiser and not changed by it.
    "official": only pixels in which a splat's weight is above `OFFICIAL_LEAST` count, colours are set after the step with the
    moments kept, and splats without a colour are removed at the end, as in the authors' program."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(
            self, "at least 1", "blendshapes", "batch", "together", "color_every", "trained_per_arrival"
        )
        if not self.inputs or not set(self.inputs) <= set(INPUTS) or len(set(self.inputs)) < len(self.inputs):
            raise ValueError(f"inputs must be among {', '.join(INPUTS)}, each once, found {self.inputs}")
        check_range(self, "above 0", "initial_scale_mm", "position_lr", "position_lr_final")
        check_range(self, "at least 0", "color_weight")
        check_range(self, "in [0, 1]", "ssim_weight")
        if self.frame_variant == "official" and not self.uv_chart:
            raise ValueError("uv_chart must be true with frame_variant=official, whose axes follow the chart")
        if self.color_init_variant == "official" and not self.color_weight > 0:
            raise ValueError(
                f"color_weight must be above 0 with color_init_variant=official, found {self.color_weight}"
            )
        if self.online and self.together != 1:
            raise ValueError(f"together must be 1 with online, found {self.together}")
        if self.online and self.batch > LOCAL:
            raise ValueError(f"batch must be at most {LOCAL} with online, found {self.batch}")

    def initial_scale(self, count: int) -> float:
        """Size of each of ``count`` splats at the start, metres."""
        return float(1e-3 * self.initial_scale_mm * (PUBLISHED_SAMPLES / count) ** 0.5)


NERSEMBLE: dict[str, Any] = {
    "schedule_length": 30_000,
    "samples": 83_000,
    "initial_scale_mm": 0.94,
    "inputs": ("expression",),
    "ssim_weight": 0.2,
    "join": 2_000,
    "position_lr": 1.6e-4,
    "position_lr_final": 1.6e-6,
    "position_settles": 30_000,
    "opacity_lr": 0.025,
    "scale_lr": 0.005,
    "rotation_lr": 0.001,
    "color_lr": 0.0025,
}
"""Values for several cameras, ``config/nersemble.yaml`` in https://github.com/ylark1203/gswork at 54a960c, a copy of the authors'
program with that configuration: 0.8 mm for each splat, which is 0.94 mm for 60,000."""
SHORT: dict[str, Any] = {
    "inputs": ("expression", "jaw", "eyes"),
    "ssim_weight": 0.2,
    "batch": 4,
    "together": 4,
    "random_background": False,
    "position_lr": 3e-3,
    "position_lr_final": 3e-5,
    "opacity_lr": 0.1,
    "scale_lr": 0.1,
    "rotation_lr": 0.05,
    "color_lr": 0.08,
    "final_rate": 0.1,
    "color_every": 10,
}
"""Settings of runs much shorter than published (docs/explanation/methods/rgbavatar.md, "Presets")."""
PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"budget": {"iterations": 60}, **SHORT, "samples": 3_000},
    "quick": {"budget": {"iterations": 400}, **SHORT, "samples": 10_000},
    "demo": {"budget": {"iterations": 700}, **SHORT, "samples": 20_000},
    "fast": {"budget": {"iterations": 1_250}, **SHORT, "samples": 40_000},
    "nersemble": {"budget": {"iterations": 30_000}, **NERSEMBLE},
    "gpu": {"budget": {"iterations": 5_000}},
    "paper": {"budget": {"iterations": 5_000}},
}

RGBAVATAR = MethodSpec(
    name="rgbavatar",
    version="2",
    summary="RGBAvatar: splats on the mesh with a few learnt blendshapes, weighted by a network of the tracked parameters.",
    implementation="headbench.methods.rgbavatar.method:RGBAvatar",
    config="headbench.methods.rgbavatar.spec:RGBAvatarConfig",
    variants="headbench.methods.avatars.derived.recipes:rgbavatar_variants",
    needs="headbench.methods.shared.method:splats",
    ablations={"no-blendshapes": dict.fromkeys(("position_share", "rotation_share", "color_share"), 0.0)},
    mechanism=Mechanism(
        "learnt blendshapes", "position and colour by the learnt blendshapes", "no-blendshapes"
    ),
    presets=PRESETS,
    source="RGBAvatar: Reduced Gaussian Blendshapes for Online Modeling of Head Avatars, CVPR 2025, arXiv 2503.12886",
    bibtex=r"""@inproceedings{li2025rgbavatar,
  title     = {{RGBAvatar}: Reduced {Gaussian} Blendshapes for Online Modeling of Head Avatars},
  author    = {Li, Linzhou and Li, Yumeng and Weng, Yanlin and Zheng, Youyi and Zhou, Kun},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2025},
  eprint    = {2503.12886},
}""",
)
