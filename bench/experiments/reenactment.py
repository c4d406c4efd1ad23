"""``headbench run reenact``: avatars of one subject driven with the held-out performance of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np

from ..condition import PLAIN
from ..contracts import Avatar, Camera, Clip, FloatArray, FrameKey, HeadAsset, HeadPose, Progress
from ..engine.captures import open_clips
from ..engine.plan import Job, make_jobs
from ..engine.store import RunFolder
from ..errors import InputError
from ..io.files import digest
from ..io.images import write_png
from ..protocol import Protocol, evenly
from ..rows import Row, Rows
from .extremes import training_poses
from .identity import RecordedAppearance, identity, mean_known, of_recording
from .stability import (
    JudgedFrame,
    Limits,
    ShownFrames,
    judge,
    judged_rows,
    protocols_of,
    render_measured,
    typical,
    write_frame,
)


@dataclass(frozen=True, eq=False)
class RigidMean:
    """A subject's mean head pose: mean rotation and neck rotation, (3, 3) each, and mean translation, metres."""

    rotation: FloatArray
    neck: FloatArray
    translation: FloatArray

    @classmethod
    def of(cls, poses: Sequence[HeadPose]) -> RigidMean:
        """Mean over poses; rotations by the chordal mean, the rotation nearest to all in the Frobenius norm."""
        translations = np.array([pose.translation for pose in poses], np.float64)
        rotations, necks = [p.rotation for p in poses], [p.neck for p in poses]
        return cls(_mean_rotation(rotations), _mean_rotation(necks), translations.mean(axis=0))


AT_ORIGIN = RigidMean(np.eye(3), np.eye(3), np.zeros(3))
"""Mean of a head that moves around the origin."""


def retarget(pose: HeadPose, source: RigidMean, target: RigidMean, subject: str) -> HeadPose:
    """Retarget a pose from the source to the target.

    The motion of the head relative to its mean pose is that of the source's head relative to its own, so that the axes of
    the captures may differ. Expression, jaw, eyes and eyelids are kept. The pose has no timestep.
    """
    rotation = target.rotation @ source.rotation.T @ _matrix(pose.rotation)
    neck = target.neck @ source.neck.T @ _matrix(pose.neck)
    moved = target.rotation @ source.rotation.T @ (pose.translation - source.translation)
    return replace(
        pose,
        rotation=cv2.Rodrigues(rotation)[0][:, 0].astype(pose.rotation.dtype),
        neck=cv2.Rodrigues(neck)[0][:, 0].astype(pose.neck.dtype),
        translation=(target.translation + moved).astype(pose.translation.dtype),
        subject=subject,
        timestep=None,
    )


def check_heads(source: HeadAsset, target: HeadAsset, where: str) -> None:
    """Raise `InputError` if the source's coefficients do not fit the target's head model."""
    ours, theirs = (f"{h.version}, {h.expression_basis.shape[2]} expressions" for h in (target, source))
    if ours != theirs:
        remedy = "Re-fit the source to the target's head model first: headbench prepare refit."
        raise InputError(where, "head model", ours, theirs, remedy)


def _matrix(axis_angle: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(np.asarray(axis_angle, np.float64))[0])


def _mean_rotation(rotations: Sequence[FloatArray]) -> FloatArray:
    left, _, right = np.linalg.svd(np.sum([_matrix(rotation) for rotation in rotations], axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


TASK: Literal["cross_reenactment"] = "cross_reenactment"
REFERENCE_FRAMES = 12
OWN_LIMITS = Limits(coverage=(0.67, 1.5), translucent_rise=0.15)
"""Relative to the median over the avatar's own training poses in the same view, since the head moves."""
LIMITS = asdict(OWN_LIMITS)


@dataclass(frozen=True, eq=False)
class Driven:
    """An avatar and the source that drives it, both adapted to the method; ``keys``: one frame per timestep."""

    job: Job
    source: Job
    camera: Camera
    keys: Sequence[FrameKey]

    @property
    def fingerprint(self) -> str:
        """Digest of the rendered frames and their evaluation."""
        clips = (self.job.form.clip.fingerprint, self.source.form.clip.fingerprint)
        return digest(TASK, 1, clips, self.camera.id, [str(key) for key in self.keys], LIMITS)[:12]


def protocols(jobs: Sequence[Job], **parameters: Any) -> dict[str, Protocol]:
    """The protocols of the registered change "reenact".

    Raises `InputError` if there is no other subject, one has no held-out performance, the head models differ,
    or the camera is missing.
    """
    pairs = [driven for job in jobs for driven in _pairs(job, **parameters)]
    if not pairs:
        found = ", ".join(sorted({job.clip.subject for job in jobs}))
        remedy = "Name a capture of another subject with --source."
        raise InputError("run", "subjects", "another subject to drive with", f"{found} alone", remedy)
    return protocols_of(TASK, [_shown(driven) for driven in pairs])


def drive(job: Job, avatar: Avatar, progress: Progress, **parameters: Any) -> tuple[Rows, dict[str, Any]]:
    """Render and evaluate the avatar animated by every other subject; the registered change "reenact".

    The details have the record of each pair. The frames of the source are in ``sources``.
    """
    rows: list[Row] = []
    avatars = []
    for driven in _pairs(job, **parameters):
        keys = _shown(driven).keys
        own, record = judged_rows(job, keys, lambda d=driven: _judged(d, avatar, progress))  # type: ignore[misc]
        rows += own
        avatars.append(record)
    return Rows.of(rows), {"avatars": avatars}


def _pairs(job: Job, source: str | None, camera: str | None, frames: int | None) -> list[Driven]:
    """The avatar of a cell with all its drivers."""
    clip = job.form.clip
    view = view_camera(clip, camera)
    pairs = []
    for other in _sources(job, source):
        if other.clip.subject != job.clip.subject:
            check_heads(other.form.clip.head, clip.head, f"source {other.clip.subject}")
            pairs.append(Driven(job, other, view, _performance(other.clip, view.id, frames)))
    return pairs


def _shown(driven: Driven) -> ShownFrames:
    target, source = driven.job.clip, driven.source.clip
    return ShownFrames(
        driven.job,
        [target, source],
        [_target(driven, key) for key in driven.keys],
        [(driven.camera.width, driven.camera.height)],
        (f"{source.subject} drives {target.subject}", driven.fingerprint),
    )


def _target(driven: Driven, key: FrameKey) -> FrameKey:
    sequence = f"{key.subject}/{key.sequence}"
    return FrameKey(driven.job.clip.subject, sequence, key.timestep, driven.camera.id)


def _judged(driven: Driven, avatar: Avatar, report: Progress) -> tuple[list[JudgedFrame], dict[str, Any]]:
    job, source, camera = driven.job, driven.source, driven.camera
    appearance = RecordedAppearance.recorded(job.form.clip, camera.id, REFERENCE_FRAMES)
    clip, out = job.form.clip, job.run
    background = [float(v) for v in clip.background]
    poses = training_poses(clip)
    means = RigidMean.of(training_poses(source.form.clip)), RigidMean.of(poses)
    # Renders of the avatar's training poses in this view.
    own = [replace(pose, timestep=None) for pose in poses[:: max(1, len(poses) // REFERENCE_FRAMES)]]
    reference = typical([render_measured(avatar, camera, pose, background)[1] for pose in own])
    frames, shown = [], []
    for index, key in enumerate(driven.keys):
        driver = source.form.clip.poses[source.form.key(key).timestep]
        pose = retarget(driver, *means, job.clip.subject)
        frame, found = render_measured(avatar, camera, pose, background)
        target = _target(driven, key)
        name = f"{key.subject}_{key.sequence}_{key.timestep:05d}"
        rendered = job.cell.folder / f"{name}_{camera.id}.png"
        original = out / "sources" / f"{name}_{key.camera}.png"
        write_png(original, source.clip.image(key))
        write_frame(rendered, frame)
        checks = [*judge(found, reference, OWN_LIMITS), identity(appearance, frame, camera, pose)]
        frames.append(JudgedFrame(target, checks))
        places = {"source": original, "driven": rendered}
        shown.append({"key": str(target), **{n: p.relative_to(out).as_posix() for n, p in places.items()}})
        report(index + 1, len(driven.keys), f"driven by {source.clip.subject}")
    details = {"identity": _identity(driven, appearance, frames), "shown": shown}
    return frames, {"source": source.clip.subject, **details}


def _identity(
    driven: Driven, appearance: RecordedAppearance | None, frames: Sequence[JudgedFrame]
) -> dict[str, float | None] | None:
    """Mean identity metric of the driven frames, with those of the subject's and of the source's recordings."""
    if appearance is None:
        return None
    target, source = driven.job.form.clip, driven.source.form.clip
    own = [key for key in target.splits.get("self_reenactment", ()) if key.camera == driven.camera.id]
    theirs = [driven.source.form.key(key) for key in driven.keys]
    values = [check.value for frame in frames for check in frame.checks if check.measure == "identity"]
    return {
        "driven": mean_known(values),
        "own": of_recording(appearance, target, own, REFERENCE_FRAMES),
        "source": of_recording(appearance, source, theirs, REFERENCE_FRAMES),
    }


def _sources(job: Job, source: str | None) -> Sequence[Job]:
    """Cells of the job's method whose clips are drivers: of all captures of the run, or of a separate capture."""
    config = job.config
    assert config is not None
    if source is not None:
        config = replace(config, data=source)
    if "drivers" not in job.kept:
        job.kept["drivers"] = open_clips(config)
    folder = RunFolder(job.run if source is None else job.run / "sources")
    config = replace(config, out=str(folder.root), conditions=(PLAIN,), seeds=(0,), source="")
    clips = sorted(job.kept["drivers"], key=lambda clip: clip.subject)
    return make_jobs(config, [(job.method, PLAIN)], clips, {}, folder)


def view_camera(clip: Clip, wanted: str | None) -> Camera:
    """The camera of a name; None: the first held-out one, or else the first. Raises `InputError` for an unknown name."""
    if wanted is None:
        keys = clip.splits.get("novel_view") or clip.splits["train"]
        return clip.cameras[min(key.camera for key in keys)]
    if wanted not in clip.cameras:
        raise InputError(f"clip {clip.subject}", "--camera", ", ".join(sorted(clip.cameras)), wanted)
    return clip.cameras[wanted]


def _performance(clip: Clip, camera: str, count: int | None) -> list[FrameKey]:
    """Held-out frames, one per timestep, in this camera if available, so that source and target have the same view."""
    chosen: dict[int, FrameKey] = {}
    for key in sorted(clip.splits.get("self_reenactment", ())):
        if key.timestep not in chosen or key.camera == camera:
            chosen[key.timestep] = key
    keys = [chosen[timestep] for timestep in sorted(chosen)]
    if not keys:
        raise InputError(f"clip {clip.subject}", "splits.self_reenactment", "at least one frame", "none")
    return evenly(keys, count)
