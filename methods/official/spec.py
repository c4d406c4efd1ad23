"""Specs and settings of the official methods; no implementation is imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

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
from ..shared.config import PAPER_ITERATIONS, SHORT_SPLATS, check_range


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Options and their values as words of a command."""
    return [str(word) for pair in options.items() for word in pair]


@dataclass(frozen=True)
class OfficialConfig:
    """Location of the authors' code, and how to run it."""

    checkout: str = ""
    """Folder of a checkout of the authors' repository. It is read, never written."""
    python: str = ""
    """Command that starts the interpreter for their code: a path, or words such as ``conda run --no-capture-output -n ga
    python`` or ``apptainer exec --nv ga.sif python``. A container must see the checkout and the run folder under the same
    paths."""
    commit: str = ""
    """Expected commit of the checkout, by at least its first seven digits; "" accepts any."""
    arguments: tuple[str, ...] = ()
    """Appended to their training command."""
    device: Literal["cuda", "cpu-shim"] = "cuda"
    """Device of their code. It supports only "cuda"; "cpu-shim" replaces its rasteriser by the CPU renderer of this package and
    other CUDA code by stand-ins (`shim.cpu`), with headbench's interpreter unless ``python`` names another one with headbench.
    Rows are then labelled "(cpu-shim)" and are not results of the original."""
    order: Literal["published", "native"] = "published"
    """Order of the training images: as their code draws them, or as the native method does with the same seed, so that both use
    the same image in each iteration."""
    time_limit_hours: float | None = None
    """Time after which one of their programs is ended and its cell fails; None for no limit."""
    places: ClassVar[tuple[str, ...]] = ("checkout", "python", "time_limit_hours")

    def __post_init__(self) -> None:
        check_range(self, "above 0", "time_limit_hours")

    @property
    def label(self) -> str:
        """Suffix of the method's name in rows and tables."""
        return "" if self.device == "cuda" else self.device


@dataclass(frozen=True)
class GAOfficialConfig(OfficialConfig):
    """GaussianAvatars by its authors' code; the default commit is the one that the adapter was written for."""

    commit: str = "30cc4bde86b59968c2848934bdd962f410fb63f6"


@dataclass(frozen=True)
class TGAOfficialConfig(OfficialConfig):
    """The method of `ours` by its authors' code; the default commit is the one that the adapter was written for."""

    commit: str = "828adf5575cfe493907de7cc04ad78aba70bcd10"


@dataclass(frozen=True)
class GBSOfficialConfig(OfficialConfig):
    """GaussianBlendshapes by its authors' code; the default commit is the one that the adapter was written for."""

    commit: str = "2952da7d246e5790140dbb477d1468214564f092"


@dataclass(frozen=True)
class GHAOfficialConfig(OfficialConfig):
    """Gaussian Head Avatar by its authors' code; the default commit is the one that the adapter was written for.

    Their scripts take only a configuration file, which is written here, so ``arguments`` must be empty.
    """

    commit: str = "d006861f117e1a74174c29631383386ad876922c"

    mesh_fraction: float = 0.05
    """Fraction of the iterations for the mesh head; their scripts are stopped manually."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "in (0, 1)", "mesh_fraction")
        if self.arguments:
            raise ValueError("arguments must be empty: the authors' scripts have none")


@dataclass(frozen=True)
class INSTAOfficialConfig(OfficialConfig):
    """INSTA by its authors' code; the default commit is the one that the adapter was written for.

    Their code is a compiled program, so ``python`` must be empty.
    """

    commit: str = "9c17968ed719f487025577f0fc477749134639c6"

    program: str = "build/rta"
    """The built program: a file, in the checkout unless its path is absolute, or words that start it, such as ``apptainer exec
    --nv insta.sif /path/INSTA/build/rta``."""
    images_on_gpu: int = 1700
    """Number of training images in the GPU's memory; if there are more, their code loads others every 1,500 iterations."""
    places: ClassVar[tuple[str, ...]] = (*OfficialConfig.places, "program")

    def __post_init__(self) -> None:
        if self.python:
            raise ValueError("python must be empty: the authors' code is a program; set program")
        check_range(self, "at least 1", "images_on_gpu")


SET_ENTRIES = (
    "data_dir",
    "output_dir",
    "dataset",
    "batch_size",
    "iteration",
    "blend_start_iter",
    "position_lr_max_steps",
    "tex_size",
    "init_scaling",
)
"""Entries of RGBAvatar's configuration that the adapter writes."""


@dataclass(frozen=True)
class RGBAvatarOfficialConfig(OfficialConfig):
    """RGBAvatar by its authors' code; the default commit is the one that the adapter was written for."""

    commit: str = "54a960cd947d236a65f43e0c4b13ce54631a2290"

    samples: int = 60_000
    """With ``device=cpu-shim``, number of splats, about, on a head of another topology than FLAME's: they are those of the
    native method with this setting. On FLAME's topology the authors' chart of 256 x 256 texels is used."""
    motion: Literal["neck", "root"] = "neck"
    """"neck": the motion of the head is moved into the neck joint, as published. "root": it stays that of the whole head."""
    values: tuple[str, ...] = ()
    """Other values for entries of their configuration, as ``NAME=VALUE``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "at least 1", "samples")
        for each in self.values:
            if "=" not in each or each.partition("=")[0] in SET_ENTRIES:
                known = f"NAME=VALUE of other entries than {', '.join(SET_ENTRIES)}, which headbench sets"
                raise ValueError(f"values must be {known}, found {each!r}")


@dataclass(frozen=True)
class FlashAvatarOfficialConfig(OfficialConfig):
    """FlashAvatar by its authors' code; the default commit is the one that the adapter was written for."""

    commit: str = "2d4cb25ca9166b795c03692aec12114d595eff15"

    samples: int = 13_500
    """With ``device=cpu-shim``, number of splats, about, on a head of another topology than FLAME's: they are those of the
    native method with this setting. On FLAME's topology the authors' chart of 128 x 128 texels is used."""
    masks: Literal["parts", "native"] = "parts"
    """"parts": masks of head with neck and of the visible mouth, in place of those of the authors' network. "native": nothing
    that a mask of the capture covers is left out, and the mouth is that of the native method, so that both have the same loss."""
    start: Literal["published", "native"] = "published"
    """"native": the network starts as that of the native method with this seed, and sizes with the distances on the neutral
    mesh, as there. "published": a network drawn by the program, and distances in the first frame drawn, where this network has
    already moved the splats."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "at least 1", "samples")


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
    config="headbench.methods.official.spec:GAOfficialConfig",
    renders="headbench.methods.official.workplace:gaussian_avatars",
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
    config="headbench.methods.official.spec:TGAOfficialConfig",
    renders="headbench.methods.official.workplace:gaussian_avatars",
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
    config="headbench.methods.official.spec:GBSOfficialConfig",
    renders="headbench.methods.official.workplace:gaussian_blendshapes",
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
    config="headbench.methods.official.spec:GHAOfficialConfig",
    presets=_lengths(smoke=60, paper=PAPER_ITERATIONS),
    preset_resolutions=GHA.preset_resolutions,
    **_paper_of(GHA),
)

INSTA_OFFICIAL = MethodSpec(
    name="insta-official",
    summary="INSTA by its authors' code, built in your checkout; needs CUDA.",
    implementation="headbench.methods.official.insta.method:INSTAOfficial",
    config="headbench.methods.official.spec:INSTAOfficialConfig",
    renders="headbench.methods.official.workplace:insta",
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
    config="headbench.methods.official.spec:RGBAvatarOfficialConfig",
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
    config="headbench.methods.official.spec:FlashAvatarOfficialConfig",
    # The paper's number of iterations is not stated; "paper" is the default of their script.
    presets=_lengths(smoke=60, demo=2_000, fast=4_000)
    | {"paper": {"budget": FLASHAVATAR.presets["paper"]["budget"]}},
    head_models=("flame2020",),
    monocular=True,
    conversion="published",
    **_paper_of(FLASHAVATAR),
)
