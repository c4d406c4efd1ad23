"""Spec of INSTA; the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import Mechanism, MethodSpec

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
    config="headbench.methods.insta.config:InstaConfig",
    devices=("cpu",),
    variants="headbench.methods.avatars.derived.recipes:insta_variants",
    needs="headbench.methods.shared.needs:insta",
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
        "fast": {
            "budget": {"iterations": 1_050},
            **SHORT,
            "log2_table": 17,
            "finest_resolution": 768,
        },
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
