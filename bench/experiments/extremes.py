"""``headbench run extremes``: views between and beyond the training cameras, joint samples of expression and jaw."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro

from ..condition import Condition, Named
from ..contracts import (
    Avatar,
    Camera,
    Clip,
    DepthAvatar,
    FloatArray,
    Frame,
    FrameKey,
    HeadPose,
    Progress,
    TrueFrame,
    no_progress,
)
from ..engine.adaptation import MethodNeeds, adapt
from ..engine.config import RunOptions, with_methods
from ..engine.plan import Job, trained
from ..engine.run import run
from ..engine.store import RunFolder
from ..errors import UnavailableError
from ..executors.settings import ExecutionOptions, check_executor
from ..io.files import check_kind, digest, write_json
from ..io.lock import locked
from ..protocol import Protocol
from ..registry import get, resolve
from ..rows import ALL, Rows
from ..specs import CommandResult, command
from .specs import RECORD_FILE
from .stability import (
    EXPRESSION_LIMITS,
    VIEW_LIMITS,
    JudgedFrame,
    LimitCheck,
    Measures,
    ShownFrames,
    absent_surface,
    judge,
    judged_rows,
    protocols_of,
    render_measured,
    splats_of,
    surface,
    typical,
    write_frame,
)
from .truth import (
    TRUTH_LIMITS,
    TruthJudge,
    TruthPair,
    TruthPictures,
    without_truth,
)
from .viewpoints import Viewpoint, common_target, head_center, training_poses, turntable, typical_pose


@dataclass(frozen=True)
class ExtremesSettings(RunOptions, ExecutionOptions):
    """Render a run's avatars in new views and in random poses of expression and jaw; exit code 1 if a limit is exceeded.
    Synthetic captures have a path-traced ground truth for every pose and view."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `extremes` in the folder of the run."""

    methods: tuple[str, ...] = ()
    """Methods to test; default: all but the trivial baselines."""

    views: int = 16
    """Views of the turntable, in even steps."""

    beyond: float = 30.0
    """Angle of the turntable beyond the outermost training cameras, degrees."""

    dimensions: int = 8
    """Principal components of expression and jaw in training."""

    samples: int = 24
    """Number of random poses along all components, each rendered in two views."""

    sigmas: float = 3.0
    """Largest distance along a component, in standard deviations; never beyond the range of training."""

    path: int = 12
    """Frames of a sequence through two of the poses, for flicker; 0: none."""

    def __post_init__(self) -> None:
        for name, least in (("views", 1), ("dimensions", 1), ("samples", 1), ("path", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; at least {least}")
        if not 0.0 <= self.beyond < 180.0:
            raise ValueError(f"beyond is {self.beyond}; from 0 to less than 180 degrees")
        if not 0.0 < self.sigmas <= 10.0:
            raise ValueError(f"sigmas is {self.sigmas}; above 0, at most 10")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "extremes"."""
        names = ("views", "beyond", "dimensions", "samples", "sigmas", "path")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class ReenactSettings(RunOptions, ExecutionOptions):
    """Drive a run's avatars with another subject's expressions (cross-reenactment); exit code 1 if a limit
    is exceeded."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `cross_reenactment` in the folder of the run."""

    source: str | None = None
    """Driving capture (or folder of several); default: every other subject of the run."""

    methods: tuple[str, ...] = ()
    """Methods to drive; default: all but the trivial baselines."""

    camera: str | None = None
    """Camera of the target to render; default: the first held out, or else the first of training."""

    frames: int | None = None
    """Maximum number of rendered timesteps of each source, evenly spaced; default: all."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "reenact"."""
        return {"source": self.source, "camera": self.camera, "frames": self.frames}


"""File with settings, limits, protocols and results of each avatar."""


@command("run extremes", group="compare")
def extremes_run(settings: ExtremesSettings, progress: Progress = no_progress) -> CommandResult:
    """Render views and poses beyond training; check against ground truth and stability limits.

    Does not pass if a limit is broken or an avatar failed. A restart keeps finished work.
    """
    return _run(settings, "extremes", "extremes")


@command("run reenact", group="compare")
def reenact_run(settings: ReenactSettings, progress: Progress = no_progress) -> CommandResult:
    """Drive avatars with another subject's expressions; check stability limits.

    Does not pass if a limit is broken or an avatar failed. A restart keeps finished work.
    """
    return _run(settings, "reenact", "cross_reenactment")


def _run(settings: ExtremesSettings | ReenactSettings, drive: str, task: str) -> CommandResult:
    """Run the plan in the folder of the task; write the record and the report."""
    execution, source = settings.execution, RunFolder(Path(settings.run))
    source.read_manifest()  # before a folder is created
    out = Path(settings.out) if settings.out else source.root / task
    check_kind(out, "a run")
    with locked(out):
        config, jobs = trained(source.root, settings.methods, settings, out)
        check_executor(execution, config.device)
        config = replace(
            with_methods(config, {job.method.spec.name for job in jobs}),
            regions=(),
            conditions=(Condition(drive=Named(drive, settings.parameters)),),
            source=settings.run,
        )
        clips = list({job.clip.subject: job.clip for job in jobs}.values())
        rows = run(config, execution, clips=clips, is_locked=True, reports=False).rows
        _write_record(out, drive, rows, settings.others)
        from ...reports.contact_sheet import robustness_report

        return robustness_report(out)


def _write_record(out: Path, drive: str, rows: Rows, settings: dict[str, Any]) -> None:
    """Write the results of each avatar, in the order of the run, or the reason of a failure."""
    folder = RunFolder(out)
    manifest = folder.read_manifest()
    table = rows.select(method=ALL, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    without = table[(table["timestep"] < 0) & (table["task"] != "")].drop_duplicates(
        ["subject", "method", "seed"]
    )
    failed = without[["subject", "method", "seed", "reason"]].to_dict("records")
    places = {(each["subject"], each["method"], each["seed"]) for each in failed}
    avatars: list[dict[str, Any]] = []
    for clip in manifest.clips:
        for method in manifest.methods:
            for seed in manifest.configuration.seeds:
                details = folder.cell(clip.subject, method.label, seed).record.get("details", {})
                if (clip.subject, method.name, seed) not in places and drive in details:
                    avatars += details[drive]["avatars"]
    record = {
        "settings": settings,
        "limits": resolve(get("conditions", drive).implementation.partition(":")[0] + ":LIMITS"),
        "protocols": [
            asdict(each) for each in sorted(manifest.protocols.values(), key=lambda each: each.hash)
        ],
        "avatars": avatars,
        **({"failed": failed} if failed else {}),
    }
    write_json(out / RECORD_FILE, record)


log = logging.getLogger(__name__)
NO_VARIATION = 1e-9
"""Components whose standard deviation is below this fraction of the largest are rounding errors."""
VIEWS_PER_SAMPLE = 2


@dataclass(frozen=True, eq=False)
class PoseComponents:
    """Principal components of expression and jaw together, each scaled to a total variance of 1 over the training poses."""

    mean: FloatArray
    low: FloatArray
    high: FloatArray
    """``mean``, ``low``, ``high``: (E + 3,) mean and range of expression and jaw."""
    directions: FloatArray
    """(D, E + 3) change of both by one standard deviation along each component, by decreasing deviation. D is less
    than requested if the training poses span fewer dimensions."""
    reach: FloatArray
    """(2, D) minimum and maximum over training poses along each component, in standard deviations."""

    @classmethod
    def of(cls, poses: Sequence[HeadPose], dimensions: int) -> PoseComponents:
        """Compute the components of some poses."""
        values = np.array([np.concatenate([pose.expression, pose.jaw]) for pose in poses], np.float64)
        mean, jaw = values.mean(axis=0), np.arange(values.shape[1]) >= values.shape[1] - 3
        variances = values.var(axis=0)
        scale = np.where(jaw, np.sqrt(variances[jaw].sum()), np.sqrt(variances[~jaw].sum()))
        scale[scale < NO_VARIATION] = 1.0  # constant coefficients are in no component
        _, singular, axes = np.linalg.svd((values - mean) / scale, full_matrices=False)
        deviations = singular / np.sqrt(max(len(values) - 1, 1))
        kept = np.flatnonzero(deviations > NO_VARIATION)[:dimensions]
        scores = ((values - mean) / scale) @ axes[kept].T / deviations[kept]
        return cls(
            mean,
            values.min(axis=0),
            values.max(axis=0),
            deviations[kept, None] * axes[kept] * scale,
            np.stack([scores.min(axis=0), scores.max(axis=0)]),
        )

    def at(self, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(E,) expression and (3,) jaw at (D,) standard deviations along the components, clamped to the range of training."""
        inside = np.clip(sigmas, *self.reach)
        values = np.clip(self.mean + inside @ self.directions, self.low, self.high)
        return values[:-3], values[-3:]


def joint_samples(count: int, dimensions: int, sigmas: float) -> FloatArray:
    """(count, dimensions) deterministic Latin hypercube sample of the standard normal distribution, within ``sigmas`` of 0.

    In each dimension, the values are the middle quantiles of ``count`` parts of equal probability, in random order
    (McKay, Beckman, Conover, Technometrics 21(2), 1979).
    """
    from scipy.special import ndtri  # which help does without

    rng = np.random.default_rng(0)
    parts = np.stack([rng.permutation(count) for _ in range(dimensions)], axis=1)
    return np.asarray(np.clip(ndtri((parts + 0.5) / count), -sigmas, sigmas))


TYPICAL, PATH = "typical", "path"


class PlannedFrame(NamedTuple):
    """A pose in a numbered view. Poses are named "typical", "sample-01" and so on, and "path"."""

    name: str
    number: int
    pose: HeadPose
    view: int


def sampled_poses(clip: Clip, dimensions: int, samples: int, sigmas: float) -> list[HeadPose]:
    """The typical training pose, then copies of it with jointly sampled expression and jaw.

    Only training timesteps are used. Poses have no timestep, so that avatars cannot use tracking that they refined for
    it. Without variation in training there is no sample.
    """
    poses = training_poses(clip)
    base = replace(typical_pose(poses), timestep=None)
    components = PoseComponents.of(poses, dimensions)
    found = [base]
    if len(components.directions):
        for numbers in joint_samples(samples, len(components.directions), sigmas):
            found.append(_with(base, *components.at(numbers)))
    return found


def path_poses(poses: Sequence[HeadPose], count: int) -> list[HeadPose]:
    """A smooth sequence from the first pose through the next two, slowing down at each of them."""
    ends = [np.concatenate([pose.expression, pose.jaw]) for pose in poses[:3]]
    found = []
    for place in np.linspace(0.0, len(ends) - 1, count) if len(ends) > 1 else ():
        before = min(int(place), len(ends) - 2)
        share = (1.0 - np.cos(np.pi * (place - before))) / 2.0
        values = (1.0 - share) * ends[before] + share * ends[before + 1]
        found.append(_with(poses[0], values[:-3], values[-3:]))
    return found


def _with(pose: HeadPose, expression: FloatArray, jaw: FloatArray) -> HeadPose:
    """The pose with another expression and jaw, in the same precision."""
    return replace(pose, expression=expression.astype(pose.expression.dtype), jaw=jaw.astype(pose.jaw.dtype))


TASK: Literal["extremes"] = "extremes"
LIMITS = {
    "views": asdict(VIEW_LIMITS),
    "expressions": asdict(EXPRESSION_LIMITS),
    "truth": asdict(TRUTH_LIMITS),
}


@dataclass(frozen=True, eq=False)
class ExtremesPlan:
    """Views and poses in which the avatars of one clip are rendered.

    The typical pose is rendered in every view, each sample in `VIEWS_PER_SAMPLE`, and the path in the front view.
    """

    views: Sequence[Viewpoint]
    frames: Sequence[PlannedFrame]
    fingerprint: str

    @classmethod
    def of(
        cls, clip: Clip, views: int, beyond: float, dimensions: int, samples: int, sigmas: float, path: int
    ) -> ExtremesPlan:
        """Choose views and poses for a clip from its training frames only."""
        cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
        chosen = turntable(cameras, common_target(cameras, head_center(clip)), views, beyond)
        poses = sampled_poses(clip, dimensions, samples, sigmas)
        front = min(range(views), key=lambda index: abs(chosen[index].azimuth))
        apart = max(1, views // VIEWS_PER_SAMPLE)
        frames = [PlannedFrame(TYPICAL, 0, poses[0], view) for view in range(views)]
        for number, pose in enumerate(poses[1:], 1):
            seen = sorted({(number - 1 + apart * k) % views for k in range(VIEWS_PER_SAMPLE)})
            frames += [PlannedFrame(f"sample-{number:02d}", number, pose, view) for view in seen]
        frames += [PlannedFrame(PATH, n, pose, front) for n, pose in enumerate(path_poses(poses, path))]
        asked = (views, beyond, dimensions, samples, sigmas, path)
        return cls(chosen, frames, digest(TASK, 2, clip.fingerprint, asked, tuple(LIMITS.values()))[:12])


def protocols(jobs: Sequence[Job], **parameters: Any) -> dict[str, Protocol]:
    """The protocols of the registered change "extremes"."""
    return protocols_of(TASK, [_shown(job, ExtremesPlan.of(job.clip, **parameters)) for job in jobs])


def drive(job: Job, avatar: Avatar, progress: Progress, **parameters: Any) -> tuple[Rows, dict[str, Any]]:
    """Render and evaluate every frame of the plan; the registered change "extremes".

    The details are the record of the avatar: views, frames, ground truth and results.
    """
    plan = ExtremesPlan.of(job.clip, **parameters)
    keys = _shown(job, plan).keys
    rows, record = judged_rows(job, keys, lambda: _judged(job, avatar, plan, progress))
    return Rows.of(rows), {"avatars": [record]}


def _shown(job: Job, plan: ExtremesPlan) -> ShownFrames:
    truths, _ = _truth(job)
    fingerprint = digest(plan.fingerprint, truths.fingerprint if truths else "")[:12]
    return ShownFrames(
        job,
        [job.clip],
        [_key(job, plan, frame) for frame in plan.frames],
        [(view.camera.width, view.camera.height) for view in plan.views],
        (f"views and poses of {job.clip.subject}", fingerprint),
    )


def _truth(job: Job) -> tuple[TruthPictures | None, str]:
    """The ground truth of a cell's subject, or None and the reason."""
    try:
        return TruthPictures.of(job), ""
    except UnavailableError as error:
        return None, str(error)


def _surface(avatar: Avatar, given: GivenFrame, truth: TrueFrame) -> list[LimitCheck]:
    """Errors of depth and normals, of an avatar that gives depth in images of the ground truth's shape."""
    height, width = truth.mask.shape
    camera = given.camera
    if camera.width * height != camera.height * width:
        return absent_surface("the method renders images of another shape")
    camera = camera.resized(width, height)
    depth = avatar.depth(camera, given.pose) if isinstance(avatar, DepthAvatar) else None
    return surface(depth, truth, camera)


def _key(job: Job, plan: ExtremesPlan, frame: PlannedFrame) -> FrameKey:
    return FrameKey(job.clip.subject, frame.name, frame.number, plan.views[frame.view].camera.id)


class GivenFrame(NamedTuple):
    """A planned frame as the method renders it."""

    camera: Camera
    pose: HeadPose
    restore: Callable[[FloatArray], FloatArray]
    """Maps an (H, W, 3) float image in this camera to the plan's."""

    def restored(self, frame: Frame) -> Frame:
        """The frame at the plan's size; what the method's image does not show is background without coverage."""
        alpha = np.repeat(np.asarray(frame.alpha, np.float32)[..., None], 3, axis=2)
        covered = self.restore(alpha) - self.restore(np.zeros_like(alpha))
        return Frame(self.restore(np.asarray(frame.rgb, np.float32)), covered[..., 0])


def given_frames(job: Job, plan: ExtremesPlan) -> list[GivenFrame]:
    """The frames of a plan, adapted to the job's method as its clip is: to another head model, image size, or one video."""
    if job.adapted is None:
        return [GivenFrame(plan.views[f.view].camera, f.pose, lambda image: image) for f in plan.frames]
    from ...datasets.clip import as_capture

    poses = list({id(frame.pose): frame.pose for frame in plan.frames}.values())
    number = {id(pose): timestep for timestep, pose in enumerate(poses)}
    keys = [_key(job, plan, frame)._replace(timestep=number[id(frame.pose)]) for frame in plan.frames]
    cameras = {view.camera.id: view.camera for view in plan.views}
    planned = as_capture(job.clip).to_render(
        TASK, {"plan": plan.fingerprint}, keys, dict(enumerate(poses)), cameras
    )
    assert job.config is not None
    with TemporaryDirectory() as folder:
        form = adapt(planned, MethodNeeds.of(job.method.spec), job.config.heads, Path(folder))
    given = []
    for key in keys:
        own = form.key(key)
        pose = replace(form.clip.poses[own.timestep], timestep=None)
        given.append(GivenFrame(form.clip.cameras[own.camera], pose, partial(form.restore, key)))
    return given


def _judged(
    job: Job, avatar: Avatar, plan: ExtremesPlan, report: Progress
) -> tuple[list[JudgedFrame], dict[str, Any]]:
    """Frames and the avatar's record. The typical pose comes first, as the reference for the others in its view."""
    background = [float(v) for v in job.form.clip.background]
    truths, missing = _truth(job)
    scores = TruthJudge(job.device)
    if truths is None:
        log.warning("%s: no ground truth: %s", job.name, missing)
    elif count := truths.missing([(plan.views[frame.view].camera, frame.pose) for frame in plan.frames]):
        log.info("%s: path-tracing %d ground-truth images, at least half a second each", job.name, count)
    measured: list[Measures] = []
    compared: list[TruthPair | None] = []
    against: list[tuple[list[LimitCheck], list[LimitCheck]]] = []
    shown = []
    pose, splats = None, None
    for index, (frame, given) in enumerate(zip(plan.frames, given_frames(job, plan))):
        view = plan.views[frame.view]
        if frame.pose is not pose:
            pose, splats = frame.pose, splats_of(avatar, given.pose)
        own, measures = render_measured(avatar, given.camera, given.pose, background, splats)
        rendered = given.restored(own)
        measured.append(measures)
        sample, follows = frame.name not in (TYPICAL, PATH), frame.name == PATH and frame.number > 0
        stem = f"{PATH}-{frame.number:02d}" if frame.name == PATH else frame.name
        place = job.cell.folder / f"{stem}_{view.camera.id}.png"
        entry: dict[str, Any] = {
            "key": str(_key(job, plan, frame)),
            "driven": place.relative_to(job.run).as_posix(),
        }
        write_frame(place, rendered)
        if truths is None:
            checks, response, flicker = without_truth(missing)
        else:
            truth, mask = truths.at(view.camera, frame.pose)
            entry["truth"] = mask[0].relative_to(job.run).as_posix()
            compared.append(TruthPair.of(rendered, truth))
            checks = scores.appearance(compared[-1], extrapolated=view.extrapolated)
            checks += _surface(avatar, given, truth)
            response = scores.response(compared[-1], compared[frame.view])
            flicker = scores.flicker(compared[-1], compared[-2 if follows else -1])
        against.append((checks, [*([response] if sample else []), *([flicker] if follows else [])]))
        shown.append(entry)
        report(index + 1, len(plan.frames), TASK)
    count = len(plan.views)
    between = [m for m, view in zip(measured, plan.views) if not view.extrapolated]
    middle = typical(between or measured[:count])
    frames = []
    for frame, measures, (checks, changes) in zip(plan.frames, measured, against):
        reference = middle if frame.name == TYPICAL else measured[frame.view]
        limits = VIEW_LIMITS if frame.name == TYPICAL else EXPRESSION_LIMITS
        frames.append(
            JudgedFrame(_key(job, plan, frame), [*judge(measures, reference, limits), *checks], changes)
        )
    for entry, judged in zip(shown, frames):
        entry["values"] = {check.name: check.value for check in (*judged.checks, *judged.changes)}
    details = {
        "views": [
            {"id": v.camera.id, "azimuth": round(v.azimuth, 2), "extrapolated": v.extrapolated}
            for v in plan.views
        ],
        "shown": shown,
        **({} if truths else {"no_truth": missing}),
    }
    return frames, details
