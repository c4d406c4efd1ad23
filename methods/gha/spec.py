"""Spec of Gaussian Head Avatar; the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import Mechanism, MethodSpec, ResolutionRule
from ..shared.config import PAPER_ITERATIONS

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
    config="headbench.methods.gha.config:GHAConfig",
    variants="headbench.methods.avatars.derived.recipes:gha_variants",
    needs="headbench.methods.shared.needs:splats",
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
