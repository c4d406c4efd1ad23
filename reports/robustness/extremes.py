"""``headbench run extremes``: views between and beyond the training cameras, expressions along principal components."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import Clip, FloatArray, FrameKey, HeadPose, Progress
from ...bench.executors.task import Task
from ...bench.io.files import digest
from ...bench.runner.jobs import load, trained
from ...bench.runner.steps import Job, trained_files
from .settings import ExtremesSettings
from .stability import (
    EXPRESSION_LIMITS,
    VIEW_LIMITS,
    JudgedFrame,
    RobustnessCase,
    cell_folder,
    checked_protocols,
    judge,
    render_measured,
    run_cases,
    splats_of,
    typical,
    write_frame,
)
from .tasks import leave_frames, rendered_by_tasks
from .viewpoints import Viewpoint, turntable

NO_VARIATION = 1e-9
"""A component whose deviation is below this share of the largest one is rounding, not expression."""


@dataclass(frozen=True, eq=False)
class ExpressionComponents:
    """Principal components of expression coefficients: (E,) mean, (D, E) unit vectors by falling deviation, and the
    (D,) standard deviation along each, all positive. D is less than asked for where training holds less."""

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
        """(E,) coefficients so many standard deviations along a component, counted from 0."""
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


@dataclass(frozen=True, eq=False)
class ExtremesPlan:
    """Views and expressions that the avatars of one clip are rendered with."""

    views: Sequence[Viewpoint]
    extremes: Sequence[ExtremePose]
    fingerprint: str

    @classmethod
    def of(cls, clip: Clip, settings: ExtremesSettings) -> ExtremesPlan:
        """Choose views and expressions for a clip, from its training frames alone."""
        cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
        sigmas = sorted(settings.sigmas)
        asked = (settings.views, settings.beyond, settings.dimensions, sigmas)
        limits = (asdict(VIEW_LIMITS), asdict(EXPRESSION_LIMITS))
        return cls(
            turntable(cameras, head_center(clip), settings.views, settings.beyond),
            extremes(clip, settings.dimensions, sigmas),
            digest(TASK, 1, clip.fingerprint, asked, limits)[:12],
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


def judge_extremes(
    jobs: Sequence[Job], settings: ExtremesSettings, out: Path, progress: Progress
) -> list[dict[str, Any]]:
    """Render and judge every pair of view and expression; return the record of each avatar.

    Under ``out`` it leaves the rows, a record of views, limits and findings, and the frames that the contact
    sheet shows.
    """
    plans = [ExtremesPlan.of(job.form.clip, settings) for job in jobs]
    cases = [_case(job, plan, out) for job, plan in zip(jobs, plans)]
    protocols = checked_protocols(TASK, cases, out)
    if settings.execution.executor != "inline":
        subjects = list(dict.fromkeys(job.clip.subject for job in jobs))
        made_of = [_fingerprint(job, plan) for job, plan in zip(jobs, plans)]
        cases = rendered_by_tasks(cases, subjects, made_of, settings, out)
    limits = {"views": asdict(VIEW_LIMITS), "expressions": asdict(EXPRESSION_LIMITS)}
    return run_cases(TASK, cases, protocols, settings, limits, out, progress)


def _case(job: Job, plan: ExtremesPlan, out: Path) -> RobustnessCase:
    details = {
        "views": [
            {"id": v.camera.id, "azimuth": round(v.azimuth, 2), "extrapolated": v.extrapolated}
            for v in plan.views
        ],
        "expressions": [extreme.name for extreme in plan.extremes],
    }
    return RobustnessCase(
        job,
        job.name,
        [job.clip],
        [_key(job, extreme, n, view) for n, extreme in enumerate(plan.extremes) for view in plan.views],
        [(view.camera.width, view.camera.height) for view in plan.views],
        (f"views and expressions of {job.clip.subject}", plan.fingerprint),
        lambda report: (_judged(job, plan, cell_folder(out, job), report), details),
    )


def _fingerprint(job: Job, plan: ExtremesPlan) -> str:
    """What the frames of an avatar depend on."""
    return digest(plan.fingerprint, job.fit_fingerprint, trained_files(job))


def render_avatar(task: Task, report: Callable[[str], None]) -> None:
    """Render and judge one avatar, as an executor's task; leave what came out in its folder."""
    given = {**task.arguments["settings"]}
    given |= {name: tuple(given[name]) for name in ("methods", "sigmas")}
    settings, out = ExtremesSettings(**given), Path(task.root)
    chosen = task.arguments["method"], task.arguments["seed"]
    _, jobs = trained(Path(settings.run), chosen[:1], settings, out, only=task.arguments["capture"])
    (job,) = (job for job in jobs if (job.method.spec.name, job.seed) == chosen)
    plan = ExtremesPlan.of(job.form.clip, settings)
    leave_frames(_case(job, plan, out), _fingerprint(job, plan), cell_folder(out, job), report)


def _key(job: Job, extreme: ExtremePose, number: int, view: Viewpoint) -> FrameKey:
    return FrameKey(job.clip.subject, extreme.name, number, view.camera.id)


def _judged(job: Job, plan: ExtremesPlan, folder: Path, report: Callable[[int], None]) -> list[JudgedFrame]:
    """The mean expression first, since it is the reference of all others in its view."""
    avatar, clip = load(job), job.form.clip
    background = [float(v) for v in clip.background]
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
                write_frame(folder / f"{extreme.name}_{view.camera.id}.png", frame)
            report(number * len(plan.views) + index + 1)
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
