"""Specs of the official methods; no implementation is imported."""

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
from .config import option_words


def _short_rates(splats: Mapping[str, Any], colours: Mapping[str, Any]) -> tuple[str, ...]:
    """Learning rates of a native method's short presets, as options of the authors' training script."""
    rates = {
        "--position_lr_init": splats["position_lr"],
        "--position_lr_final": splats["position_lr_final"],
        "--scaling_lr": splats["scale_lr"],
        "--rotation_lr": splats["rotation_lr"],
        "--feature_lr": colours["sh_dc_lr"],
    }
    return tuple(option_words(rates))


def _lengths(**presets: int) -> dict[str, dict[str, Any]]:
    """Presets that set only these numbers of iterations."""
    return {name: {"budget": {"iterations": iterations}} for name, iterations in presets.items()}


def _lengths_of(native: MethodSpec) -> dict[str, dict[str, Any]]:
    """Presets that set only the budgets of the native method."""
    return {name: {"budget": native.presets[name]["budget"]} for name in ("smoke", "demo", "fast", "paper")}


def _paper_of(native: MethodSpec) -> dict[str, Any]:
    """Fields of the native method's spec about the paper, and fields common to all official methods."""
    return {
        "needs": "headbench.methods.official.needs:official",
        "native": False,
        "source": native.source,
        "bibtex": native.bibtex,
    }


GA_OFFICIAL = MethodSpec(
    name="ga-official",
    summary="GaussianAvatars by its authors' code, in your checkout and environment; needs CUDA or device=cpu-shim.",
    implementation="headbench.methods.official.ga.method:GAOfficial",
    config="headbench.methods.official.config:GAOfficialConfig",
    renders="headbench.methods.official.renders:gaussian_avatars",
    presets={
        name: preset | {"arguments": _short_rates(SHORT_SPLATS, SHORT)}
        for name, preset in _lengths(smoke=60, demo=2_000, fast=4_000).items()
    }
    | _lengths(paper=PAPER_ITERATIONS),
    **_paper_of(GA),
)

TGA_OFFICIAL = MethodSpec(
    name="tga-official",
    summary="The method ours by its authors' code, in your checkout and environment; needs CUDA or device=cpu-shim.",
    implementation="headbench.methods.official.tga.method:TGAOfficial",
    config="headbench.methods.official.config:TGAOfficialConfig",
    renders="headbench.methods.official.renders:gaussian_avatars",
    # Their feature lines start at a fixed iteration, so shorter runs do not train the method.
    presets=_lengths(paper=PAPER_ITERATIONS),
    **_paper_of(OURS),
)

_SAMPLES = "--init_face_point_number"
"""Option of GaussianBlendshapes for the initial number of splats; its script has fewer options for learning rates."""

GBS_OFFICIAL = MethodSpec(
    name="gbs-official",
    summary="GaussianBlendshapes by its authors' code, in your checkout and environment; needs CUDA or device=cpu-shim.",
    implementation="headbench.methods.official.gbs.method:GBSOfficial",
    config="headbench.methods.official.config:GBSOfficialConfig",
    renders="headbench.methods.official.renders:gaussian_blendshapes",
    presets=_lengths_of(GBS)
    | {
        name: {
            "budget": GBS.presets[name]["budget"],
            "arguments": (
                *_short_rates(GBS_SHORT_SPLATS, GBS_SHORT),
                *(_SAMPLES, str(GBS.presets[name]["samples"])),
            ),
        }
        for name in ("smoke", "demo", "fast")
    },
    head_models=GBS.head_models,
    monocular=True,
    **_paper_of(GBS),
)

GHA_OFFICIAL = MethodSpec(
    name="gha-official",
    summary="Gaussian Head Avatar by its authors' code, in your checkout and environment; needs CUDA.",
    implementation="headbench.methods.official.gha.method:GHAOfficial",
    config="headbench.methods.official.config:GHAOfficialConfig",
    presets=_lengths(smoke=60, paper=PAPER_ITERATIONS),
    preset_resolutions=GHA.preset_resolutions,
    **_paper_of(GHA),
)

INSTA_OFFICIAL = MethodSpec(
    name="insta-official",
    summary="INSTA by its authors' code, built in your checkout; needs CUDA.",
    implementation="headbench.methods.official.insta.method:INSTAOfficial",
    config="headbench.methods.official.config:INSTAOfficialConfig",
    renders="headbench.methods.official.renders:insta",
    # The authors' settings have no schedule to shorten.
    presets=_lengths_of(INSTA),
    monocular=True,
    **_paper_of(INSTA),
)

RGBAVATAR_OFFICIAL = MethodSpec(
    name="rgbavatar-official",
    version="2",
    summary="RGBAvatar by its authors' code, in your checkout and environment; needs CUDA or device=cpu-shim.",
    implementation="headbench.methods.official.rgbavatar.method:RGBAvatarOfficial",
    config="headbench.methods.official.config:RGBAvatarOfficialConfig",
    # The published schedule, shortened; one iteration is a batch of ten images.
    presets=_lengths_of(RGBAVATAR),
    head_models=("flame2020",),
    monocular=True,
    conversion="published",
    **_paper_of(RGBAVATAR),
)

FLASHAVATAR_OFFICIAL = MethodSpec(
    name="flashavatar-official",
    version="2",
    summary="FlashAvatar by its authors' code, in your checkout and environment; needs CUDA or device=cpu-shim.",
    implementation="headbench.methods.official.flashavatar.method:FlashAvatarOfficial",
    config="headbench.methods.official.config:FlashAvatarOfficialConfig",
    # The paper's number of iterations is not stated; "paper" is the default of their script.
    presets=_lengths(smoke=60, demo=2_000, fast=4_000)
    | {"paper": {"budget": FLASHAVATAR.presets["paper"]["budget"]}},
    head_models=("flame2020",),
    monocular=True,
    conversion="published",
    **_paper_of(FLASHAVATAR),
)
