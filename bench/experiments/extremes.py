"""``headbench run extremes``: views between and beyond the training cameras, expressions along principal components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from ..contracts import Avatar, Clip, FloatArray, FrameKey, HeadPose, Progress
from ..engine.steps import Job
from ..io.files import digest
from ..protocol import Protocol
from ..rows import Rows
from .stability import (
    EXPRESSION_LIMITS,
    VIEW_LIMITS,
    JudgedFrame,
    ShownFrames,
    judge,
    judged_rows,
    protocols_of,
    render_measured,
    splats_of,
    typical,
    write_frame,
)
from .viewpoints import Viewpoint, turntable

NO_VARIATION = 1e-9
"""A component whose deviation is below this share of the largest one is rounding, not expression."""


@dataclass(frozen=True, eq=False)
class ExpressionComponents:
    """Principal components of expression coefficients: (E,) mean, (D, E) unit vectors by falling deviation,
    and the (D,) standard deviation along each, all positive. D is less than requested if the training data
    span less."""

    mean: FloatArray
    directions: FloatArray
    deviations: FloatArray

    @classmethod
    def of(cls, coefficients: FloatArray, dimensions: int) -> ExpressionComponents:
        """Components of (T, E) coefficients, one row a timestep."""
        mean = coefficients.mean(axis=0)
        _, singular, directions = np.linalg.svd(coefficients - mean, full_matrices=False)
        deviations = singular / np.sqrt(max(len(coefficients) - 1, 1))
        scale = max(float(np.abs(coefficients).max(initial=0.0)), 1.0)
        kept = np.flatnonzero(deviations > NO_VARIATION * scale)[:dimensions]
        return cls(mean, directions[kept], deviations[kept])

    def at(self, component: int, sigmas: float) -> FloatArray:
        """(E,) coefficients at a number of standard deviations along a component, counted from 0."""
        return np.asarray(self.mean + sigmas * self.deviations[component] * self.directions[component])


class ExtremePose(NamedTuple):
    """A pose to render, such as ``pc3+2`` for component 3, or ``mean`` and 0 for the mean expression."""

    name: str
    component: int
    pose: HeadPose


def training_poses(clip: Clip) -> list[HeadPose]:
    """Tracked poses of the training timesteps, in order."""
    return [clip.poses[t] for t in sorted({key.timestep for key in clip.splits["train"]})]


def typical_pose(poses: Sequence[HeadPose]) -> HeadPose:
    """The pose whose expression is nearest to the mean expression: a real one, so that all its parts fit together."""
    expressions = np.array([pose.expression for pose in poses], np.float64)
    return poses[int(np.argmin(np.linalg.norm(expressions - expressions.mean(axis=0), axis=1)))]


def extremes(clip: Clip, dimensions: int, sigmas: Sequence[float]) -> list[ExtremePose]:
    """The mean expression, then every step along every component; the rest of the pose stays the typical one's.

    Taken from training timesteps alone. Poses belong to no timestep, so that no avatar answers with tracking it
    refined for one.
    """
    poses = training_poses(clip)
    base = replace(typical_pose(poses), timestep=None)
    dtype = base.expression.dtype
    components = ExpressionComponents.of(np.array([p.expression for p in poses], np.float64), dimensions)
    expressions = [("mean", 0, components.mean)]
    for index in range(len(components.deviations)):
        expressions += [(f"pc{index + 1}{s:+g}", index + 1, components.at(index, s)) for s in sigmas]
    return [
        ExtremePose(name, number, replace(base, expression=expression.astype(dtype)))
        for name, number, expression in expressions
    ]


TASK: Literal["extremes"] = "extremes"
LIMITS = {"views": asdict(VIEW_LIMITS), "expressions": asdict(EXPRESSION_LIMITS)}


@dataclass(frozen=True, eq=False)
class ExtremesPlan:
    """Views and expressions that the avatars of one clip are rendered with."""

    views: Sequence[Viewpoint]
    extremes: Sequence[ExtremePose]
    fingerprint: str

    @classmethod
    def of(
        cls, clip: Clip, views: int, beyond: float, dimensions: int, sigmas: Sequence[float]
    ) -> ExtremesPlan:
        """Choose views and expressions for a clip, from its training frames alone."""
        cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
        sigmas = sorted(sigmas)
        asked = (views, beyond, dimensions, sigmas)
        return cls(
            turntable(cameras, head_center(clip), views, beyond),
            extremes(clip, dimensions, sigmas),
            digest(TASK, 1, clip.fingerprint, asked, tuple(LIMITS.values()))[:12],
        )


def head_center(clip: Clip) -> FloatArray:
    """(3,) centre of the head in its typical training pose, metres: the middle of the extent of its vertices."""
    head, pose = clip.head, typical_pose(training_poses(clip))
    coefficients = np.asarray(clip.shape, np.float64)
    shaped = head.template + head.shape_basis[..., : len(coefficients)] @ coefficients
    joint = head.joint_regressor[0] @ shaped
    rotation, _ = cv2.Rodrigues(np.asarray(pose.rotation, np.float64))
    middle = (shaped.min(axis=0) + shaped.max(axis=0)) / 2
    return np.asarray(rotation @ (middle - joint) + joint + pose.translation)


def protocols(jobs: Sequence[Job], **parameters: Any) -> dict[str, Protocol]:
    """The protocols of the registered change "extremes"."""
    return protocols_of(TASK, [_shown(job, ExtremesPlan.of(job.form.clip, **parameters)) for job in jobs])


def drive(
    job: Job, avatar: Avatar, progress: Progress, **parameters: Any
) -> tuple[Rows, dict[str, Any], list[Path]]:
    """Render and judge every pair of view and expression; the registered change "extremes".

    The details have the record of the avatar: views, expressions and findings. The files are the frames that the contact
    sheet shows.
    """
    plan = ExtremesPlan.of(job.form.clip, **parameters)
    files: list[Path] = []
    details = {
        "views": [
            {"id": v.camera.id, "azimuth": round(v.azimuth, 2), "extrapolated": v.extrapolated}
            for v in plan.views
        ],
        "expressions": [extreme.name for extreme in plan.extremes],
    }
    keys = _shown(job, plan).keys
    rows, record = judged_rows(job, keys, lambda: (_judged(job, avatar, plan, files, progress), details))
    return Rows.of(rows), {"avatars": [record]}, files


def _shown(job: Job, plan: ExtremesPlan) -> ShownFrames:
    return ShownFrames(
        job,
        [job.clip],
        [_key(job, extreme, n, view) for n, extreme in enumerate(plan.extremes) for view in plan.views],
        [(view.camera.width, view.camera.height) for view in plan.views],
        (f"views and expressions of {job.clip.subject}", plan.fingerprint),
    )


def _key(job: Job, extreme: ExtremePose, number: int, view: Viewpoint) -> FrameKey:
    return FrameKey(job.clip.subject, extreme.name, number, view.camera.id)


def _judged(
    job: Job, avatar: Avatar, plan: ExtremesPlan, files: list[Path], report: Progress
) -> list[JudgedFrame]:
    """The mean expression first, since it is the reference of all others in its view."""
    background = [float(v) for v in job.form.clip.background]
    total = len(plan.extremes) * len(plan.views)
    components = max(extreme.component for extreme in plan.extremes)
    frames: list[JudgedFrame] = []
    references = []
    for number, extreme in enumerate(plan.extremes):
        splats = splats_of(avatar, extreme.pose)
        measured = []
        for index, view in enumerate(plan.views):
            frame, found = render_measured(avatar, view.camera, extreme.pose, background, splats)
            measured.append(found)
            # The contact sheet shows in each view every step along one component, which changes from view to view.
            if not extreme.component or extreme.component == index % components + 1:
                files += write_frame(job.cell.folder / f"{extreme.name}_{view.camera.id}.png", frame)
            report(number * len(plan.views) + index + 1, total, TASK)
        if number == 0:
            references = measured
            between = [m for m, view in zip(measured, plan.views) if not view.extrapolated]
            middle = typical(between or measured)
            checks = [judge(m, middle, VIEW_LIMITS) for m in measured]
        else:
            checks = [judge(m, r, EXPRESSION_LIMITS) for m, r in zip(measured, references)]
        keys = [_key(job, extreme, number, view) for view in plan.views]
        frames += [JudgedFrame(key, found) for key, found in zip(keys, checks)]
    return frames
