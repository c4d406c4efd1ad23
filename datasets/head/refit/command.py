"""``headbench refit``: carry a capture's tracking over to another head model and write it as a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ....bench.contracts import Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.specs import Findings
from ...clip import CaptureClip
from ...ga.reader import read_capture
from ...ga.writer import write_png
from ..arrays import HeadArrays
from ..loaders import load_head
from ..procedural.model import VERSIONS, procedural_head
from .heat_map import draw_heat_map
from .refit import RefitReport, refit
from .rewrite import capture_plan, write_capture
from .settings import RefitCommandSettings

_PROCEDURAL = tuple(version.removeprefix("procedural") for version in VERSIONS)
BLOCKS_FOLDER = "refit-blocks"


def run(settings: RefitCommandSettings, progress: Progress = no_progress) -> Findings:
    """Refit a capture; started again after a kill it continues at the block of timesteps it was at.

    Writes under ``settings.out`` the capture (images linked), ``refit.json`` with every timestep's residuals and
    ``heat_map.png``. Raises `InputError` before any fitting where capture and head model do not go together.
    """
    out = Path(settings.out)
    target = target_head(settings.target)
    clip = read_capture(settings.capture, head=settings.head, progress=progress)
    if target.version == clip.head.version:
        raise InputError(
            "command line", "--target", f"another head model than {clip.head.version}", target.version
        )
    capture_plan(clip, settings.capture)  # What cannot be written again is found before the fit.
    images = [files.image for files in clip.files.values() if files.image is not None]
    if any(out.resolve() in image.resolve().parents for image in images):
        raise InputError("command line", "--out", "a folder apart from the capture", str(out))
    refitted = refit(clip, target, settings.settings, folder=out / BLOCKS_FOLDER, progress=progress)
    write_png(out / "heat_map.png", draw_heat_map(refitted))
    union = write_capture(refitted.clip, out, progress)
    report = refitted.report
    data = {
        "capture": union.as_posix(),
        "settings": settings.settings.record(),
        **report.to_json(),
        "vertices_mm": [None if np.isnan(value) else round(float(value), 6) for value in report.vertex_mm],
    }
    write_json(out / "refit.json", data)
    lines = [report.text(), *_bounds(report, clip), f"Capture: {union}"]
    return Findings("\n".join(lines), data)


def target_head(name: str) -> HeadArrays:
    """The head model of ``--target``: a version of the procedural head, or a file."""
    if name in (*_PROCEDURAL, *VERSIONS):
        return procedural_head(name)
    if not Path(name).exists():
        expected = f"{', '.join(_PROCEDURAL)} or the file of a head model"
        raise InputError("command line", "--target", expected, repr(name))
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
