"""Specs of "ours" and "ours-plus"; the implementation is not imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ...bench.specs import Mechanism, MethodSpec
from ..shared.config import splat_presets

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
    config="headbench.methods.ours.config:OursConfig",
    needs="headbench.methods.shared.needs:splats",
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
