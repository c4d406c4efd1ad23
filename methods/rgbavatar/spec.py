"""Spec of RGBAvatar; the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import Mechanism, MethodSpec

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
    config="headbench.methods.rgbavatar.config:RGBAvatarConfig",
    variants="headbench.methods.avatars.derived.recipes:rgbavatar_variants",
    needs="headbench.methods.shared.needs:splats",
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
