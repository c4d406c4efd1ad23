"""Settings of "ours". Light: neither torch nor numpy is imported here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ..shared.config import SplatTraining

Dynamic = Literal["opacity", "position", "rotation", "scale", "color"]
"""What an expression may change about a splat."""


Planned = Literal[
    "expressions", "jaw_bases", "line_bounds", "line_resolution", "plane_resolution", "max_splats"
]
"""Sizes that a capacity plan decides."""


@dataclass(frozen=True)
class OursConfig:
    """Compact tensorial Gaussian avatars (CVPR 2025): tri-plane colour, feature lines for opacity.

    Attributes
    ----------
    plane_resolution, plane_channels : samples per side, and channels of the (x,y), (x,z) and (y,z) planes.
    plane_bounds : "mesh" fits the planes to the canonical mesh in all directions; "published" sets x to +-0.25 m
        as the paper does, which leaves half the samples in x unused on a head without long hair.
    direction_noise : standard deviation, radians, of a random turn of all view directions in each iteration. What
        a colour does between the training cameras no image says; of the order of the cameras' spacing, noise keeps
        it from being anything but smooth. 0 as published.
    color : "planes" reads colour from the tri-plane; "sh" gives every splat spherical harmonics of degree
        ``sh_degree`` in canonical directions instead (an ablation).
    lines : dynamic appearance on or off.
    dynamic : what the lines change. The paper's method is opacity alone; position, rotation and scale are its
        Table 4, colour our addition to that ablation.
    line_resolution, line_channels, expressions, jaw_bases : samples and channels per line; how many leading
        expression coefficients (as many as there are, if fewer) and jaw bases have lines.
    line_bounds : box in which splats have dynamic opacity: the "head" (whole mesh) or the "face" region.
    lines_from : iteration (published scale) at which lines and penalty start.
    jaw_compatibility : "" takes jaw bases from training poses, seeded with the identity. "tga" reproduces the
        published code, which draws them from held-out poses: a leak, for comparison with it only.
    penalty : weight of the adaptive truncated opacity penalty; 0 turns it off.
    shells, shell_gap, shell_opacity : splats more at the start over each face triangle that training expressions
        move, outwards, metres apart (`shells`); 0 as published.
    penalty_softness : offsets under which the penalty's |offset| is rounded off to a parabola (Huber 1964), so that
        it does not chatter around 0 and drown what images say in the optimiser's second moments; 0 as published.
    penalty_face_mm, penalty_other_mm, penalty_other_weight : surface displacement under which opacity may not
        change, in the face region and elsewhere, and the weight elsewhere.
    balanced_sampling, expression_classes : draw images so that each class of expressions has an equal share.
    expression_compatibility : "" parts the classes the same way every time and needs no comparison of all pairs of
        timesteps; "tga" parts them as the published code does. Both see training timesteps alone.
    storage : "exact" keeps the avatar as float32; "compact" writes a quantised file beside it (`compact.file`), which
        is what is then loaded, rendered, measured and counted.
    capacity : "fixed" takes the sizes above as they are. "auto" takes them as upper limits and decides from the
        training data how much of them the scene requires: see `capacity.plan`.
    capacity_tolerance : pixels; motion of the surface below it counts as none.
    capacity_detail : samples of the planes per pixel, along the longest side of their box. 1 keeps PSNR and LPIPS;
        0.5 keeps PSNR alone, in half the bytes (`capacity.plan` has the figures).
    capacity_keep : sizes that "auto" leaves as they are.
    """

    splats: SplatTraining = field(default_factory=SplatTraining)
    plane_resolution: int = 128
    plane_channels: tuple[int, int, int] = (32, 16, 16)
    plane_bounds: Literal["mesh", "published"] = "mesh"
    plane_lr: float = 2e-3
    color_mlp_lr: float = 1e-4
    hidden: int = 128
    direction_noise: float = 0.0
    color: Literal["planes", "sh"] = "planes"
    sh_degree: int = 3
    sh_every: int = 1_000
    min_sh_every: int = 100
    sh_dc_lr: float = 0.0025
    sh_rest_lr: float = 0.000125
    lines: bool = True
    dynamic: tuple[Dynamic, ...] = ("opacity",)
    line_resolution: int = 64
    line_channels: int = 32
    expressions: int = 80
    jaw_bases: int = 16
    jaw_compatibility: Literal["", "tga"] = ""
    line_bounds: Literal["head", "face"] = "head"
    lines_from: int = 60_000
    line_lr: float = 2e-3
    line_mlp_lr: float = 1e-4
    penalty: float = 1.0
    penalty_softness: float = 0.0
    shells: int = 0
    shell_gap: float = 1.5e-3
    shell_opacity: float = 0.1
    penalty_face_mm: float = 1.0
    penalty_other_mm: float = 2.0
    penalty_other_weight: float = 10.0
    balanced_sampling: bool = True
    expression_classes: int = 16
    expression_compatibility: Literal["", "tga"] = ""
    storage: Literal["exact", "compact"] = "exact"
    capacity: Literal["fixed", "auto"] = "fixed"
    capacity_tolerance: float = 0.25
    capacity_detail: float = 1.0
    capacity_keep: tuple[Planned, ...] = ()

    def __post_init__(self) -> None:
        if not self.capacity_tolerance > 0:
            raise ValueError(f"capacity_tolerance must be above 0 pixels, found {self.capacity_tolerance}")
        if not self.capacity_detail > 0:
            raise ValueError(f"capacity_detail must be above 0, found {self.capacity_detail}")
        if self.plane_resolution < 2 or self.line_resolution < 2:
            raise ValueError("plane_resolution and line_resolution must be at least 2")
        if min(self.plane_channels) < 1 or self.line_channels < 1 or self.hidden < 1:
            raise ValueError("channel counts must be at least 1")
        if self.expressions < 0 or self.jaw_bases < 0 or self.shells < 0 or self.penalty_softness < 0:
            raise ValueError("expressions, jaw_bases, shells and penalty_softness must not be negative")
        if not 0 < self.shell_opacity < 1 or not self.shell_gap > 0:
            raise ValueError("shell_opacity must lie between 0 and 1, shell_gap above 0 metres")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree must be 0 to 3, found {self.sh_degree}")
        if not self.dynamic or len(set(self.dynamic)) != len(self.dynamic):
            raise ValueError(f"dynamic must name each thing once, and one at least, found {self.dynamic}")
