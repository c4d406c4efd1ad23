"""``headbench prepare tongue``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ....bench.contracts import Progress
from ....bench.errors import InputError
from ....bench.specs import CommandResult, command
from ...lint.rules import spans
from ...options import CaptureOptions

if TYPE_CHECKING:
    from ...clip import CaptureClip
    from ..exclude import Exclusions


@dataclass(frozen=True)
class TongueSettings(CaptureOptions):
    """Settings of the search for frames with the tongue."""

    capture: Annotated[str, tyro.conf.Positional]
    """Capture, in a layout that a reader knows, or a folder of several subjects' captures."""

    out: str
    """Folder for tongue.yaml and the contact sheets. Overrides in an existing tongue.yaml are kept."""

    masks: str | None = None
    """FLAME_masks.pkl, for a head model without regions."""

    threshold: float | None = None
    """Minimum area in mm2 of excluded frames; by default chosen for each subject between 20 and 60."""

    cameras: int = 4
    """Number of cameras to evaluate, the most frontal ones for the mouth."""

    frames: int = 60
    """Number of frames on a contact sheet, those with the largest areas."""


DECISIONS_FILE = "tongue.yaml"


@command("prepare tongue", group="data", writes="out")
def tongue(settings: TongueSettings, progress: Progress) -> CommandResult:
    """Find the frames that show the tongue, for review on a contact sheet."""
    from ..exclude import read_exclusions, write_exclusions

    _check(settings)
    out = Path(settings.out)
    path = out / DECISIONS_FILE
    decided = read_exclusions(path) if path.exists() else {}
    clips = list(settings.open_all(settings.capture, progress, masks=settings.masks))
    text, data = [], {}
    for clip in clips:
        earlier = decided.get(clip.subject)
        decided[clip.subject] = _look(clip, settings, earlier, out / f"tongue_{clip.subject}.png", progress)
        # After every subject, so that a killed run keeps its results.
        write_exclusions(path, decided)
        text.append(_summary(clip.subject, decided[clip.subject]))
        data[clip.subject] = _data(decided[clip.subject])
    text.append(f"Decisions: {path}\nTo leave these frames out: --set reader_settings.exclude={path}")
    return CommandResult("\n\n".join(text), data)


def _look(
    clip: CaptureClip, settings: TongueSettings, earlier: Exclusions | None, sheet: Path, progress: Progress
) -> Exclusions:
    """Decide on one subject and draw its contact sheet."""
    from .evidence import decide, find_evidence, write_sheet
    from .mouth import facing_cameras, frames_by_timestep, mouth_atlas, sample_clip

    overrides = earlier.overrides if earlier else {}
    frames = frames_by_timestep(clip)
    unknown = sorted(set(overrides) - set(frames))
    if unknown:
        where = f"subjects.{clip.subject}.overrides"
        raise InputError(
            Path(settings.out) / DECISIONS_FILE, where, "timesteps of the capture", str(unknown)[1:-1]
        )
    atlas = mouth_atlas(clip)
    cameras = facing_cameras(clip, atlas, settings.cameras)
    colours = sample_clip(clip, atlas, cameras, progress)
    evidence = find_evidence(colours, atlas)
    sequences = {t: next(iter(frames[t].values())).sequence for t in colours.timesteps}
    decided = decide(sequences, evidence, tuple(cameras), settings.threshold, overrides)
    write_sheet(sheet, clip, atlas, evidence, colours.timesteps, decided, settings.frames)
    return decided


def _check(settings: TongueSettings) -> None:
    for name, least in (("cameras", 1), ("frames", 1)):
        if getattr(settings, name) < least:
            raise InputError(f"--{name}", "", f"at least {least}", str(getattr(settings, name)))
    if settings.threshold is not None and not 0 < settings.threshold < float("inf"):
        raise InputError("--threshold", "", "an area above 0, mm2", str(settings.threshold))


def _summary(subject: str, decided: Exclusions) -> str:
    """Summary of the decisions by sequence."""
    from ..exclude import KEEP

    reasons = decided.reasons()
    lines = [f"Subject {subject}: {len(reasons)} of {len(decided.frames)} timesteps left out"]
    lines.append(
        f"  Threshold {decided.threshold:g} mm2: {decided.basis}. Cameras {', '.join(decided.cameras)}"
    )
    sequences: dict[str, list[int]] = {}
    for timestep in reasons:
        frame = decided.frames.get(timestep)  # None for timesteps excluded manually that no camera recorded
        sequences.setdefault(frame.sequence if frame else "in no camera", []).append(timestep)
    lines += [f"  {name}: {spans(timesteps, len(timesteps))}" for name, timesteps in sequences.items()]
    if near := _near(decided):
        lines.append(f"  To review, near the threshold: {spans(near, len(near))}")
    if unseen := [t for t, frame in decided.frames.items() if frame.reason.startswith("mouth not seen")]:
        lines.append(f"  Mouth not seen, kept: {spans(unseen, len(unseen))}")
    if decided.overrides:
        kept = sum(word == KEEP for word in decided.overrides.values())
        lines.append(f"  Overrides: {kept} kept, {len(decided.overrides) - kept} left out by hand.")
    return "\n".join(lines)


def _data(decided: Exclusions) -> dict[str, object]:
    return {
        "timesteps": len(decided.frames),
        "excluded": {str(t): reason for t, reason in decided.reasons().items()},
        "threshold_mm2": decided.threshold,
        "near_threshold": _near(decided),
        "cameras": list(decided.cameras),
    }


def _near(decided: Exclusions) -> list[int]:
    """Timesteps without override whose score is within `NEAR` of the threshold."""
    from .evidence import NEAR

    low, high = decided.threshold / NEAR, decided.threshold * NEAR
    return [t for t, f in decided.frames.items() if low <= f.score < high and t not in decided.overrides]
