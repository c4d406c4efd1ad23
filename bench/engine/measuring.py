"""Measurements of a cell's renders and avatar, as rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Any

from ..contracts import Avatar, Camera, Clip, CodedAvatar, FrameKey, HeadPose, Measurement
from ..errors import HeadbenchError, UnavailableError
from ..io.files import digest, digest_file
from ..io.images import read_png
from ..machine import ProcessorLoad, machine_name
from ..protocol import Protocol
from ..registry import get
from ..rows import ALL, SUSPECT, Row, Rows
from ..source import code_digest, is_outside
from ..specs import DYNAMIC, ConditionSpec, MetricSpec
from .adaptation import AdaptedClip
from .config import resolve_change
from .job import (
    DIGESTS,
    MEASURING_AVATAR,
    RENDERING,
    RESULT_FORMAT,
    Job,
    avatar_record,
    recorded_frames,
    source_now,
    warn_of_damage,
)
from .scoring import FULL, Score, ScoredFrames, make_metric, score_frames
from .store import Cell


def measure(job: Job, avatar: Avatar, metrics: Sequence[MetricSpec]) -> Rows:
    """Evaluate the stored frames and the avatar as a whole; existing results are read back.

    Metrics with the same implementation are one measurement, which is read back or repeated as a whole. A measurement
    with any value is read back; a failed one is repeated. Damaged rows are measured again, with a warning.
    Rows of metrics that are not requested stay in the cell's file, with the record of their inputs.
    """
    known, details, old = _measured_before(job)
    rendered = recorded_frames(job)
    earlier = {
        spec.name: old.select(method=ALL, condition=ALL, metric=spec.name, task=ALL, region=ALL, seeds=ALL)
        for spec in metrics
    }
    fingerprints = {spec.name: _measure_fingerprint(job, spec, rendered) for spec in metrics}
    had = {spec.implementation for spec in metrics if "ok" in set(earlier[spec.name]["status"])}
    new = {spec.implementation for spec in metrics if known.get(spec.name) != fingerprints[spec.name]}
    wanted = [spec for spec in metrics if spec.implementation not in had - new]
    per_frame = [spec for spec in wanted if spec.per_frame]
    scored = [_score(job, per_frame, protocol) for protocol in job.protocols.values() if per_frame]
    measured: dict[str, Measurement | UnavailableError] = {}
    of_avatar = [spec for spec in wanted if not spec.per_frame]
    with job.progress(MEASURING_AVATAR) if of_avatar else nullcontext():
        for spec in of_avatar:
            if spec.implementation not in measured:
                measured[spec.implementation] = outcome = _measure_avatar(job, spec, avatar)
                found = outcome.details.items() if isinstance(outcome, Measurement) else ()
                # JSON has only finite numbers; a metric with another value has its own row.
                details[spec.name] = {k: v for k, v in found if not isinstance(v, float) or math.isfinite(v)}
    parts: list[Rows] = []
    for spec in metrics:
        if spec not in wanted:
            parts.append(Rows(earlier[spec.name]))
        elif spec.per_frame:
            parts.append(Rows.of(row for of_protocol in scored for row in of_protocol[spec.name]))
        else:
            parts.append(Rows.of([_avatar_row(job, spec, measured[spec.implementation])]))
    result = Rows.joined(parts)
    others = sorted(old.metrics - fingerprints.keys())
    job.cell.begin("measure", job.fit_fingerprint)  # in case of an interruption before the record
    Rows.joined([result, old.of_metrics(others)] if others else [result]).write(job.cell.rows)
    job.cell.finish(
        "measure",
        job.fit_fingerprint,
        fingerprints=known | fingerprints,
        details=details,
        rows=digest_file(job.cell.rows),
        codec=avatar.codec if isinstance(avatar, CodedAvatar) else "",
    )
    return result


def drive(job: Job, avatar: Avatar) -> Rows:
    """Render and evaluate the avatar with the condition's change; write the rows and a record to the cell.

    The record has the details of the change, and digests of its files by their path in the run folder.
    """
    change = job.condition.drive
    with job.progress(RENDERING) as report:
        rows, details, files = resolve_change(change, "drive")(job, avatar, report)
    rows.write(job.cell.rows)
    job.cell.finish(
        "measure",
        job.fit_fingerprint,
        fingerprints={change.name: _drive_fingerprint(job)},
        details={change.name: details},
        files=Cell(job.run).digests(set(files)),
        rows=digest_file(job.cell.rows),
    )
    return rows  # type: ignore[no-any-return]


def _drive_fingerprint(job: Job) -> str:
    """Digest of everything that the rows of an animated avatar depend on."""
    change = job.condition.drive
    spec: ConditionSpec = get("conditions", change.name)
    code = code_digest(spec.implementation) if is_outside(spec.implementation) else ""
    state = None if job.source is None else job.source.step("fit")
    source = None if state is None else (state["fingerprint"], state.get("files"))
    protocols = sorted(protocol.hash for protocol in job.protocols.values())
    return digest(
        RESULT_FORMAT, job.fit_fingerprint, asdict(change), code, source, avatar_record(job), protocols
    )


def _driven_before(job: Job, retry: bool) -> Rows | None:
    """Stored rows of an animated avatar; None if there are none (``retry``: or no value)."""
    state = job.cell.step("measure")
    if state is None or not job.cell.is_done("fit", job.fit_fingerprint):
        return None
    known, _, rows = _measured_before(job)
    if known.get(job.condition.drive.name) != _drive_fingerprint(job):
        return None
    damaged = Cell(job.run).damage(state.get("files", {}))
    if damaged:
        warn_of_damage(job, damaged, "rendered again")
    return None if damaged or (retry and not rows.metrics_with_values) else rows


def stored_rows(job: Job, metrics: Sequence[MetricSpec], *, retry: bool = False) -> Rows | None:
    """Stored rows of a finished cell; None if something is missing, damaged or made from other inputs.

    ``retry``: failed measurements count as missing, so that they are repeated.
    """
    if job.condition.drive:
        return _driven_before(job, retry)
    fitted = job.cell.step("fit")
    made_of = digest(job.fit_fingerprint, avatar_record(job))
    if job.source is not None and fitted is not None and fitted.get("derived_from") != source_now(job):
        return None
    if fitted is None or not job.cell.is_done("fit", job.fit_fingerprint):
        return None
    if not job.cell.is_done(DIGESTS, made_of) or job.cell.damage(fitted.get("files", {})):
        return None
    rendered = recorded_frames(job)
    frames = {name: rendered.get(name, "") for name in map(job.cell.name, job.frame_paths)}
    if job.cell.damage(frames):
        return None
    known, _, old = _measured_before(job)
    if any(known.get(spec.name) != _measure_fingerprint(job, spec, rendered) for spec in metrics):
        return None
    measured = old.metrics_with_values
    had = {spec.implementation for spec in metrics if spec.name in measured}
    if retry and any(spec.implementation not in had for spec in metrics):
        return None
    return old.of_metrics([spec.name for spec in metrics])


def _measured_before(job: Job) -> tuple[dict[str, str], dict[str, Any], Rows]:
    """Fingerprints and details of finished measurements by metric, and the rows."""
    step = job.cell.step("measure")
    if step is None or step["status"] != "done" or "rows" not in step:
        return {}, {}, Rows.of([])
    damaged = job.cell.damage({job.cell.name(job.cell.rows): step["rows"]})
    if damaged:
        warn_of_damage(job, damaged, "measured again")
        return {}, {}, Rows.of([])
    return step.get("fingerprints", {}), dict(step.get("details", {})), Rows.read(job.cell.rows)


def _measure_fingerprint(job: Job, spec: MetricSpec, rendered: Mapping[str, str]) -> str:
    """Digest of everything a metric's values depend on."""
    protocols = sorted(protocol.hash for protocol in job.protocols.values())
    regions = job.regions if spec.kind == "regional" else ()
    what: Any = avatar_record(job)
    if spec.per_frame:
        what = {name: rendered.get(name) for name in map(job.cell.name, job.frame_paths)}
    metric: tuple[str, ...] = (spec.name, spec.implementation, spec.detail)
    if is_outside(spec.implementation):
        metric = (*metric, code_digest(spec.implementation))
    return digest(RESULT_FORMAT, job.fit_fingerprint, protocols, *metric, regions, what)


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
    """Cameras and poses of the scored frames in pairs, a new camera and pose in every pair.

    Cameras are resized to ``size``, (width, height); None for their own.
    """
    clip = form.clip
    keys = [form.key(k) for p in protocols.values() for k in p.keys if k.subject == clip.subject]
    timesteps = sorted({k.timestep for k in keys})
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


def _score(job: Job, specs: Sequence[MetricSpec], protocol: Protocol) -> dict[str, list[Row]]:
    """Rows of each metric over a protocol's frames of the job's subject."""
    keys = [key for key in protocol.keys if key.subject == job.clip.subject]
    frames = ScoredFrames(lambda key: read_png(job.cell.render(protocol.task, key)), job.clip)
    by_name = {spec.name: spec for spec in specs}
    with job.progress(f"measuring {protocol.task}") as report:
        scored = score_frames(keys, frames, specs, job.regions, report, job.device)
    return {
        name: [
            _row(
                job,
                by_name[name],
                protocol,
                s.key,
                s.value,
                s.status,
                s.reason or _suspicion(by_name[name], s),
                s.region,
            )
            for s in scores
        ]
        for name, scores in scored.items()
    }


def _suspicion(spec: MetricSpec, score: Score) -> str:
    """Reason of a row whose value is suspiciously good; "" for any other."""
    if spec.suspect_above is None or score.region != FULL or not score.value > spec.suspect_above:
        return ""
    return f"{SUSPECT}above {spec.suspect_above:g} {spec.unit}"


def _measure_avatar(job: Job, spec: MetricSpec, avatar: Avatar) -> Measurement | UnavailableError:
    metric = make_metric(spec)
    try:
        if spec.kind == "training":
            return metric(job.cell.step("fit") or {})  # type: ignore[no-any-return]
        if spec.kind == "mechanism":
            return metric(avatar, training_poses(job.form.clip))  # type: ignore[no-any-return]
        pairs = workload(job.form, job.protocols, job.method.spec.resolution.speed_size)
        if not spec.machine_bound:
            return metric(avatar, pairs)  # type: ignore[no-any-return]
        with ProcessorLoad(job.device, wait=True) as load:
            found = metric(avatar, pairs)
        return Measurement(found.value, {**found.details, **load.details})
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
        step = job.cell.step("fit")
        machine = "" if step is None else str(step.get("load", {}).get("machine", ""))
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
