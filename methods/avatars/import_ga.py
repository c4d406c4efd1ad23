"""GaussianAvatars' PLY files as avatars.

Formats read:

- GaussianAvatars' avatars (`point_cloud.ply` with `flame_param.npz`). Written by ShenhanQian/GaussianAvatars. Checked on
  files that ShenhanQian/GaussianAvatars@30cc4bde wrote when it was trained on a synthetic capture.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ...bench.configuration import build, parse_assignments
from ...bench.contracts import Budget, Progress, no_progress
from ...bench.engine.config import ResolvedMethod
from ...bench.engine.stored import AVATAR_FILE, SAME_SHAPE, write_avatar_record
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest_file, user_files
from ...bench.io.lock import LOCK_FILE
from ...bench.specs import CommandResult, command
from ...datasets.clip import CaptureClip
from ...datasets.ga.tracking import TeethPolicy, Tracking, find_head, read_animation
from ...datasets.head.arrays import HeadArrays
from ..ga.method import DRIVING_FILE, PLY_FILE, read_ga_splats, write_ga_splats
from ..ga.spec import GA as GA_SPEC
from ..ga.spec import GAConfig
from ..shared.avatar_files import (
    HEAD_FILE,
    SUBJECT_FILE,
    TRACKED,
    RefinedTracking,
    Subject,
    head_arrays,
    save_shared_head,
    write_subject,
)
from .settings import ImportGASettings

FLAME_PARAM_FILE = "flame_param.npz"


@dataclass(frozen=True)
class HeadSettings:
    """Reader settings used for the head model by an import without a capture."""

    masks: str | None = None
    regions: str | None = None
    eyelids: str | None = None
    teeth: TeethPolicy = "auto"


@command("import ga", group="export", writes="out", kinds=("an avatar",))
def import_avatar(settings: ImportGASettings, progress: Progress = no_progress) -> CommandResult:
    """Import a GaussianAvatars PLY as an avatar of the method ga."""
    ply, out = Path(settings.ply), Path(settings.out)
    ours = {AVATAR_FILE, LOCK_FILE, SUBJECT_FILE, HEAD_FILE, PLY_FILE, DRIVING_FILE}
    other = InputError(out, "", "a new or an empty folder", "one with files in it")
    if any(path.name not in ours for path in user_files(out)):
        raise other
    head, subject, refined, notes = _identity(settings, ply, progress)
    splats, binding = read_ga_splats(ply, len(head.faces), "cpu")
    # The splats are written last: this import was killed at its end, or they are from another one.
    if (out / PLY_FILE).exists():
        there, on = read_ga_splats(out / PLY_FILE, len(head.faces), "cpu")
        if not (binding.equal(on) and all(splats[name].equal(there[name]) for name in splats)):
            raise other
    write_subject(out / SUBJECT_FILE, subject)
    save_shared_head(out, head)
    if refined is not None:
        refined.save(out / DRIVING_FILE)
    else:
        (out / DRIVING_FILE).unlink(missing_ok=True)
    write_ga_splats(out / PLY_FILE, splats, binding)
    method = ResolvedMethod(GA_SPEC, GAConfig(), Budget())
    identity = subject.name, subject.shape, subject.head_model
    write_avatar_record(out, method, *identity, "import", {"file": digest_file(ply)})
    used = len(binding.unique())
    triangles = f"{used} of {len(head.faces)} triangles"
    text = f"{out}: {len(binding)} splats on {triangles}, subject {subject.name}"
    data = {"out": out, "splats": len(binding), "triangles": used, "subject": subject.name, **notes}
    return CommandResult("; ".join([text, *(f"{name}: {value}" for name, value in notes.items())]), data)


def _identity(
    settings: ImportGASettings, ply: Path, progress: Progress
) -> tuple[HeadArrays, Subject, RefinedTracking | None, dict[str, str]]:
    """Head model, subject and refined tracking of an import, and a description of them."""
    beside = ply.with_name(FLAME_PARAM_FILE)
    given = settings.flame_param or (str(beside) if beside.is_file() else "none")
    path = None if given == "none" else Path(given)
    clip = None if settings.capture is None else settings.open(settings.capture, progress)
    if path is None:
        if clip is None:
            expected = f"a capture, or a {FLAME_PARAM_FILE} beside the PLY and --head"
            remedy = "Name the capture that the avatar was trained on with --capture."
            raise InputError(ply, "", expected, "neither", remedy)
        return head_arrays(clip.head), Subject.of(clip), None, {}
    if clip is None and settings.head is None:
        remedy = "Name it with --head: flame2023.pkl for the official avatars; or the capture with --capture."
        raise InputError("command line", "--head", "the head model of the avatar", "none", remedy)
    if clip is None:
        name = settings.subject or ply.stem
        files = asdict(build(HeadSettings, parse_assignments(settings.set), "--set"))
        teeth = files.pop("teeth")
        head = find_head(path.parent, None, settings.head, **files)
        tracking = read_animation(path, head, name, teeth=teeth)
        subject = Subject(
            check_name(name, "command line", "--subject"),
            tracking.head.version,
            np.asarray(tracking.shape, np.float32),
            tracking.static_offset,
        )
        refined = None
    else:
        tracking = read_animation(path, head_arrays(clip.head), clip.subject)
        differs = float(np.abs(tracking.shape - np.asarray(clip.shape)).max(initial=0))
        if differs > SAME_SHAPE:
            expected = f"the shape of subject {clip.subject}"
            remedy = (
                f"Leave {FLAME_PARAM_FILE} out with --flame-param none, or name the avatar's own capture."
            )
            raise InputError(path, "shape", expected, f"one that differs by {differs:.3g}", remedy)
        subject = Subject.of(clip)
        subject = replace(subject, static_offset=np.asarray(tracking.static_offset, np.float32))
        refined = _refined(clip, tracking, path)
    count = 0 if refined is None else len(refined)
    notes = {FLAME_PARAM_FILE: f"{len(tracking.poses)} timesteps, {count} of them refined training poses"}
    ignored = float(tracking.notes["dynamic_offset_ignored_m"])
    if ignored > 0:
        notes["dynamic offset left out"] = f"up to {1000 * ignored:.2f} mm"
    return tracking.head, subject, refined, notes


def _refined(clip: CaptureClip, tracking: Tracking, path: Path) -> RefinedTracking | None:
    """Poses refined in training, in the clip's world coordinates; none for a file with one pose.

    GaussianAvatars numbers the rows by ``timestep_index`` and keeps each sequence in its own world coordinates.
    """
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    if len(tracking.poses) == 1 < len(timesteps):
        return None
    if timesteps[-1] not in tracking.poses:
        expected = f"a row for every training timestep, {timesteps[-1] + 1} at least"
        raise InputError(path, "expr", expected, f"{len(tracking.poses)}", "It belongs to another capture.")
    recorded = clip.steps[0].parameters.get("sequence_shifts_m", {}) if clip.steps else {}
    sequence = {key.timestep: key.sequence for key in clip.splits["train"]}
    tracked = [clip.poses[timestep] for timestep in timesteps]
    shifted = []
    for timestep in timesteps:
        pose = tracking.poses[timestep]
        shift = np.asarray(recorded.get(sequence[timestep], np.zeros(3)), np.float32)
        shifted.append(replace(pose, translation=pose.translation + shift))
    before, after = (
        {name: np.array([getattr(p, name) for p in poses], np.float32) for name in TRACKED}
        for poses in (tracked, shifted)
    )
    return RefinedTracking(clip.subject, np.array(timesteps), before, after)
