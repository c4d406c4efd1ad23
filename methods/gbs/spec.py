"""Spec of GaussianBlendshapes; the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import Mechanism, MethodSpec

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
    config="headbench.methods.gbs.config:GBSConfig",
    variants="headbench.methods.avatars.derived.recipes:gbs_variants",
    needs="headbench.methods.shared.needs:splats",
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
