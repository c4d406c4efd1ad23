"""Views between and beyond the training cameras, expressions beyond the training ones: every pair, no ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey, Progress
from ...bench.io.files import digest, write_json
from ...bench.protocol import Protocol, make_trial_protocol
from ...bench.rows import Rows
from ...bench.runner.adaptation import MethodNeeds
from ...bench.runner.avatars import load
from ...bench.runner.stages import Job
from .expressions import Extreme, extremes, training_poses, typical_pose
from .settings import ExtremesSettings
from .stability import EXPRESSION_LIMITS, VIEW_LIMITS, judge, typical
from .trial import (
    RECORD_FILE,
    ROWS_FILE,
    Trial,
    cell_folder,
    described,
    needs_of,
    shoot,
    splats_of,
    summary,
    to_rows,
    write_frame,
)
from .viewpoints import Viewpoint, turntable

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
