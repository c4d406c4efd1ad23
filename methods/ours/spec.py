"""Spec of "ours". Light: the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import MethodSpec
from ..shared.config import splat_presets

SHORT: dict[str, Any] = {
    "planes": {
        "lr": 8e-3,
        "network_lr": 1.5e-3,
        "residual_lr": 1e-2,
        "direction_smoothing": 0.3,
        "move_splats": False,
    },
    "lines": {"lr": 2e-2, "network_lr": 1e-3, "bounds": "face"},
    "penalty": {"weight": 1e-3, "softness": 0.1},
    "capacity": {"mode": "auto"},
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 1e-3,
}
"""Settings of runs much shorter than published (docs/explanation/methods/ours.md, "Presets")."""

OURS = MethodSpec(
    name="ours",
    default=True,
    demo=True,
    version="3",
    summary="Mesh-bound splats with tri-plane colour and expression-driven opacity along feature lines.",
    implementation="headbench.methods.ours.method:Ours",
    config="headbench.methods.ours.config:OursConfig",
    needs="headbench.methods.shared.needs:splats",
    variants="headbench.methods.avatars.derived.ours_variants:variants",
    presets=splat_presets(SHORT, {"planes": {"bounds_variant": "paper"}}),
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
