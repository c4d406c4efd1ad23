"""Spec of FlashAvatar; the implementation is not imported."""

from __future__ import annotations

from typing import Any

from ...bench.specs import Mechanism, MethodSpec

SHORT: dict[str, Any] = {
    "initial_opacity": 0.5,
    "layers": 3,
    "hidden": 64,
    "zero_output": True,
    "offset_m": 0.05,
    "ssim_weight": 0.2,
    "scale_lr": 0.05,
    "rotation_lr": 0.01,
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 1e-3,
    "network_lr": 1e-3,
    "final_rate": 0.1,
}
"""Settings of runs much shorter than published (docs/explanation/methods/flashavatar.md, "Presets")."""

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"budget": {"iterations": 60}, **SHORT, "samples": 3_000},
    "quick": {"budget": {"iterations": 480}, **SHORT, "samples": 10_000},
    "demo": {"budget": {"iterations": 1_000}, **SHORT, "samples": 20_000},
    "fast": {"budget": {"iterations": 1_450}, **SHORT, "samples": 40_000},
    "gpu": {"budget": {"iterations": 30_000}},
    "paper": {"budget": {"iterations": 150_000}},
}

FLASHAVATAR = MethodSpec(
    name="flashavatar",
    version="2",
    summary="FlashAvatar: splats on the mesh, moved, turned and scaled by a network of the tracked parameters.",
    implementation="headbench.methods.flashavatar.method:FlashAvatar",
    config="headbench.methods.flashavatar.config:FlashAvatarConfig",
    variants="headbench.methods.avatars.derived.recipes:flashavatar_variants",
    needs="headbench.methods.shared.needs:splats",
    ablations={"no-offsets": {"zero_output": True, "network_lr": 0.0}},
    mechanism=Mechanism("offset network", "offsets of the splats from the mesh", "no-offsets"),
    presets=PRESETS,
    source="FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding, CVPR 2024, arXiv 2312.02214",
    bibtex=r"""@inproceedings{xiang2024flashavatar,
  title     = {{FlashAvatar}: High-fidelity Head Avatar with Efficient {Gaussian} Embedding},
  author    = {Xiang, Jun and Gao, Xuan and Guo, Yudong and Zhang, Juyong},
  booktitle = {Proceedings of the IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024},
  eprint    = {2312.02214},
}""",
)
