"""``headbench track``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_json
from ...bench.io.files import write_json
from ...bench.io.videos import is_video
from ...bench.landmark_network import LICENCE, WHEEL, fetch_networks, interpreter_class
from ...bench.manifest import cut_of
from ...bench.progress import counted
from ...bench.protocol import evenly_with_ends
from ...bench.specs import CommandResult, command
from .settings import WORK, TrackSettings, check_work_folder, make_work_folder

if TYPE_CHECKING:
    from .track import RegionError, Tracked


REPORT, PICTURE = "track.json", "overlay.png"
ROWS, COLUMNS = 3, 4
"""Timesteps and cameras of the picture."""


@command(
    "track",
    group="data",
    writes="out",
    kinds=("captures",),
    programs={
        "vhap": "headbench.datasets.tracking.programs:vhap",
        "pixel3dmm": "headbench.datasets.tracking.programs:pixel3dmm",
    },
)
def track_capture(settings: TrackSettings, progress: Progress = no_progress) -> CommandResult:
    """Track the head model of a capture in its images, without using its tracking.

    Writes under ``settings.out`` the capture (images linked), ``track.json`` with every timestep's residuals and
    ``overlay.png``. Intermediate results are stored there, so that an interrupted call can be resumed.
    """
    if settings.fetch_networks:
        files = fetch_networks()
        text = f"Networks of {WHEEL} ({LICENCE}):"
        return CommandResult("\n".join([text, *map(str, files)]), {"networks": [*map(str, files)]})
    if settings.program != "light":
        from .programs import track_with_program

        return track_with_program(settings, progress)
    out = Path(settings.out)
    work = out / WORK
    check_work_folder(work)
    if is_video(Path(settings.capture)):
        interpreter_class()  # refuses before any slow import

    from ..clip import check_apart
    from ..ga.writer import capture_plan, write_capture
    from ..images import write_image
    from ..inspect.figure import draw_overlay
    from ..steps.masks import label_files, without_torso
    from ..video.command import video_to_track
    from .landmarks import landmark_source
    from .track import LandmarkSource, check_cameras, track, tracking_errors

    used = {name: value for name, value in asdict(settings).items() if name not in ("out", "against")}
    _check_same_settings(out / REPORT, used)
    if is_video(Path(settings.capture)):
        video = video_to_track(settings, work, progress)
        clip = video.clip
    else:
        video, clip = None, settings.open(settings.capture, progress)
        settings.check_capture(settings.capture)
        check_apart(clip, out)
        teacher = settings.open(settings.embedding, progress) if settings.embedding else None
    exact = settings.open(settings.against, progress) if settings.against else None
    capture_plan(clip, settings.capture)  # Captures that cannot be rewritten are detected before the fit.
    check_cameras(clip, cameras := [*settings.cameras] or [*clip.cameras])
    notes = {
        "landmarks": video.network
        if video
        else Path(settings.landmarks).name or "vertices of the tracked mesh",
        "seed": settings.seed,
    }
    source: LandmarkSource
    if video is not None:
        source = video.landmarks
        if settings.parsing:
            label_files(clip, settings.parsing)  # Labels that cannot be read are detected before the fit.
    else:
        source = landmark_source(
            clip, cameras, settings.landmarks, teacher, seed=settings.seed, progress=progress
        )
    make_work_folder(work)
    tracked = track(
        clip,
        cameras,
        source,
        notes=notes,
        store=work,
        times=video.times if video else None,
        progress=progress,
    )
    if video is not None:
        tracked = tracked._replace(
            clip=without_torso(tracked.clip, settings.cut, settings.parsing, video.view.image)
        )
    timesteps = evenly_with_ends([residual.timestep for residual in tracked.report.residuals], ROWS)
    overlay = draw_overlay(tracked.clip, timesteps, evenly_with_ends(cameras, COLUMNS))
    write_image(out / PICTURE, overlay)
    union = _moved(write_capture(tracked.clip, work / "capture", progress), out)
    if video is not None:
        video.data["video"]["frames_used"] = [
            video.numbers[residual.timestep] for residual in tracked.report.residuals
        ]
    data: dict[str, Any] = {
        "capture": union.as_posix(),
        "settings": used,
        "cut": cut_of(map(asdict, tracked.clip.steps)),
        **notes,
        **(video.data if video else {}),
        **tracked.report.to_json(),
    }
    lines = [*(video.lines if video else []), *_text(tracked, video.numbers if video else None)]
    if exact is not None:
        errors = tracking_errors(tracked.clip, exact)
        data["errors_mm"] = {name: error._asdict() for name, error in errors.items()}
        lines += _table(errors)
    write_json(out / REPORT, data)
    shutil.rmtree(work)
    return CommandResult("\n".join([*lines, f"Capture: {union}"]), data)


def _check_same_settings(report: Path, used: Mapping[str, Any]) -> None:
    """Raise `InputError` if there is a tracking by other settings, whose capture would be mixed with the new one."""
    if not report.is_file():
        return
    known = checked(read_json(report).get("settings"), dict[str, Any], report, "settings")
    wanted = json.loads(json.dumps(used))
    if other := [name for name in wanted if known.get(name) != wanted[name]]:
        name = other[0]
        remedy = "Give another --out, or delete the folder."
        raise InputError(report, f"settings.{name}", repr(wanted[name]), repr(known.get(name)), remedy)


def _moved(union: Path, out: Path) -> Path:
    """Move a whole capture to ``out`` in place of an earlier one, its union last; returns the union's folder."""
    for folder in sorted(union.parent.iterdir(), key=lambda path: path == union):
        target = out / folder.name
        if target.exists():
            shutil.rmtree(target)
        folder.replace(target)
    return out / union.name


def _text(tracked: Tracked, numbers: Sequence[int] | None) -> list[str]:
    """Lines of a summary; timesteps are those of the input, of a video the ``numbers`` of its frames."""
    from ..video.command import listed

    report, summary = tracked.report, tracked.report.summary()
    timesteps = counted(len(report.residuals), "timestep")
    cameras = counted(len(report.cameras), "camera")
    total = len(report.residuals) + len(report.left_out)
    lines = [f"{timesteps} of {total} tracked, {cameras}, {summary['seconds_per_timestep']:.2f} s a timestep"]
    for name, found, why in (
        ("left out", report.without_landmarks, "where no landmarks fit the head model"),
        ("left out", report.outliers, "whose fit differs from that of the neighbours"),
        ("repeated", report.fitted_again, "whose first fit differed from that of the neighbours"),
    ):
        if found:
            lines.append(f"  {name}   {listed([numbers[one] if numbers else one for one in found])}, {why}")
    return [
        *lines,
        f"  landmarks  {summary['landmarks_px']:.2f} pixels root mean square",
        f"  colours    {summary['colour_levels']:.2f} levels of 255, median",
    ]


def _table(errors: Mapping[str, RegionError]) -> list[str]:
    rows = [(name, *(f"{value:.2f}" for value in error)) for name, error in errors.items()]
    return [
        f"  {a:14} {b:>9} {c:>9} {d:>9}"
        for a, b, c, d in [("error, mm rms", "absolute", "affine", "motion"), *rows]
    ]
