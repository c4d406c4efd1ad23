"""One cell: fit or derive its avatar, render its frames, measure them. Each stage resumes; what is complete is read back."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from ..contracts import (
    Avatar,
    Camera,
    Clip,
    CodedAvatar,
    Frame,
    FrameKey,
    HeadPose,
    ListedFrames,
    Measurement,
    PreparedMethod,
    Progress,
)
from ..errors import HeadbenchError, InputError, UnavailableError
from ..io.files import write_text
from ..io.images import quantise, read_png, write_png
from ..machine import PeakMemory, ProcessorLoad, machine_name, processor_seconds, use_device
from ..progress import duration
from ..protocol import Protocol
from ..rows import FULL, SUSPECT, Row, Rows
from ..specs import DYNAMIC, MetricSpec
from .adaptation import AdaptedClip
from .config import resolve_change
from .plan import MEASURING_AVATAR, RENDERING, TRAINING, Job, source_fingerprint, trained_ago, trained_record
from .scoring import Score, ScoredFrames, TrainingView, check_frame, make_metric, score_frames
from .stored import shown_by, training_losses, write_avatar_record

log = logging.getLogger(__name__)


def run_cell(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    """Train or derive the avatar of a cell, render its frames and measure them; rows that are complete are read back.

    If the cell's condition animates the avatar, that change replaces the last two stages.
    """
    if (rows := kept_rows(job, metrics)) is not None:
        log_kept(job)
        return rows
    avatar = train(job) if job.source is None else derive(job)
    if job.condition.drive:
        return drive(job, avatar, metrics)
    render(job, avatar)
    return measure(job, avatar, metrics)


def kept_rows(job: Job, metrics: Sequence[MetricSpec]) -> Rows | None:
    """Rows of these metrics if all are measured, else None."""
    rows = stored_rows(job) if job.is_measured(metrics) else None
    return None if rows is None else rows.of_metrics([spec.name for spec in metrics])


def log_kept(job: Job) -> None:
    """Say that the avatar of a cell is one of an earlier start."""
    if job.source is None and job.cell.is_trained:
        log.info("%s: kept: trained %s", job.name, trained_ago(job.cell.record))


def stored_rows(job: Job) -> Rows | None:
    """Rows of the metrics that the cell is recorded to have; None for none.

    If they are missing or damaged, the record is withdrawn, so that they are measured again.
    """
    done = job.cell.record.get("measured", [])
    if not done:
        return None
    try:
        return Rows.read(job.cell.rows).of_metrics(done)
    except InputError as error:
        log.warning("%s: to be measured again, since its rows cannot be read: %s", job.name, error)
        job.cell.update(measured=[])
        return None


def train(job: Job) -> Avatar:
    """Train, resume training or read the trained avatar; return the avatar as read back from disk.

    A method can only read images of the training split. The recorded seconds start at the last of
    ``interruptions``.
    """
    method, cell, record = job.create(), job.cell, job.cell.record
    if record.get("state") == "trained":
        log_kept(job)
        return job.load()
    if "state" not in record and cell.avatar.exists():
        remedy = f"Delete {cell.folder}; the same command makes it again."
        raise InputError(cell.folder, cell.file.name, "the record of the avatar in it", "none", remedy)
    interruptions = record["training"]["interruptions"] + 1 if "state" in record else 0
    use_device(job.device)  # before the training is recorded as begun
    cell.update(
        state="training",
        fingerprint=job.fit_fingerprint,
        method=job.method.record(),
        training={"interruptions": interruptions},
    )
    if isinstance(method, PreparedMethod):
        method.prepare(job.device)
    start, processor = time.perf_counter(), processor_seconds()
    load = ProcessorLoad(job.device)
    with load, PeakMemory(job.device) as memory, job.progress(TRAINING) as report:
        method.fit(
            TrainingView(job.form.clip),
            cell.avatar,
            job.method.budget,
            device=job.device,
            seed=job.seed,
            progress=report,
        )
    seconds = time.perf_counter() - start
    clip, budget = job.form.clip, asdict(job.method.budget)
    origin = {"seed": job.seed, "budget": budget, "capture": clip.fingerprint}
    write_avatar_record(cell.avatar, job.method, *shown_by(clip), "training", origin)
    training = {
        "seconds": round(seconds, 3),
        "processor_seconds": round(processor_seconds() - processor, 3),
        "interruptions": interruptions,
        "peak_memory_bytes": memory.peak,
        "memory_before_bytes": memory.before,
        **memory.device_record,
        "load": {"machine": load.machine, **load.details},
        "finished_at": datetime.now(UTC).timestamp(),
    }
    write_losses(job)
    cell.update(state="trained", training=training)
    log.info("%s: trained in %s", job.name, duration(seconds))
    return job.load()


def write_losses(job: Job) -> None:
    """Write training losses to ``losses.csv`` and, if TensorBoard is installed, as its events, into the cell's folder."""
    losses = training_losses(job.cell.avatar)
    if not losses:
        return
    lines = ["iteration,loss", *(f"{iteration},{loss!r}" for iteration, loss in losses)]
    write_text(job.cell.folder / "losses.csv", "\n".join(lines) + "\n")
    try:
        tensorboard = import_module("torch.utils.tensorboard")
    except ImportError:
        return
    with tensorboard.SummaryWriter(str(job.cell.folder / "tensorboard")) as writer:
        for iteration, loss in losses:
            writer.add_scalar("loss", loss, iteration)


def derive(job: Job) -> Avatar:
    """Use the avatar of the job's ``source``, or derive one from it by the condition, without training."""
    assert job.source is not None
    derived_from = source_fingerprint(job)
    record: dict[str, Any] = {"fingerprint": job.fit_fingerprint, "derived_from": derived_from}
    change, clip = job.condition.derive, job.form.clip
    if change:
        make = resolve_change(change, "derive")
        avatar: Avatar = make(
            job.method.spec, job.source.avatar, job.cell.avatar, TrainingView(clip), job.device
        )
        origin = {"variant": job.condition.name, "of": derived_from}
        write_avatar_record(job.cell.avatar, job.method, *shown_by(clip), "variant", origin)
    else:
        avatar = job.load()
        source = trained_record(job.source)
        record |= {name: source[name] for name in ("method", "training") if name in source}  # type: ignore[literal-required]
    job.cell.update(state="trained", **record)
    return avatar


def render(job: Job, avatar: Avatar) -> None:
    """Render every frame of every protocol that does not exist yet to 8-bit PNG of the protocol's size."""
    form = job.form
    missing = {path: frame for path, frame in job.frame_paths.items() if not path.exists()}
    if not missing:
        return
    written = set()
    with job.progress(RENDERING) as report:
        for index, (path, frame) in enumerate(_drawn(job, avatar, missing, report)):
            protocol, key = missing[path]
            camera = form.clip.cameras[form.key(key).camera]
            check_frame(frame, (camera.height, camera.width), job.name, key)
            write_png(path, quantise(form.restore(key, frame.rgb)))
            written.add(path)
            report(index + 1, len(missing), protocol.task)
    if lacking := missing.keys() - written:
        first = missing[min(lacking)][1]
        raise InputError(job.name, str(first), "a render", f"none of it and {len(lacking) - 1} more")


def _drawn(
    job: Job, avatar: Avatar, missing: Mapping[Path, tuple[Protocol, FrameKey]], report: Progress
) -> Iterator[tuple[Path, Frame]]:
    """Path and frame of each render; for avatars that render lists, a whole task at a time."""
    clip, change = job.form.clip, resolve_change(job.condition.views, "views")
    views: dict[str, dict[FrameKey, tuple[Path, tuple[Camera, HeadPose], Sequence[float]]]] = {}
    for path, (protocol, key) in missing.items():
        seen = job.form.key(key)
        view = clip.cameras[seen.camera], clip.poses[seen.timestep]
        if job.condition.views:
            camera, pose = change(avatar, clip, seen, protocol.background)
            yield path, avatar.render(camera, pose, protocol.background)
        elif isinstance(avatar, ListedFrames):
            views.setdefault(protocol.task, {})[seen] = (path, view, protocol.background)
        else:
            yield path, avatar.render(*view, protocol.background)
    before = 0
    for task, listed in views.items():
        assert isinstance(avatar, ListedFrames)
        background = next(iter(listed.values()))[2]
        asked = {key: view for key, (_, view, _) in listed.items()}

        def drawing(done: int, total: int, note: str = "", task: str = task, before: int = before) -> None:
            report(before, len(missing), f"{task}, {done} of {total} drawn {note}")  # none read back yet

        for key, frame in avatar.render_listed(asked, background, drawing):
            yield listed[key][0], frame
        before += len(listed)


def measure(job: Job, avatar: Avatar, metrics: Sequence[MetricSpec]) -> Rows:
    """Evaluate the stored frames and the avatar as a whole by the metrics that are not measured yet.

    Metrics with the same implementation are one measurement. Returns the rows of all ``metrics``.
    """
    cell, earlier = job.cell, stored_rows(job)
    record = cell.record
    done = record.get("measured", [])
    wanted = [spec for spec in metrics if spec.name not in done]
    per_frame = [spec for spec in wanted if spec.per_frame]
    of_avatar = [spec for spec in wanted if not spec.per_frame]
    scored = [_score(job, per_frame, protocol) for protocol in job.protocols.values() if per_frame]
    rows = [row for of_protocol in scored for row in of_protocol]
    details = record.get("details", {})
    measured: dict[str, Measurement | UnavailableError] = {}
    with job.progress(MEASURING_AVATAR) if of_avatar else nullcontext():
        for spec in of_avatar:
            if spec.implementation not in measured:
                measured[spec.implementation] = outcome = _measure_avatar(job, spec, avatar)
                found = outcome.details.items() if isinstance(outcome, Measurement) else ()
                # JSON has only finite numbers; a metric with another value has its own row.
                details[spec.name] = {k: v for k, v in found if not isinstance(v, float) or math.isfinite(v)}
            rows.append(_avatar_row(job, spec, measured[spec.implementation]))
    names = dict.fromkeys([*(spec.name for spec in metrics), *done])
    result = Rows.joined([*([] if earlier is None else [earlier]), Rows.of(rows)]).of_metrics([*names])
    result.write(cell.rows)
    codec = avatar.codec if isinstance(avatar, CodedAvatar) else ""
    cell.update(measured=[*names], details=details, codec=codec)
    return result.of_metrics([spec.name for spec in metrics])


def drive(job: Job, avatar: Avatar, metrics: Sequence[MetricSpec]) -> Rows:
    """Render and evaluate the avatar with the condition's change; write the rows, and the details of the change."""
    change = job.condition.drive
    with job.progress(RENDERING) as report:
        found, details = resolve_change(change, "drive")(job, avatar, report)
    names = [spec.name for spec in metrics]
    rows: Rows = found.of_metrics(names)
    rows.write(job.cell.rows)
    job.cell.update(measured=names, details={change.name: details})
    return rows


def failed_rows(job: Job, metrics: Sequence[MetricSpec], reason: str) -> Rows:
    """Rows that mark a cell as failed, with the reason."""
    rows = [
        _row(job, spec, protocol, status="failed", reason=reason)
        for spec in metrics
        for protocol in (job.protocols.values() if spec.per_frame else [None])
    ]
    return Rows.of(rows)


def workload(
    form: AdaptedClip, protocols: Mapping[str, Protocol], size: tuple[int, int] | None = None
) -> list[tuple[Camera, HeadPose]]:
    """Cameras and poses of the scored frames in pairs, a new camera and pose in every pair; of training frames if none is scored.

    Cameras are resized to ``size``, (width, height); None for their own.
    """
    clip = form.clip
    keys = [form.key(k) for p in protocols.values() for k in p.keys if k.subject == clip.subject]
    timesteps = sorted({k.timestep for k in keys or clip.splits["train"]})
    cameras = [
        camera if size is None else camera.resized(*size) for _, camera in sorted(clip.cameras.items())
    ]
    steps = max(len(timesteps), len(cameras), 2)
    pairs = [(cameras[i % len(cameras)], clip.poses[timesteps[i % len(timesteps)]]) for i in range(steps)]
    first, last = pairs[0], pairs[-1]
    return pairs[:-1] if len(pairs) > 2 and first[0] is last[0] and first[1] is last[1] else pairs


MOST_POSES = 200
"""Timesteps of training over which a mechanism is measured; more are thinned evenly."""


def training_poses(clip: Clip) -> list[tuple[Camera, HeadPose]]:
    """The timesteps of the training split in order, each with its first camera, at most `MOST_POSES`."""
    cameras = {key.timestep: key.camera for key in sorted(clip.splits["train"], reverse=True)}
    timesteps = sorted(cameras)
    count = min(len(timesteps), MOST_POSES)
    chosen = (timesteps[i * len(timesteps) // count] for i in range(count))
    return [(clip.cameras[cameras[timestep]], clip.poses[timestep]) for timestep in chosen]


def _score(job: Job, specs: Sequence[MetricSpec], protocol: Protocol) -> Iterator[Row]:
    """Rows of each metric over a protocol's frames of the job's subject."""
    keys = [key for key in protocol.keys if key.subject == job.clip.subject]
    frames = ScoredFrames(lambda key: read_png(job.cell.render(protocol.task, key)), job.clip)
    with job.progress(f"measuring {protocol.task}") as report:
        scored = score_frames(keys, frames, specs, job.regions, report, job.device)
    for spec in specs:
        for s in scored[spec.name]:
            reason = s.reason or _suspicion(spec, s)
            yield _row(job, spec, protocol, s.key, s.value, s.status, reason, s.region)


def _suspicion(spec: MetricSpec, score: Score) -> str:
    """Reason of a row whose value is suspiciously good; "" for any other."""
    if spec.suspect_above is None or score.region != FULL or not score.value > spec.suspect_above:
        return ""
    return f"{SUSPECT}above {spec.suspect_above:g} {spec.unit}"


def _measure_avatar(job: Job, spec: MetricSpec, avatar: Avatar) -> Measurement | UnavailableError:
    metric = make_metric(spec)
    try:
        if spec.kind == "training":
            record = job.cell.record
            return metric({**record.get("training", {}), "method": record.get("method", {})})  # type: ignore[no-any-return]
        if spec.kind == "mechanism":
            return metric(avatar, training_poses(job.form.clip))  # type: ignore[no-any-return]
        pairs = workload(job.form, job.protocols, job.method.spec.resolution.speed_size)
        if not spec.machine_bound:
            return metric(avatar, pairs)  # type: ignore[no-any-return]
        with ProcessorLoad(job.device, wait=True) as load:
            value = metric(avatar, pairs)
        return Measurement(value.value, {**value.details, **load.details})
    except UnavailableError as error:
        return error


def _avatar_row(job: Job, spec: MetricSpec, outcome: Measurement | UnavailableError) -> Row:
    if isinstance(outcome, UnavailableError):
        return _row(job, spec, reason=str(outcome))
    if spec.detail and spec.detail not in outcome.details:
        return _row(job, spec, reason="The avatar does not report it.")
    value = float(outcome.details[spec.detail]) if spec.detail else outcome.value
    mechanism = job.method.spec.mechanism if spec.name == DYNAMIC else None
    reason = mechanism.told(value, job.condition.name) if mechanism else ""
    row = _row(job, spec, value=value, status="ok", reason=reason)
    return replace(row, **_conditions(job, spec, outcome.details))


def _conditions(job: Job, spec: MetricSpec, details: Mapping[str, float]) -> dict[str, Any]:
    """Columns of a time: machine, number of threads, load by other processes; empty for other metrics."""
    if not spec.machine_bound or "threads" not in details:
        return {}
    if spec.kind == "training":
        machine = str(job.cell.record.get("training", {}).get("load", {}).get("machine", ""))
    else:
        machine = machine_name(job.device)
    others = float(details.get("other_cores", math.nan))
    return {"machine": machine, "threads": int(details["threads"]), "other_cores": others}


def _row(
    job: Job,
    spec: MetricSpec,
    protocol: Protocol | None = None,
    key: FrameKey | None = None,
    value: float = math.nan,
    status: str = "missing",
    reason: str = "",
    region: str = FULL,
) -> Row:
    if status == "ok" and not math.isfinite(value):
        raise HeadbenchError(f"{job.name}: {spec.name} of {key} is {value}; a metric must be finite")
    return Row(
        method=job.method.spec.name,
        version=job.method.spec.version,
        seed=job.seed,
        task=protocol.task if protocol else "",
        subject=job.clip.subject,
        sequence=key.sequence if key else "",
        timestep=key.timestep if key else -1,
        camera=key.camera if key else "",
        region=region,
        metric=spec.name,
        value=value,
        protocol=protocol.hash if protocol else "",
        status=status,
        reason=reason,
        condition=job.condition.name,
    )
