"""``headbench run reenact``: avatars of one subject driven with the held-out performance of another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np

from ..condition import PLAIN
from ..contracts import (
    Avatar,
    BoolArray,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    Progress,
)
from ..engine.captures import open_clips
from ..engine.plan import Job, make_jobs
from ..engine.store import RunFolder
from ..errors import InputError
from ..io.files import digest
from ..io.images import quantise, write_png
from ..protocol import Protocol, evenly
from ..rows import Row, Rows
from .stability import (
    JudgedFrame,
    LimitCheck,
    Limits,
    ShownFrames,
    judge,
    judged_rows,
    protocols_of,
    render_measured,
    typical,
    write_frame,
)
from .viewpoints import training_poses

STEADY_M = 0.0005
"""Vertices that training expressions (one standard deviation of each) move by less than this count as static."""
RIGID_WEIGHT = 0.99
FACING = 0.35
"""Minimum cosine between a vertex normal and the direction to the camera; grazing views are left out."""
SMOOTHING = 0.01
"""Standard deviation of the Gaussian blur of images, relative to the head's height in the image."""
LEAST_VERTICES = 20
NO_APPEARANCE = "no recorded frames of that camera, or no parts that expressions do not move"
HIDDEN = ("teeth", "tongue", "eyeball", "lips", "mouth")
"""Parts of names of regions that are behind others, or open and close over them."""


@dataclass(frozen=True, eq=False)
class RigidVertices:
    """The (N,) vertices of a clip's head that only move rigidly: (N, 3) points and unit normals in the rest
    pose, and its (3,) root and neck joints, metres."""

    indices: IntArray
    points: FloatArray
    normals: FloatArray
    root: FloatArray
    neck: FloatArray

    @classmethod
    def of(cls, clip: Clip) -> RigidVertices:
        """Find the vertices from the head model and the training expressions."""
        expressions = [pose.expression for pose in training_poses(clip)]
        return cls.at(clip, np.flatnonzero(_steady(clip.head, expressions)))

    @classmethod
    def at(cls, clip: Clip, indices: IntArray) -> RigidVertices:
        """Restrict to given vertices."""
        head = clip.head
        coefficients = np.asarray(clip.shape, np.float64)
        shaped = (
            head.template + head.shape_basis[..., : len(coefficients)] @ coefficients + clip.static_offset
        )
        root, neck = (head.joint_regressor @ shaped)[:2]
        return cls(indices, shaped[indices], _normals(shaped, head.faces)[indices], root, neck)

    def posed(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """(N, 3) points and normals of a pose: the head rotates about the neck joint, and everything about the root."""
        root, neck = (cv2.Rodrigues(np.asarray(r, np.float64))[0] for r in (pose.rotation, pose.neck))
        local = (self.points - self.neck) @ neck.T + self.neck
        points = (local - self.root) @ root.T + self.root + pose.translation
        return np.asarray(points), np.asarray(self.normals @ (root @ neck).T)


@dataclass(frozen=True, eq=False)
class RecordedAppearance:
    """Lab colours of a subject's static parts in one camera, (N, 3); NaN for vertices that were not visible."""

    parts: RigidVertices
    colours: FloatArray

    @classmethod
    def recorded(cls, clip: Clip, camera: str, count: int) -> RecordedAppearance | None:
        """The median over up to ``count`` recorded frames of training timesteps; None if the camera has too few."""
        recorded = [*clip.splits.get("train", ()), *clip.splits.get("novel_view", ())]
        keys = sorted(key for key in recorded if key.camera == camera)
        parts = RigidVertices.of(clip)
        if not keys or len(parts.indices) < LEAST_VERTICES:
            return None
        seen = np.array([_colours_of(clip, parts, key) for key in keys[:: max(1, len(keys) // count)]])
        finite = np.isfinite(seen).any(axis=0)
        median = np.full(seen.shape[1:], np.nan)
        median[finite] = np.nanmedian(seen[:, finite], axis=0)
        return cls(parts, median)

    def difference(self, colours: FloatArray) -> float | None:
        """Mean CIEDE2000 difference over the vertices visible in both; None if there are too few."""
        both = np.isfinite(self.colours).all(axis=1) & np.isfinite(colours).all(axis=1)
        if both.sum() < LEAST_VERTICES:
            return None
        from skimage.color import deltaE_ciede2000

        return float(deltaE_ciede2000(self.colours[both], colours[both]).mean())


def identity(
    appearance: RecordedAppearance | None, frame: Frame, camera: Camera, pose: HeadPose
) -> LimitCheck:
    """The identity metric of a driven frame; it has no limit, since acceptable values depend on target and driver."""
    if appearance is None or not np.isfinite(frame.rgb).all():
        absent = "not finite" if appearance is not None else NO_APPEARANCE
        return LimitCheck("identity", None, 0.0, math.inf, absent)
    value = appearance.difference(sample(quantise(frame.rgb), camera, *appearance.parts.posed(pose)))
    return LimitCheck("identity", value, 0.0, math.inf, "too little of the static parts is visible")


def of_recording(
    appearance: RecordedAppearance, clip: Clip, keys: Sequence[FrameKey], count: int
) -> float | None:
    """Mean identity metric of up to ``count`` recorded frames of any subject; None if no frame has a value.

    The vertices are those of ``appearance`` that this clip's head has.
    """
    if not keys or len(clip.head.template) <= appearance.parts.indices.max():
        return None
    parts = RigidVertices.at(clip, appearance.parts.indices)
    chosen = keys[:: max(1, len(keys) // count)]
    return mean_known([appearance.difference(_colours_of(clip, parts, key)) for key in chosen])


def mean_known(values: Sequence[float | None]) -> float | None:
    """Mean of the available values; None without any."""
    finite = [value for value in values if value is not None]
    return float(np.mean(finite)) if finite else None


def _colours_of(clip: Clip, parts: RigidVertices, key: FrameKey) -> FloatArray:
    """(N, 3) Lab colours of a clip's static parts in a recorded frame."""
    return sample(clip.image(key), clip.cameras[key.camera], *parts.posed(clip.poses[key.timestep]))


def sample(image: ByteArray, camera: Camera, points: FloatArray, normals: FloatArray) -> FloatArray:
    """(N, 3) Lab colours of points in an (H, W, 3) 8-bit image; NaN for points that face away or are outside of it.

    Occlusion is not tested; the static parts are convex except for the ears.
    """
    motion = np.asarray(camera.world_to_camera, np.float64)
    local = points @ motion[:3, :3].T + motion[:3, 3]
    projected = local @ np.asarray(camera.K, np.float64).T
    pixels = projected[:, :2] / np.where(local[:, 2:] > 0, projected[:, 2:], np.nan)
    towards = camera.center - points
    cosines = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    columns, lines = np.floor(np.nan_to_num(pixels, nan=-1.0)).T
    seen = (cosines > FACING) & (columns >= 0) & (lines >= 0)
    seen &= (columns < camera.width) & (lines < camera.height)
    colours = np.full((len(points), 3), np.nan)
    if seen.any():
        height = float(np.ptp(pixels[seen, 1]))
        smooth = cv2.GaussianBlur(image.astype(np.float32) / 255.0, (0, 0), max(0.5, SMOOTHING * height))
        lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2Lab)
        colours[seen] = lab[lines[seen].astype(int), columns[seen].astype(int)]
    return colours


def _steady(head: HeadAsset, expressions: Sequence[FloatArray]) -> BoolArray:
    """(V,) mask of exposed vertices that neither expressions nor jaw and eyes move."""
    deviations = np.std(np.asarray(expressions, np.float64), axis=0)
    basis = head.expression_basis[..., : len(deviations)]
    steady: BoolArray = np.linalg.norm(basis * deviations, axis=(1, 2)) < STEADY_M
    steady &= head.skinning_weights[:, 1] >= RIGID_WEIGHT
    for name, indices in head.regions.items():
        if any(part in name for part in HIDDEN):
            steady[indices] = False
    return steady


def _normals(points: FloatArray, faces: IntArray) -> FloatArray:
    """(V, 3) unit normals, averaged over faces by area."""
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


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
    """The protocols of the registered change "reenact"."""
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
    references = [replace(pose, timestep=None) for pose in poses[:: max(1, len(poses) // REFERENCE_FRAMES)]]
    reference = typical([render_measured(avatar, camera, pose, background)[1] for pose in references])
    frames, shown = [], []
    for index, key in enumerate(driven.keys):
        driver = source.form.clip.poses[source.form.key(key).timestep]
        pose = retarget(driver, *means, job.clip.subject)
        frame, measures = render_measured(avatar, camera, pose, background)
        target = _target(driven, key)
        name = f"{key.subject}_{key.sequence}_{key.timestep:05d}"
        rendered = job.cell.folder / f"{name}_{camera.id}.png"
        original = out / "sources" / f"{name}_{key.camera}.png"
        write_png(original, source.clip.image(key))
        write_frame(rendered, frame)
        checks = [*judge(measures, reference, OWN_LIMITS), identity(appearance, frame, camera, pose)]
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
    keys = [key for key in target.splits.get("self_reenactment", ()) if key.camera == driven.camera.id]
    theirs = [driven.source.form.key(key) for key in driven.keys]
    values = [check.value for frame in frames for check in frame.checks if check.measure == "identity"]
    return {
        "driven": mean_known(values),
        "own": of_recording(appearance, target, keys, REFERENCE_FRAMES),
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
    """The camera of a name; None: the first held-out one, or else the first."""
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
