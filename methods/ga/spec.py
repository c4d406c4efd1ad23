"""Spec and settings of GaussianAvatars; the implementation is not imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import Capacity, HarmonicsTraining, SplatTraining, splat_presets


@dataclass(frozen=True)
class GAConfig(HarmonicsTraining):
    """GaussianAvatars: spherical harmonics per splat, and tracking refined with the avatar."""

    splats: SplatTraining = field(default_factory=SplatTraining)
    capacity: Capacity = field(default_factory=Capacity)

    refine_tracking: bool = True
    """Whether to optimise expression, poses and translation of the training timesteps."""
    expression_lr: float = 1e-3
    pose_lr: float = 1e-5
    translation_lr: float = 1e-6
    """Learning rates of the refined expression coefficients, joint rotations and translation."""


SHORT: dict[str, Any] = {"sh_dc_lr": 0.02, "sh_rest_lr": 1e-3}
"""Settings of runs much shorter than published (docs/explanation/methods/ga.md, "Presets")."""
GA = MethodSpec(
    name="ga",
    default=True,
    demo=True,
    version="3",
    summary="GaussianAvatars: splats with spherical harmonics rigged to the triangles of the tracked mesh.",
    implementation="headbench.methods.ga.method:GA",
    config="headbench.methods.ga.spec:GAConfig",
    needs="headbench.methods.shared.method:splats",
    variants="headbench.methods.avatars.derived.recipes:ga_variants",
    ablations={"no-refined-tracking": {"refine_tracking": False}},
    mechanism=Mechanism("refined tracking", "displacement by the refined tracking", "no-refined-tracking"),
    presets=splat_presets(SHORT, {}, quick=800, fast=4_000),
    source="GaussianAvatars: Photorealistic Head Avatars with Rigged 3D Gaussians, CVPR 2024, arXiv 2312.02069",
    bibtex=r"""@inproceedings{qian2024gaussianavatars,
  title     = {{GaussianAvatars}: Photorealistic Head Avatars with Rigged {3D} {Gaussians}},
  author    = {Qian, Shenhan and Kirschstein, Tobias and Schoneveld, Liam and Davoli, Davide and Giebenhain, Simon and
               Nie{\ss}ner, Matthias},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024},
  eprint    = {2312.02069},
}""",
)
