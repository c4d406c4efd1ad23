"""Specs of the official methods. Light: no implementation is imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...bench.specs import MethodSpec
from ..flashavatar.spec import FLASHAVATAR
from ..ga.spec import GA, SHORT
from ..gbs.spec import GBS
from ..gbs.spec import SHORT as GBS_SHORT
from ..gbs.spec import SHORT_SPLATS as GBS_SHORT_SPLATS
from ..gha.spec import GHA
from ..insta.spec import INSTA
from ..ours.spec import OURS
from ..rgbavatar.spec import RGBAVATAR
from ..shared.config import PAPER_ITERATIONS, SHORT_SPLATS


def _short_run() -> tuple[str, ...]:
    """Learning rates of the native methods' short presets, as options of the authors' training script."""
    rates: Mapping[str, Any] = {
        "--position_lr_init": SHORT_SPLATS["position_lr"],
        "--position_lr_final": SHORT_SPLATS["position_lr_final"],
        "--scaling_lr": SHORT_SPLATS["scale_lr"],
        "--rotation_lr": SHORT_SPLATS["rotation_lr"],
        "--feature_lr": SHORT["sh_dc_lr"],
    }
    return tuple(str(word) for pair in rates.items() for word in pair)


GA_OFFICIAL = MethodSpec(
    name="ga-official",
    summary="GaussianAvatars by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.ga.method:GAOfficial",
    config="headbench.methods.official.config:GAOfficialConfig",
    needs="headbench.methods.official.needs:ga",
    renders="headbench.methods.official.renders:gaussian_avatars",
    presets={
        "smoke": {"budget": {"iterations": 60}, "arguments": _short_run()},
        "demo": {"budget": {"iterations": 2_000}, "arguments": _short_run()},
        "fast": {"budget": {"iterations": 4_000}, "arguments": _short_run()},
        "paper": {"budget": {"iterations": PAPER_ITERATIONS}},
    },
    native=False,
    source="GaussianAvatars: Photorealistic Head Avatars with Rigged 3D Gaussians, CVPR 2024, arXiv 2312.02069",
    bibtex=GA.bibtex,
)

TGA_OFFICIAL = MethodSpec(
    name="tga-official",
    summary="The method ours by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.tga.method:TGAOfficial",
    config="headbench.methods.official.config:TGAOfficialConfig",
    needs="headbench.methods.official.needs:tga",
    renders="headbench.methods.official.renders:gaussian_avatars",
    # Their feature lines start at a fixed iteration, so shorter runs do not train the method.
    presets={"paper": {"budget": {"iterations": PAPER_ITERATIONS}}},
    native=False,
    source="3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations, "
    "CVPR 2025, arXiv 2504.14967",
    bibtex=OURS.bibtex,
)


def _short_blendshapes(samples: int) -> tuple[str, ...]:
    """The same for GaussianBlendshapes, whose script has fewer options, and the initial number of splats."""
    options: Mapping[str, Any] = {
        "--position_lr_init": GBS_SHORT_SPLATS["position_lr"],
        "--position_lr_final": GBS_SHORT_SPLATS["position_lr_final"],
        "--scaling_lr": GBS_SHORT_SPLATS["scale_lr"],
        "--rotation_lr": GBS_SHORT_SPLATS["rotation_lr"],
        "--feature_lr": GBS_SHORT["sh_dc_lr"],
        "--init_face_point_number": samples,
    }
    return tuple(str(word) for pair in options.items() for word in pair)


GBS_OFFICIAL = MethodSpec(
    name="gbs-official",
    summary="GaussianBlendshapes by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.gbs.method:GBSOfficial",
    config="headbench.methods.official.config:GBSOfficialConfig",
    needs="headbench.methods.official.needs:gbs",
    renders="headbench.methods.official.renders:gaussian_blendshapes",
    presets={
        name: {
            "budget": GBS.presets[name]["budget"],
            "arguments": _short_blendshapes(GBS.presets[name]["samples"]),
        }
        for name in ("smoke", "demo", "fast")
    }
    | {"paper": {"budget": GBS.presets["paper"]["budget"]}},
    head_models=GBS.head_models,
    monocular=True,
    native=False,
    source=GBS.source,
    bibtex=GBS.bibtex,
)

GHA_OFFICIAL = MethodSpec(
    name="gha-official",
    summary="Gaussian Head Avatar by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.gha.method:GHAOfficial",
    config="headbench.methods.official.config:GHAOfficialConfig",
    needs="headbench.methods.official.needs:gha",
    presets={
        "smoke": {"budget": {"iterations": 60}},
        "paper": {"budget": {"iterations": PAPER_ITERATIONS}},
    },
    preset_resolutions=GHA.preset_resolutions,
    native=False,
    source=GHA.source,
    bibtex=GHA.bibtex,
)

INSTA_OFFICIAL = MethodSpec(
    name="insta-official",
    summary="INSTA by its authors' code, built in your checkout; needs CUDA.",
    implementation="headbench.methods.official.insta.method:INSTAOfficial",
    config="headbench.methods.official.config:INSTAOfficialConfig",
    needs="headbench.methods.official.needs:insta",
    renders="headbench.methods.official.renders:insta",
    # Their settings have no schedule to shorten.
    presets={name: {"budget": INSTA.presets[name]["budget"]} for name in ("smoke", "demo", "fast", "paper")},
    monocular=True,
    native=False,
    source=INSTA.source,
    bibtex=INSTA.bibtex,
)

RGBAVATAR_OFFICIAL = MethodSpec(
    name="rgbavatar-official",
    summary="RGBAvatar by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.rgbavatar.method:RGBAvatarOfficial",
    config="headbench.methods.official.config:RGBAvatarOfficialConfig",
    needs="headbench.methods.official.needs:rgbavatar",
    # The published schedule, shortened; one iteration is a batch of ten images.
    presets={
        name: {"budget": RGBAVATAR.presets[name]["budget"]} for name in ("smoke", "demo", "fast", "paper")
    },
    head_models=("flame2020",),
    monocular=True,
    native=False,
    source=RGBAVATAR.source,
    bibtex=RGBAVATAR.bibtex,
)

FLASHAVATAR_OFFICIAL = MethodSpec(
    name="flashavatar-official",
    summary="FlashAvatar by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.flashavatar.method:FlashAvatarOfficial",
    config="headbench.methods.official.config:FlashAvatarOfficialConfig",
    needs="headbench.methods.official.needs:flashavatar",
    # The paper's number of iterations is not stated; "paper" is the default of their script.
    presets={
        "smoke": {"budget": {"iterations": 60}},
        "demo": {"budget": {"iterations": 2_000}},
        "fast": {"budget": {"iterations": 4_000}},
        "paper": {"budget": FLASHAVATAR.presets["paper"]["budget"]},
    },
    head_models=("flame2020",),
    monocular=True,
    native=False,
    source=FLASHAVATAR.source,
    bibtex=FLASHAVATAR.bibtex,
)
