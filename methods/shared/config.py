"""Settings and presets shared by methods trained with splats; imports neither torch nor numpy.

The defaults are the published values (600,000 iterations). If the authors' program differs from the paper, a setting
``<name>_variant`` selects "paper" or "official".

Iterations are given on the published scale and mapped to the budget as fractions (`schedule.Timeline`); the
``min_...`` fields are lower limits in iterations of the actual run, below which a step would do harm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

RANGES: Mapping[str, Callable[[Any], bool]] = {
    "at least 1": lambda value: value >= 1,
    "at least 0": lambda value: value >= 0,
    "above 0": lambda value: value > 0,
    "in (0, 1)": lambda value: 0 < value < 1,
    "in (0, 1]": lambda value: 0 < value <= 1,
    "in [0, 1)": lambda value: 0 <= value < 1,
    "in [0, 1]": lambda value: 0 <= value <= 1,
}


def check_range(settings: object, wanted: str, *names: str) -> None:
    """Raise `ValueError` for the first of some settings that is outside of a range of `RANGES`; None is allowed."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not RANGES[wanted](value):
            raise ValueError(f"{name} must be {wanted}, found {value}")


@dataclass(frozen=True)
class SplatSettings:
    """Settings of every training of splats on images."""

    schedule_length: int = 600_000
    """Iterations of the published run; all settings in iterations are on its scale, unless they say otherwise."""
    opacity_lr: float = 0.05
    scale_lr: float = 0.017
    rotation_lr: float = 1e-3
    """Initial learning rates of opacities, scales and rotations of the splats."""
    initial_opacity: float = 0.1
    """Opacity of every splat at the start, between 0 and 1."""
    final_rate: float = 1.0
    """Final learning rate of all tensors but positions relative to the initial one, log-linear over the last half of the run; 1
    keeps it constant, as published. A short run lacks the steps to average Adam's noise."""
    mesh_cache_mb: int = 512
    """Memory for the posed meshes of known timesteps."""
    checkpoint_every_s: float = 120.0
    """Seconds between checkpoints of the training."""

    def __post_init__(self) -> None:
        check_range(self, "at least 1", "schedule_length")
        check_range(self, "in (0, 1)", "initial_opacity")
        check_range(self, "in (0, 1]", "final_rate")
        rates = (field.name for field in fields(self) if field.name.endswith(("_lr", "_share")))
        check_range(self, "at least 0", *rates)


@dataclass(frozen=True)
class SurfaceSettings(SplatSettings):
    """Settings of a fixed number of splats on the surface of a head, with a network of the tracked parameters."""

    samples: int = 10_000
    """Number of splats, about."""
    uv_chart: bool = True
    """One splat for each texel of the head model's chart of texture coordinates, as published, in a resolution that gives about
    ``samples``. Without it, and on a head model without a chart, splats are spread evenly over the surface."""
    hidden: int = 128
    """Width of the network's hidden layers."""
    network_lr: float = 1e-3
    """Learning rate of the network."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "at least 1", "samples", "hidden")


@dataclass(frozen=True)
class DensifiedTraining(SplatSettings):
    """Training and density control of splats: 3DGS, section 5, with GaussianAvatars' values."""

    position_lr: float = 5e-3
    position_lr_final: float = 5e-5
    """Initial and final rate, log-linear over the run, times the scene extent."""
    ssim_weight: float = 0.2
    """The loss is ``(1 - w) L1 + w (1 - SSIM)``."""
    densify_from: int = 10_000
    densify_every: int = 2_000
    densify_until: int = 600_000
    """Schedule of cloning, splitting and pruning."""
    densify_gradient: float = 2e-4
    """Mean gradient of the projected mean, in normalised device units, above which a splat is cloned or split."""
    densify_extent: float = 0.01
    """Splats larger than this fraction of the scene extent are split, smaller ones cloned."""
    split_variant: Literal["paper", "official"] = "paper"
    """"paper" scatters the two children of a split over the parent. "official" does as the authors' program, which uses
    world-space scales in local coordinates and so puts both children almost onto the parent."""
    prune_opacity: float = 0.005
    """Splats with less opacity are removed."""
    prune_extent: float = 0.1
    prune_extent_from: int = 60_000
    """Splats larger than this fraction of the extent are removed, from this iteration."""
    reset_every: int | None = 60_000
    reset_at_start: bool = True
    reset_opacity: float = 0.01
    """Opacities are reduced to ``reset_opacity`` regularly (None: never), and once when densification starts, if the background
    is white, as published."""
    max_splats: int | None = None
    """Densification stops adding above this number; None for no bound."""
    min_densify_every: int = 100
    min_reset_every: int = 3_000
    """In iterations of the actual run. A gradient mean needs several views, and opacities several steps to recover."""
    min_settle: int = 300
    """Number of last iterations of the actual run without densification; a run shorter than published has no reset in the last
    `schedule.RECOVERY` iterations, either."""

    def __post_init__(self) -> None:
        super().__post_init__()
        intervals = ("densify_every", "reset_every", "min_densify_every", "min_reset_every")
        check_range(self, "at least 1", *intervals, "max_splats")
        check_range(self, "in (0, 1)", "reset_opacity")
        check_range(self, "in [0, 1]", "ssim_weight")


@dataclass(frozen=True)
class SplatTraining(DensifiedTraining):
    """Training of splats bound to a mesh: GaussianAvatars (CVPR 2024), section 3 and its code."""

    position_weight: float = 0.01
    position_threshold: float = 1.0
    """Penalty on local positions longer than the threshold (triangle sizes)."""
    scale_weight: float = 1.0
    scale_threshold: float = 0.6
    """Penalty on local scales above the threshold (triangle sizes)."""


@dataclass(frozen=True)
class HarmonicsTraining:
    """Training of colours by spherical harmonics."""

    sh_degree: int = 3
    sh_every: int = 1_000
    min_sh_every: int = 100
    """Final degree of the spherical harmonics; it is raised by one every ``sh_every`` iterations (published scale), but at
    least ``min_sh_every`` of the actual run."""
    sh_dc_lr: float = 0.0025
    sh_rest_lr: float = 0.000125
    """Learning rates of the constant term and of the higher degrees of the spherical harmonics."""

    def __post_init__(self) -> None:
        check_range(self, "at least 1", "sh_every", "min_sh_every")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree must be 0 to 3, found {self.sh_degree}")


@dataclass(frozen=True)
class Capacity:
    """Size of an avatar."""

    mode: Literal["fixed", "auto"] = "fixed"
    """"fixed" uses the configured sizes. "auto" uses them as upper limits and chooses smaller ones from cameras, poses and
    pictures of the training split (`capacity.CapacityPlanner`)."""
    tolerance: float = 0.25
    """Pixels; smaller motion of the surface is ignored."""

    def __post_init__(self) -> None:
        check_range(self, "above 0", "tolerance")


PAPER_ITERATIONS = 600_000
GPU_ITERATIONS = 60_000
"""Preset "gpu": "paper" with these changes; an estimated hour per subject on one GPU."""
SHORT_SPLATS: Mapping[str, Any] = {
    "initial_opacity": 0.5,
    "final_rate": 0.1,
    "position_lr": 0.2,
    "position_lr_final": 1e-3,
    "scale_lr": 0.05,
    "rotation_lr": 0.01,
}
"""Settings of runs much shorter than published: splats start half opaque, with high learning rates of position, size
and rotation (`docs/explanation/methods/ga.md`)."""


def splat_presets(
    short: Mapping[str, Any], paper: Mapping[str, Any], quick: int, fast: int
) -> dict[str, dict[str, Any]]:
    """Presets of a mesh-bound method from its own settings for short and published runs, with budgets and splat settings.

    ``fast`` is the number of iterations of that preset, in which all native methods take about the same processor time at 275x401.
    """
    return {
        "smoke": {"budget": {"iterations": 60}, **short, "splats": SHORT_SPLATS},
        "quick": {"budget": {"iterations": quick}, **short, "splats": {**SHORT_SPLATS, "max_splats": 10_000}},
        "demo": {"budget": {"iterations": 2_000}, **short, "splats": {**SHORT_SPLATS, "max_splats": 20_000}},
        "fast": {"budget": {"iterations": fast}, **short, "splats": {**SHORT_SPLATS, "max_splats": 40_000}},
        **{
            name: {"budget": {"iterations": iterations}, **paper, "splats": {"split_variant": "official"}}
            for name, iterations in (("gpu", GPU_ITERATIONS), ("paper", PAPER_ITERATIONS))
        },
    }
