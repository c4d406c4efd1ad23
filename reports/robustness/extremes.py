"""Expressions beyond those of training: steps along the principal components of its coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey, HeadPose, Progress
from ...bench.io.files import digest, write_json
from ...bench.protocol import Protocol, make_trial_protocol
from ...bench.rows import Rows
from ...bench.runner.adaptation import MethodNeeds
from ...bench.runner.avatars import load
from ...bench.runner.stages import Job
from .command import ExtremesSettings
from .stability import (
    EXPRESSION_LIMITS,
    RECORD_FILE,
    ROWS_FILE,
    VIEW_LIMITS,
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
from .viewpoints import Viewpoint, turntable

NO_VARIATION = 1e-9
"""A component whose deviation is below this share of the largest one is rounding, not expression."""


@dataclass(frozen=True, eq=False)
class ExpressionComponents:
    """Principal components of expression coefficients.

    Attributes
    ----------
    mean : (E,).
    directions : (D, E) unit vectors, by falling deviation; D is less than asked for where training holds less.
    deviations : (D,) standard deviation along each, all positive.
    """

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


@dataclass(frozen=True, eq=False)
class Extreme:
    """A pose to try: ``component`` counts from 1, 0 for the mean expression, and ``sigmas`` says how far along it."""

    component: int
    sigmas: float
    pose: HeadPose

    @property
    def name(self) -> str:
        """Such as ``pc3+2``; ``mean`` for the mean expression."""
        return f"pc{self.component}{self.sigmas:+g}" if self.component else "mean"


def training_poses(clip: Clip) -> list[HeadPose]:
    """Tracked poses of the training timesteps, in order."""
    return [clip.poses[t] for t in sorted({key.timestep for key in clip.splits["train"]})]


def typical_pose(poses: Sequence[HeadPose]) -> HeadPose:
    """The pose whose expression is nearest to the mean expression: a real one, so that all its parts fit together."""
    expressions = np.array([pose.expression for pose in poses], np.float64)
    return poses[int(np.argmin(np.linalg.norm(expressions - expressions.mean(axis=0), axis=1)))]


def extremes(clip: Clip, dimensions: int, sigmas: Sequence[float]) -> list[Extreme]:
    """The mean expression, then every step along every component; the rest of the pose stays the typical one's.

    Taken from training timesteps alone. Poses belong to no timestep, so that no avatar answers with tracking it
    refined for one.
    """
    poses = training_poses(clip)
    base = replace(typical_pose(poses), timestep=None)
    dtype = base.expression.dtype
    components = ExpressionComponents.of(np.array([p.expression for p in poses], np.float64), dimensions)

    def posed(expression: FloatArray) -> HeadPose:
        return replace(base, expression=expression.astype(dtype))

    found = [Extreme(0, 0.0, posed(components.mean))]
    for index in range(len(components.deviations)):
        found += [Extreme(index + 1, float(s), posed(components.at(index, s))) for s in sigmas if s]
    return found


TASK: Literal["extremes"] = "extremes"


@dataclass(frozen=True, eq=False)
class Plan:
    """What is tried on the avatars of one clip."""

    views: Sequence[Viewpoint]
    extremes: Sequence[Extreme]
    fingerprint: str


def plan_extremes(clip: Clip, settings: ExtremesSettings) -> Plan:
    """Choose views and expressions for a clip, from its training frames alone."""
    cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
    views = turntable(cameras, head_center(clip), settings.views, settings.beyond)
    wanted = extremes(clip, settings.dimensions, sorted(settings.sigmas))
    asked = (settings.views, settings.beyond, settings.dimensions, sorted(settings.sigmas))
    limits = (asdict(VIEW_LIMITS), asdict(EXPRESSION_LIMITS))
    return Plan(views, wanted, digest(TASK, 1, clip.fingerprint, asked, limits)[:12])


def head_center(clip: Clip) -> FloatArray:
    """(3,) centre of the head in its typical training pose, metres: the middle of the extent of its vertices."""
    head, pose = clip.head, typical_pose(training_poses(clip))
    coefficients = np.asarray(clip.shape, np.float64)
    shaped = head.template + head.shape_basis[..., : len(coefficients)] @ coefficients
    joint = head.joint_regressor[0] @ shaped
    rotation, _ = cv2.Rodrigues(np.asarray(pose.rotation, np.float64))
    middle = (shaped.min(axis=0) + shaped.max(axis=0)) / 2
    return np.asarray(rotation @ (middle - joint) + joint + pose.translation)


def on_sheet(plan: Plan, view: int, extreme: Extreme) -> bool:
    """Whether the contact sheet shows this pair: in each view every step, along one component that turns with it."""
    components = max(e.component for e in plan.extremes)
    return extreme.component == 0 or extreme.component == view % components + 1


def try_extremes(
    jobs: Sequence[Job], settings: ExtremesSettings, out: Path, progress: Progress
) -> list[dict[str, Any]]:
    """Render and judge every pair of view and expression; return a summary for each avatar.

    Under ``out`` it leaves the rows, a record of views, limits and findings, and the frames that the contact
    sheet shows.
    """
    plans = [plan_extremes(job.form.clip, settings) for job in jobs]
    protocols = _protocols(jobs, plans)
    total = sum(len(plan.views) * len(plan.extremes) for plan in plans)
    done, rows, summaries, views = 0, [], [], []
    for job, plan in zip(jobs, plans):
        trials = _try(job, plan, cell_folder(out, job), _Offset(progress, done, total, job.name))
        done += len(trials)
        rows += to_rows(job, TASK, trials, protocols[needs_of(job)].hash)
        summaries.append(summary(job, trials))
        views.append([_described(view) for view in plan.views])
    Rows.of(rows).write(out / ROWS_FILE)
    record = {
        "settings": asdict(settings),
        "limits": {"views": asdict(VIEW_LIMITS), "expressions": asdict(EXPRESSION_LIMITS)},
        "protocols": described(protocols.values()),
        "avatars": [
            {
                **s,
                "views": v,
                "expressions": [e.name for e in p.extremes],
                "protocol": protocols[needs_of(job)].hash,
            }
            for job, s, v, p in zip(jobs, summaries, views, plans)
        ],
    }
    write_json(out / RECORD_FILE, record)
    return summaries


def _protocols(jobs: Sequence[Job], plans: Sequence[Plan]) -> dict[MethodNeeds, Protocol]:
    """The protocol of each form of the clips: all subjects, every pair of view and expression."""
    protocols = {}
    for needs in {needs_of(job): None for job in jobs}:
        own = [(job, plan) for job, plan in zip(jobs, plans) if needs_of(job) == needs]
        protocols[needs] = make_trial_protocol(
            TASK,
            [job.clip for job, _ in own],
            (
                _key(job, e, n, v)
                for job, plan in own
                for n, e in enumerate(plan.extremes)
                for v in plan.views
            ),
            ((v.camera.width, v.camera.height) for _, plan in own for v in plan.views),
            {f"views and expressions of {job.clip.subject}": plan.fingerprint for job, plan in own},
        )
    return protocols


def _key(job: Job, extreme: Extreme, number: int, view: Viewpoint) -> FrameKey:
    return FrameKey(job.clip.subject, extreme.name, number, view.camera.id)


@dataclass(frozen=True)
class _Offset:
    """Progress of one part of a whole."""

    progress: Progress
    done: int
    total: int
    note: str

    def __call__(self, done: int) -> None:
        self.progress(self.done + done, self.total, self.note)


def _try(job: Job, plan: Plan, folder: Path, report: _Offset) -> list[Trial]:
    """The mean expression first, since it is the reference of all others in its view."""
    avatar, clip = load(job), job.form.clip
    background = [float(v) for v in clip.background]
    trials: list[Trial] = []
    references = []
    for number, extreme in enumerate(plan.extremes):
        splats = splats_of(avatar, extreme.pose)
        measured = []
        for index, view in enumerate(plan.views):
            frame, found = shoot(avatar, view.camera, extreme.pose, splats, background)
            measured.append(found)
            if on_sheet(plan, index, extreme):
                write_frame(folder / f"{extreme.name}_{view.camera.id}.png", frame)
            report(number * len(plan.views) + index + 1)
        if number == 0:
            references = measured
            between = [m for m, view in zip(measured, plan.views) if not view.extrapolated]
            middle = typical(between or measured)
            verdicts = [judge(m, middle, VIEW_LIMITS) for m in measured]
        else:
            verdicts = [judge(m, r, EXPRESSION_LIMITS) for m, r in zip(measured, references)]
        trials += [
            Trial(_key(job, extreme, number, view), verdict) for view, verdict in zip(plan.views, verdicts)
        ]
    return trials


def _described(view: Viewpoint) -> dict[str, Any]:
    camera: Camera = view.camera
    return {"id": camera.id, "azimuth": round(view.azimuth, 2), "extrapolated": view.extrapolated}
