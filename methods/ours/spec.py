"""Specs and settings of "ours" and "ours-plus"; the implementation is not imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import Capacity, HarmonicsTraining, SplatTraining, check_range, splat_presets

Dynamic = Literal["opacity", "position", "rotation", "scale", "color"]
"""Attribute of a splat that an expression may change."""
Planned = Literal[
    "lines.expressions",
    "lines.jaw_bases",
    "lines.bounds",
    "lines.resolution",
    "planes.resolution",
    "splats.max_splats",
]
"""Sizes that a capacity plan decides."""


@dataclass(frozen=True)
class Planes:
    """The tri-plane and its colour network."""

    resolution: int = 128
    channels: tuple[int, int, int] = (32, 16, 16)
    """Samples per side, and channels of the (x,y), (x,z) and (y,z) planes."""
    bounds_variant: Literal["mesh", "paper"] = "mesh"
    """"mesh" fits the planes to the canonical mesh in all directions; "paper" sets x to +-0.25 m, which leaves half the samples
    in x unused on a head without long hair."""
    lr: float = 2e-3
    network_lr: float = 1e-4
    """Learning rates of the planes and of the network."""
    move_splats: bool = True
    """Whether the loss moves splats to positions where the planes have better colours, as published."""
    direction_smoothing: float = 0.0
    """Standard deviation of a view direction, radians: the colour network receives the mean of the encoding over such
    directions, which keeps colours smooth between the training cameras. 0 as published."""
    residual_lr: float = 0.0
    """Learning rate of a separate colour of each splat, added to that of the planes; 0, as published, disables it."""

    def __post_init__(self) -> None:
        if self.resolution < 2 or min(self.channels) < 1:
            raise ValueError("resolution must be at least 2, and channels at least 1")
        check_range(self, "at least 0", "direction_smoothing", "residual_lr")


@dataclass(frozen=True)
class Lines:
    """The feature lines and their network."""

    enabled: bool = True
    """Whether appearance is dynamic."""
    dynamic: tuple[Dynamic, ...] = ("opacity",)
    """Quantities that the lines change. The paper's method is opacity alone; position, rotation and scale are its Table 4,
    colour is an addition to that ablation."""
    resolution: int = 64
    channels: int = 32
    """Samples and channels per line."""
    expressions: int = 80
    jaw_bases: int = 16
    """Number of leading expression coefficients (all, if there are fewer) and jaw bases with lines."""
    jaw_bases_variant: Literal["paper", "official"] = "paper"
    """"paper" takes jaw bases from training poses, seeded with the identity. "official" draws them from held-out poses like the
    authors' program: a leak of test data, only for comparison with it."""
    bounds: Literal["head", "face"] = "face"
    """Box in which splats have dynamic opacity: the "face" region, as in the paper's supplement, or the "head" (whole mesh), as
    in the authors' program."""
    start: int = 60_000
    """Iteration (published scale) at which lines and penalty start."""
    lr: float = 2e-3
    network_lr: float = 1e-4
    """Learning rates of the lines and of the network."""

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.channels < 1:
            raise ValueError("resolution must be at least 2, and channels at least 1")
        check_range(self, "at least 0", "expressions", "jaw_bases")
        if not self.dynamic or len(set(self.dynamic)) != len(self.dynamic):
            raise ValueError(f"dynamic must name at least one attribute, each once, found {self.dynamic}")


RAMP_FROM = 1e-3
"""Fraction of the penalty's weight at the start of its ramp."""


@dataclass(frozen=True)
class Penalty:
    """The adaptive truncated opacity penalty."""

    weight: float = 1.0
    """0 turns it off."""
    ramp: int = 0
    """Iterations (published scale) from the start of the lines in which the weight rises to ``weight``, log-linear from
    `RAMP_FROM` of it; 0 as published. From lines at 0 the full weight prevents every change (docs/explanation/methods/ours.md,
    "Feature lines")."""
    softness: float = 0.0
    """Offsets below which |offset| is replaced by a parabola (Huber 1964), so that the sign of its gradient does not jump at 0
    and outweigh the image's gradient in the optimiser's second moments; 0 as published."""
    face_mm: float = 1.0
    other_mm: float = 2.0
    other_weight: float = 10.0
    """Surface displacement below which opacity may not change, in the face region and elsewhere, and the weight elsewhere."""

    def __post_init__(self) -> None:
        check_range(self, "at least 0", "ramp", "softness")


@dataclass(frozen=True)
class OuterLayers:
    """Additional initial splats outside each face triangle that training expressions move."""

    count: int = 0
    """Number of layers; 0 as published."""
    gap: float = 1.5e-3
    """Distance of two layers, metres."""
    opacity: float = 0.1
    """Opacity of these splats at the start, between 0 and 1."""

    def __post_init__(self) -> None:
        check_range(self, "at least 0", "count")
        check_range(self, "in (0, 1)", "opacity")
        check_range(self, "above 0", "gap")


@dataclass(frozen=True)
class Sampling:
    """Sampling of training images."""

    balanced: bool = True
    expression_clusters: int = 16
    """Whether clusters of expressions have equal shares, and their number."""
    clusters_variant: Literal["paper", "official"] = "paper"
    """"paper" is deterministic and does not compare all pairs of timesteps; "official" finds them as the authors' program does.
    Both use training timesteps only."""


@dataclass(frozen=True)
class PlannedCapacity(Capacity):
    """Size of the avatar: see `Capacity`."""

    detail: float = 1.0
    """Samples of the planes per pixel, along the longest side of their box. 1 keeps PSNR and LPIPS; 0.5 keeps only PSNR, in
    half the bytes."""
    keep: tuple[Planned, ...] = ()
    """Sizes that "auto" does not change."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "above 0", "detail")


@dataclass(frozen=True)
class OursConfig(HarmonicsTraining):
    """Compact tensorial Gaussian avatars (CVPR 2025): tri-plane colour, feature lines for opacity."""

    splats: SplatTraining = field(default_factory=SplatTraining)
    planes: Planes = field(default_factory=Planes)
    lines: Lines = field(default_factory=Lines)
    penalty: Penalty = field(default_factory=Penalty)
    outer_layers: OuterLayers = field(default_factory=OuterLayers)
    sampling: Sampling = field(default_factory=Sampling)
    capacity: PlannedCapacity = field(default_factory=PlannedCapacity)

    hidden: int = 128
    """Width of the hidden layers of the colour and opacity networks."""
    direction_jitter: float = 0.0
    """Standard deviation, radians, of a random rotation of all view directions in each iteration. No image shows the colours
    between the training cameras; jitter of the order of the cameras' spacing keeps them smooth. 0 as published."""
    color: Literal["planes", "sh"] = "planes"
    """"planes" reads colour from the tri-plane; "sh" gives every splat spherical harmonics of degree ``sh_degree`` in canonical
    directions instead (an ablation)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "at least 1", "hidden")


RAMP: dict[str, Any] = {"penalty": {"ramp": 480_000}}
"""All presets but "paper": with the full penalty from their start on, lines do not act (docs/explanation/methods/ours.md)."""
SHORT: dict[str, Any] = {
    **RAMP,
    "planes": {"lr": 8e-3, "network_lr": 1.5e-3},
    "lines": {"lr": 2e-2, "network_lr": 1e-3},
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 1e-3,
}
"""Learning rates of runs much shorter than published (docs/explanation/methods/ours.md, "Presets")."""
ADDITIONS: Mapping[str, Mapping[str, Any]] = {
    "weak-penalty": {"penalty": {"weight": 1e-3, "softness": 0.1, "ramp": 0}},
    "own-colors": {"planes": {"residual_lr": 1e-2}},
    "smooth-directions": {"planes": {"direction_smoothing": 0.3}},
    "fixed-positions": {"planes": {"move_splats": False}},
    "planned-sizes": {"capacity": {"mode": "auto"}},
}
"""Additions of "ours-plus" to the published method, by name."""
ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "no-lines": {"lines": {"enabled": False}},
    "lines-move-splats": {"lines": {"dynamic": ["position", "rotation", "scale"]}},
    "no-jaw-lines": {"lines": {"jaw_bases": 0}},
    "no-penalty": {"penalty": {"weight": 0.0}},
    "penalty-1e-3": {"penalty": {"weight": 1e-3, "ramp": 0}},
    "no-balanced-sampling": {"sampling": {"balanced": False}},
    "harmonics": {"color": "sh"},
    "official": {"lines": {"bounds": "head"}},
    **ADDITIONS,
}
"""The first two are the paper's Table 4; "official" is the choice of the authors' program, lines in the whole head."""


def _with_additions(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of "ours" and, in each group, those of all additions."""
    result = dict(settings)
    for groups in ADDITIONS.values():
        for group, values in groups.items():
            result[group] = {**result.get(group, {}), **values}
    return result


PAPER: dict[str, Any] = {"planes": {"bounds_variant": "paper"}}
PRESETS = splat_presets(SHORT, PAPER, quick=390, fast=2_050)

OURS = MethodSpec(
    name="ours",
    default=True,
    demo=True,
    version="5",
    summary="Mesh-bound splats with tri-plane colour and expression-driven opacity along feature lines.",
    implementation="headbench.methods.ours.method:Ours",
    config="headbench.methods.ours.spec:OursConfig",
    needs="headbench.methods.shared.method:splats",
    variants="headbench.methods.avatars.derived.recipes:ours_variants",
    ablations=ABLATIONS,
    mechanism=Mechanism("feature lines", "opacity of the splats inside the lines' box", "no-lines"),
    presets={**PRESETS, "gpu": {**PRESETS["gpu"], **RAMP}},
    source="3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations, "
    "CVPR 2025, arXiv 2504.14967",
    bibtex=r"""@inproceedings{wang2025compact,
  title     = {{3D} {Gaussian} Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations},
  author    = {Wang, Yating and Wang, Xuan and Yi, Ran and Fan, Yanbo and Hu, Jichen and Zhu, Jingcheng and Ma, Lizhuang},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2025},
  eprint    = {2504.14967},
}""",
)

OURS_PLUS = replace(
    OURS,
    name="ours-plus",
    version="4",
    default=False,
    ablations={"no-lines": ABLATIONS["no-lines"]},
    summary="The method ours with headbench's additions: weak penalty, colours of splats, smoothed directions, planned sizes.",
    implementation="headbench.methods.ours.method:OursPlus",
    presets=splat_presets(_with_additions(SHORT), _with_additions(PAPER), quick=400, fast=2_300),
    source=f"Additions by headbench to {OURS.source}",
)
