"""Another subject's motion carried over to a target: expression as it is, rigid motion about the target's own mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...bench.contracts import Avatar, Camera, Clip, FloatArray, FrameKey, HeadAsset, HeadPose, Progress
from ...bench.errors import InputError
from ...bench.io.files import digest, write_json
from ...bench.io.frames import write_png
from ...bench.protocol import Protocol, make_trial_protocol
from ...bench.rows import Rows
from ...bench.runner.adaptation import MethodNeeds
from ...bench.runner.avatars import load
from ...bench.runner.captures import open_clips, run_configuration
from ...bench.runner.run import adapt, make_jobs
from ...bench.runner.stages import Job
from ...bench.runner.store import RunFolder
from .command import ReenactSettings
from .extremes import training_poses
from .identity import Look, identity, mean_known, of_recording
from .stability import (
    RECORD_FILE,
    ROWS_FILE,
    Limits,
    Measures,
    Trial,
    cell_folder,
    described,
    judge,
    needs_of,
    shoot,
    splats_of,
    summary,
    to_rows,
    typical,
    write_frame,
)


@dataclass(frozen=True, eq=False)
class RigidMean:
    """Where a subject's head rests: mean rotation and neck rotation, (3, 3) each, and mean translation, metres."""

    rotation: FloatArray
    neck: FloatArray
    translation: FloatArray

    @classmethod
    def of(cls, poses: Sequence[HeadPose]) -> RigidMean:
        """Mean over poses; rotations by the chordal mean, the rotation nearest to all in the Frobenius norm."""
        return cls(
            _mean_rotation([_matrix(pose.rotation) for pose in poses]),
            _mean_rotation([_matrix(pose.neck) for pose in poses]),
            np.mean([np.asarray(pose.translation, np.float64) for pose in poses], axis=0),
        )


def retarget(pose: HeadPose, source: RigidMean, target: RigidMean, subject: str) -> HeadPose:
    """Carry a pose of the source over to the target.

    The head turns and moves, seen from its own mean pose, as the source's does from its own, so that the axes of
    the two captures need not agree. Expression, jaw, eyes and eyelids are kept. The pose belongs to no timestep.
    """
    rotation = target.rotation @ source.rotation.T @ _matrix(pose.rotation)
    neck = target.neck @ source.neck.T @ _matrix(pose.neck)
    moved = target.rotation @ source.rotation.T @ (pose.translation - source.translation)
    return replace(
        pose,
        rotation=_axis_angle(rotation).astype(pose.rotation.dtype),
        neck=_axis_angle(neck).astype(pose.neck.dtype),
        translation=(target.translation + moved).astype(pose.translation.dtype),
        subject=subject,
        timestep=None,
    )


def check_heads(source: HeadAsset, target: HeadAsset, where: str) -> None:
    """Raise `InputError` where the source's coefficients mean nothing to the target's head model."""
    ours, theirs = (f"{h.version}, {h.expression_basis.shape[2]} expressions" for h in (target, source))
    if ours != theirs:
        remedy = "Carry the source over to the target's head model first: headbench refit."
        raise InputError(where, "head model", ours, theirs, remedy)


def _matrix(axis_angle: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(np.asarray(axis_angle, np.float64))[0])


def _axis_angle(rotation: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(rotation)[0][:, 0])


def _mean_rotation(rotations: Sequence[FloatArray]) -> FloatArray:
    left, _, right = np.linalg.svd(np.sum(rotations, axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


TASK: Literal["cross_reenactment"] = "cross_reenactment"
REFERENCE_FRAMES = 12
LIMITS = Limits(coverage=(0.67, 1.5), translucent_rise=0.15)
"""Against the median over the avatar's own training poses in the same view; the head turns and moves."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One avatar and who drives it, both in the form that the method takes; ``keys``: one frame a timestep."""

    job: Job
    source: Job
    camera: Camera
    keys: Sequence[FrameKey]

    @property
    def fingerprint(self) -> str:
        """Digest of what is rendered and how it is judged."""
        clips = (self.job.form.clip.fingerprint, self.source.form.clip.fingerprint)
        return digest(TASK, 1, clips, self.camera.id, [str(key) for key in self.keys], asdict(LIMITS))[:12]


def plan_reenactment(jobs: Sequence[Job], settings: ReenactSettings) -> list[Drive]:
    """Pair every avatar with every other subject that can drive it.

    Raises `InputError` where there is no other subject, one has no held-out performance, the head models differ,
    or the camera is not there.
    """
    drives = []
    sources = _sources(jobs, settings)
    for job in jobs:
        clip = job.form.clip
        camera = _camera(clip, settings.camera)
        for source in sources:
            same_method = source.method.spec.name == job.method.spec.name
            if source.clip.subject == job.clip.subject or not same_method:
                continue
            check_heads(source.form.clip.head, clip.head, f"source {source.clip.subject}")
            drives.append(Drive(job, source, camera, _performance(source.clip, camera.id, settings.frames)))
    if not drives:
        found = ", ".join(sorted({job.clip.subject for job in jobs}))
        remedy = "Name a capture of another subject with --source."
        raise InputError(settings.run, "subjects", "another subject to drive with", f"{found} alone", remedy)
    return drives


def reenact(
    jobs: Sequence[Job], settings: ReenactSettings, out: Path, progress: Progress
) -> list[dict[str, Any]]:
    """Render and judge every avatar driven by every other subject; return a summary for each pair.

    Under ``out`` it leaves the frames, those of the source beside them, the rows, and a record.
    """
    drives = plan_reenactment(jobs, settings)
    protocols = _protocols(drives)
    total = sum(len(drive.keys) for drive in drives)
    rows, summaries, done = [], [], 0
    for drive in drives:
        look = Look.recorded(drive.job.form.clip, drive.camera.id, REFERENCE_FRAMES)
        trials, frames = _drive(drive, look, out, progress, done, total)
        done += len(trials)
        protocol = protocols[needs_of(drive.job)].hash
        rows += to_rows(drive.job, TASK, trials, protocol)
        found = summary(drive.job, trials)
        summaries.append({**found, "source": drive.source.clip.subject, "protocol": protocol})
        summaries[-1]["identity"] = _identity(drive, look, trials)
        summaries[-1]["shown"] = frames
    Rows.of(rows).write(out / ROWS_FILE)
    record = {
        "settings": asdict(settings),
        "limits": asdict(LIMITS),
        "protocols": described(protocols.values()),
        "avatars": summaries,
    }
    write_json(out / RECORD_FILE, record)
    return summaries


def _protocols(drives: Sequence[Drive]) -> dict[MethodNeeds, Protocol]:
    """The protocol of each form of the clips: every target with every source."""
    protocols = {}
    for needs in {needs_of(drive.job): None for drive in drives}:
        own = [drive for drive in drives if needs_of(drive.job) == needs]
        protocols[needs] = make_trial_protocol(
            TASK,
            [clip for drive in own for clip in (drive.job.clip, drive.source.clip)],
            (_target(drive, key) for drive in own for key in drive.keys),
            ((drive.camera.width, drive.camera.height) for drive in own),
            {f"{d.source.clip.subject} drives {d.job.clip.subject}": d.fingerprint for d in own},
        )
    return protocols


def _target(drive: Drive, key: FrameKey) -> FrameKey:
    return FrameKey(drive.job.clip.subject, f"{key.subject}/{key.sequence}", key.timestep, drive.camera.id)


def _identity(drive: Drive, look: Look | None, trials: Sequence[Trial]) -> dict[str, float | None] | None:
    """Mean identity of the driven frames, between that of the subject's and that of the source's own recordings."""
    if look is None:
        return None
    target, source = drive.job.form.clip, drive.source.form.clip
    own = [key for key in target.splits.get("self_reenactment", ()) if key.camera == drive.camera.id]
    theirs = [drive.source.form.key(key) for key in drive.keys]
    return {
        "driven": mean_known(
            [v.value for trial in trials for v in trial.verdicts if v.measure == "identity"]
        ),
        "own": of_recording(look, target, own, REFERENCE_FRAMES),
        "source": of_recording(look, source, theirs, REFERENCE_FRAMES),
    }


def _drive(
    drive: Drive, look: Look | None, out: Path, progress: Progress, done: int, total: int
) -> tuple[list[Trial], list[dict[str, Any]]]:
    job, source, camera = drive.job, drive.source, drive.camera
    avatar, clip = load(job), job.form.clip
    background = [float(v) for v in clip.background]
    reference = _reference(avatar, clip, camera, background)
    means = RigidMean.of(training_poses(source.form.clip)), RigidMean.of(training_poses(clip))
    trials, frames = [], []
    for index, key in enumerate(drive.keys):
        driver = source.form.clip.poses[source.form.key(key).timestep]
        pose = retarget(driver, *means, job.clip.subject)
        frame, found = shoot(avatar, camera, pose, splats_of(avatar, pose), background)
        target = _target(drive, key)
        name = f"{key.subject}_{key.sequence}_{key.timestep:05d}"
        driven = cell_folder(out, job) / f"{name}_{camera.id}.png"
        original = out / "sources" / f"{name}_{key.camera}.png"
        write_frame(driven, frame)
        write_png(original, source.clip.image(key))
        trials.append(Trial(target, [*judge(found, reference, LIMITS), identity(look, frame, camera, pose)]))
        frames.append(
            {
                "key": str(target),
                "source": original.relative_to(out).as_posix(),
                "driven": driven.relative_to(out).as_posix(),
            }
        )
        progress(done + index + 1, total, f"{job.name} driven by {key.subject}")
    return trials, frames


def _reference(avatar: Avatar, clip: Clip, camera: Camera, background: Sequence[float]) -> Measures:
    """What the avatar shows of its own training poses in this view."""
    poses = training_poses(clip)
    chosen = poses[:: max(1, len(poses) // REFERENCE_FRAMES)]
    free = [replace(pose, timestep=None) for pose in chosen]
    return typical([shoot(avatar, camera, pose, splats_of(avatar, pose), background)[1] for pose in free])


def _sources(jobs: Sequence[Job], settings: ReenactSettings) -> list[Job]:
    """Cells whose clips drive, one a subject and method: those of the run, or of a capture beside it."""
    if settings.source is None:
        first = {(job.clip.subject, job.method.spec.name): job for job in reversed(jobs)}
        return sorted(first.values(), key=lambda job: job.clip.subject)
    folder = RunFolder((Path(settings.out) if settings.out else Path(settings.run) / TASK) / "sources")
    config = run_configuration(Path(settings.run), replace(settings, data=settings.source))
    config = replace(config, out=str(folder.root))
    methods = list({job.method.spec.name: job.method for job in jobs}.values())
    clips = open_clips(config)
    adapted = adapt(clips, methods, config, folder)
    return make_jobs(replace(config, seeds=(0,)), methods, clips, {}, folder, adapted)


def _camera(clip: Clip, wanted: str | None) -> Camera:
    if wanted is None:
        keys = clip.splits.get("novel_view") or clip.splits["train"]
        return clip.cameras[min(key.camera for key in keys)]
    if wanted not in clip.cameras:
        raise InputError(f"clip {clip.subject}", "--camera", ", ".join(sorted(clip.cameras)), wanted)
    return clip.cameras[wanted]


def _performance(clip: Clip, camera: str, count: int | None) -> list[FrameKey]:
    """Held-out frames, one a timestep: in this camera where there is one, so that source and target look alike."""
    chosen: dict[int, FrameKey] = {}
    for key in sorted(clip.splits.get("self_reenactment", ())):
        if key.timestep not in chosen or key.camera == camera:
            chosen[key.timestep] = key
    keys = [chosen[timestep] for timestep in sorted(chosen)]
    if not keys:
        raise InputError(f"clip {clip.subject}", "splits.self_reenactment", "at least one frame", "none")
    if count is None or count >= len(keys):
        return keys
    return [keys[(2 * i + 1) * len(keys) // (2 * count)] for i in range(count)]
