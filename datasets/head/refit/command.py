"""``headbench refit``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from ....bench.contracts import Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.specs import Findings, writes
from ...options import CaptureOptions
from ..arrays import HeadArrays

if TYPE_CHECKING:
    from ...clip import CaptureClip
    from .refit import RefitReport

Algorithm = Literal["slsqp", "lbfgs", "mma"]


@dataclass(frozen=True)
class RefitSettings:
    """How tracking is re-fitted to another head model.

    The defaults follow published practice for monocular methods: vertex distances over the facial region decide,
    identity comes from the neutral head, neither static offset nor neck rotation is kept.
    """

    static_offset: Literal["zero", "residual"] = "zero"
    """What the target's identity cannot express of the neutral head: dropped, or kept as a static offset
    (one topology only)."""

    neck: Literal["fold", "keep"] = "fold"
    """The neck's rotation: folded into the head's, as monocular trackers have it, or kept."""

    eyeballs: float = 1.0
    """Weight of an eyeball's vertex against one of the face; 0 leaves the eyes where they were."""

    lips: float = 1.0
    """Weight of a lip vertex against other vertices of the face."""

    eye_region: float = 1.0
    """Weight of a vertex around the eyes against other vertices of the face."""

    prior_mm: float = 0.005
    """A coefficient of one standard deviation costs as much as this root mean square distance, millimetres."""

    coefficient_bound: float = 6.0
    """Largest magnitude of identity and expression coefficients, standard deviations."""

    eyelid_bound: float = 2.0
    """Largest magnitude of an eyelid coefficient; 1 closes the eye."""

    jaw_bound: float = 0.9
    """Largest magnitude of each component of the jaw's axis-angle, radians."""

    eye_bound: float = 1.0
    """Largest magnitude of each component of an eye's axis-angle, radians."""

    algorithm: Algorithm = "slsqp"
    """Which of nlopt's algorithms finds the angles."""

    tolerance: float = 1e-5
    """An angle is found when a step changes it by less than this, radians."""

    evaluations: int = 200
    """Maximum number of evaluations per frame."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, (int, float)):
                continue
            lowest = 0.0 if name in ("eyeballs", "lips", "eye_region") else 1e-12
            if not lowest <= value < float("inf"):
                raise InputError("refit settings", name, f"a number of at least {lowest:g}", str(value))


@dataclass(frozen=True)
class RefitCommandSettings(CaptureOptions):
    """What ``headbench refit`` takes."""

    capture: Annotated[str, tyro.conf.Positional]
    """Capture, in a layout that a reader knows."""

    target: str
    """Head model to refit to: 2020 or 2023 (the embedded procedural heads), or the file of a head model."""

    out: str
    """Folder for the refitted capture, refit.json and heat_map.png."""

    settings: RefitSettings = field(default_factory=RefitSettings)
    """How to fit."""


BLOCKS_FOLDER = "refit-blocks"


@writes("out", "captures")
def refit_capture(settings: RefitCommandSettings, progress: Progress = no_progress) -> Findings:
    """Refit the tracking of a capture to another head model, with residuals in millimetres and a heat map.

    Started again after a kill it continues at the block of timesteps it was at.

    Writes under ``settings.out`` the capture (images linked), ``refit.json`` with every timestep's residuals and
    ``heat_map.png``. Raises `InputError` before any fitting where capture and head model do not go together.
    """
    from ...clip import check_apart
    from ...images import write_image
    from .heat_map import draw_heat_map
    from .refit import refit
    from .rewrite import capture_plan, write_capture

    out = Path(settings.out)
    target = target_head(settings.target)
    clip = settings.open(settings.capture, progress)
    if target.version == clip.head.version:
        raise InputError(
            "command line", "--target", f"another head model than {clip.head.version}", target.version
        )
    capture_plan(clip, settings.capture)  # What cannot be written again is found before the fit.
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
    return Findings("\n".join(lines), data)


def target_head(name: str) -> HeadArrays:
    """The head model of ``--target``: a version of the procedural head, or a file."""
    from ..loaders import load_head
    from ..procedural.model import VERSIONS, procedural_head

    short = [version.removeprefix("procedural") for version in VERSIONS]
    if name in (*short, *VERSIONS):
        return procedural_head(name)
    if not Path(name).exists():
        expected = f"{', '.join(short)} or the file of a head model"
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
