"""``headbench prepare refit``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from ....bench.contracts import Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.specs import CommandResult, command
from ...options import CaptureOptions
from ..arrays import HeadArrays
from .settings import RefitSettings

if TYPE_CHECKING:
    from ...clip import CaptureClip
    from .refit import RefitReport


@dataclass(frozen=True)
class RefitCommandSettings(CaptureOptions):
    """Settings of ``headbench prepare refit``."""

    capture: Annotated[str, tyro.conf.Positional]
    """Capture, in a layout that a reader knows."""

    target: str
    """Head model to refit to: 2020 or 2023 (the embedded procedural heads), or the file of a head model."""

    out: str
    """Folder for the refitted capture, refit.json and heat_map.png."""

    settings: RefitSettings = field(default_factory=RefitSettings)
    """How to fit."""


BLOCKS_FOLDER = "refit-blocks"


@command("prepare refit", group="data", writes="out", kinds=("captures",))
def refit_capture(settings: RefitCommandSettings, progress: Progress = no_progress) -> CommandResult:
    """Refit the tracking of a capture to another head model.

    A killed command continues at the last block of timesteps when it is run again.

    Writes under ``settings.out`` the capture (images linked), ``refit.json`` with every timestep's residuals and
    ``heat_map.png``.
    """
    from ...clip import check_apart
    from ...ga.writer import capture_plan, write_capture
    from ...images import write_image
    from ...inspect.figure import draw_heat_map
    from .refit import refit

    out = Path(settings.out)
    target = target_head(settings.target)
    clip = settings.open(settings.capture, progress)
    if target.version == clip.head.version:
        raise InputError(
            "command line", "--target", f"another head model than {clip.head.version}", target.version
        )
    capture_plan(clip, settings.capture)  # Captures that cannot be rewritten are detected before the fit.
    check_apart(clip, out)
    refitted = refit(clip, target, settings.settings, folder=out / BLOCKS_FOLDER, progress=progress)
    write_image(out / "heat_map.png", draw_heat_map(refitted))
    union = write_capture(refitted.clip, out, progress)
    report = refitted.report
    data = {
        "capture": union.as_posix(),
        "settings": asdict(settings.settings),
        **report.to_json(),
        "vertices_mm": [None if np.isnan(value) else round(float(value), 6) for value in report.vertex_mm],
    }
    write_json(out / "refit.json", data)
    lines = [report.text(), *_bounds(report, clip), f"Capture: {union}"]
    return CommandResult("\n".join(lines), data)


def target_head(name: str, option: str = "--target") -> HeadArrays:
    """The head model that an option names: a version of the procedural head, or a file."""
    from ..arrays import with_derived_regions
    from ..loaders import load_head
    from ..procedural.model import procedural_head
    from ..procedural.surface import PACKAGED
    from ..procedural.versions import VERSIONS

    short = [version.removeprefix("procedural") for version in VERSIONS]
    if name in (*short, *VERSIONS):
        return with_derived_regions(procedural_head(name))
    surface = Path(name).parts[-2:] == PACKAGED.parts[-2:]  # from which the procedural heads are made
    if surface or not Path(name).exists():
        expected = f"{', '.join(short)} or the file of a head model"
        remedy = "The embedded head models are given by their version." if surface else ""
        raise InputError("command line", option, expected, repr(name), remedy)
    return load_head(name)


def _bounds(report: RefitReport, clip: CaptureClip) -> list[str]:
    """The first few timesteps with parameters at a bound, by sequence."""
    sequence = {key.timestep: key.sequence for key in clip.files}
    bounded = [frame for frame in report.frames if frame.at_bound]
    lines = [
        f"  at a bound: {sequence.get(f.timestep, '')} {f.timestep}: {', '.join(f.at_bound)}"
        for f in bounded[:5]
    ]
    more = len(bounded) - len(lines)
    return lines + [f"  and {more} timesteps more"] * (more > 0)
