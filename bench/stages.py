"""The stages of one cell (a subject, a method, a seed): fit, render, measure. Each picks up where it was."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from .adaptation import AdaptedClip
from .contracts import Avatar, Camera, Clip, FrameKey, HeadPose, Measurement
from .errors import HeadbenchError, InputError, UnavailableError
from .files import digest
from .frames import quantise, read_png, write_png
from .machine import PeakMemory
from .progress import duration, progress
from .protocol import Protocol
from .run_config import ResolvedMethod
from .scoring import FULL, Frames, make_metric, score_frames
from .specs import MetricSpec
from .store import Cell, Row, read_rows, to_frame, write_rows
from .training_view import TrainingView

log = logging.getLogger(__name__)
RESULT_FORMAT = 1  # raise when a stage changes what it leaves behind


@dataclass(frozen=True)
class Job:
    """One cell with all it needs.

    ``clip`` is what is compared: the truth of every metric. ``adapted`` is its form for this method, None where
    that is the clip itself. ``regions`` are measured beside the whole frame.
    """

    clip: Clip
    method: ResolvedMethod
    seed: int
    device: str
    cell: Cell
    protocols: Mapping[str, Protocol]
    adapted: AdaptedClip | None = None
    regions: tuple[str, ...] = ()

    @property
    def form(self) -> AdaptedClip:
        """The clip as the method sees it."""
        return self.adapted or AdaptedClip(self.clip)

    @property
    def name(self) -> str:
        return f"{self.clip.subject} {self.method.spec.name} seed {self.seed}"

    @property
    def fit_fingerprint(self) -> str:
        """Digest of everything the trained avatar depends on."""
        return digest(RESULT_FORMAT, self.method.record(), self.seed, self.device, self.form.clip.fingerprint)

    def check(self) -> None:
        """Refuse a folder that holds an avatar made of something else."""
        state = self.cell.stage("fit")
        if state is not None and state.get("fingerprint") != self.fit_fingerprint:
            raise InputError(
                self.cell.folder / "fit.json",
                "fingerprint",
                f"{self.fit_fingerprint[:12]}, that of this run's settings and data",
                f"{str(state.get('fingerprint'))[:12]}, an avatar of other settings or data",
                "Choose another --out, or delete that folder.",
            )


def fit(job: Job) -> Avatar:
    """Train, or continue, or read what was trained; return the avatar as read back from disk.

    A native method sees the images of the training split alone. An adapter gets the whole clip, since official
    repositories want a whole capture. The record's ``seconds`` are those since the last of ``interruptions``.
    """
    method = job.method.create()
    if not job.cell.is_done("fit", job.fit_fingerprint):
        earlier = job.cell.stage("fit")
        interruptions = 0 if earlier is None else int(earlier.get("interruptions", 0)) + 1
        job.cell.begin("fit", job.fit_fingerprint, interruptions=interruptions)
        start = time.perf_counter()
        with PeakMemory() as memory, progress(f"{job.name}: training") as report:
            method.fit(
                TrainingView(job.form.clip) if job.method.spec.native else job.form.clip,
                job.cell.avatar,
                job.method.budget,
                device=job.device,
                seed=job.seed,
                progress=report,
            )
        seconds = time.perf_counter() - start
        job.cell.finish(
            "fit",
            job.fit_fingerprint,
            seconds=round(seconds, 3),
            interruptions=interruptions,
            peak_memory_bytes=memory.peak,
            memory_before_bytes=memory.before,
            method=job.method.record(),
        )
        log.info("%s: trained in %s", job.name, duration(seconds))
    avatar: Avatar = method.load(job.cell.avatar, device=job.device)
    return avatar


def render(job: Job, avatar: Avatar) -> None:
    """Render every frame of every protocol to 8-bit PNG of the protocol's size; frames already there are kept."""
    form = job.form
    wanted = [
        (protocol, key)
        for protocol in job.protocols.values()
        for key in protocol.keys
        if key.subject == job.clip.subject
    ]
    with progress(f"{job.name}: rendering") as report:
        for index, (protocol, key) in enumerate(wanted):
            path = job.cell.render(protocol.task, key)
            if not path.exists():
                seen = form.key(key)
                camera, pose = form.clip.cameras[seen.camera], form.clip.poses[seen.timestep]
                frame = avatar.render(camera, pose, protocol.background)
                if frame.rgb.shape != (camera.height, camera.width, 3):
                    raise InputError(
                        job.name, str(key), f"shape {(camera.height, camera.width, 3)}", f"{frame.rgb.shape}"
                    )
                write_png(path, quantise(form.restore(key, frame.rgb)))
            report(index + 1, len(wanted), protocol.task)


def measure(job: Job, avatar: Avatar, metrics: Sequence[MetricSpec]) -> pd.DataFrame:
    """Score the stored frames and the avatar as a whole; what was measured already is read back.

    Metrics of one implementation are one measurement: they are read back, or taken anew, together. A measurement that
    gave any number is read back; one that could not be had is tried again.
    """
    stage = job.cell.stage("measure") or {}
    known, details = stage.get("fingerprints", {}), dict(stage.get("details", {}))
    old = read_rows(job.cell.rows) if job.cell.rows.exists() else to_frame([])
    fingerprints = {spec.name: _measure_fingerprint(job, spec) for spec in metrics}
    had = {spec.implementation for spec in metrics if "ok" in set(_rows_of(old, spec)["status"])}
    new = {spec.implementation for spec in metrics if known.get(spec.name) != fingerprints[spec.name]}
    wanted = [spec for spec in metrics if spec.implementation not in had - new]
    per_frame = [spec for spec in wanted if spec.per_frame]
    scored = [_score(job, per_frame, protocol) for protocol in job.protocols.values() if per_frame]
    parts: list[pd.DataFrame] = []
    measured: dict[str, Measurement | UnavailableError] = {}
    for spec in metrics:
        if spec not in wanted:
            parts.append(_rows_of(old, spec))
            continue
        if spec.per_frame:
            rows = [row for of_protocol in scored for row in of_protocol[spec.name]]
        else:
            if spec.implementation not in measured:
                measured[spec.implementation] = outcome = _measure_avatar(job, spec, avatar)
                details[spec.name] = outcome.details if isinstance(outcome, Measurement) else {}
            rows = [_avatar_row(job, spec, measured[spec.implementation])]
        parts.append(to_frame(rows))
    result = pd.concat(parts, ignore_index=True)
    write_rows(job.cell.rows, result)
    job.cell.finish("measure", job.fit_fingerprint, fingerprints=fingerprints, details=details)
    return result


def _rows_of(rows: pd.DataFrame, spec: MetricSpec) -> pd.DataFrame:
    return rows[rows["metric"] == spec.name]


def _measure_fingerprint(job: Job, spec: MetricSpec) -> str:
    """Digest of everything a metric's values depend on."""
    protocols = sorted(protocol.hash for protocol in job.protocols.values())
    what = spec.name, spec.implementation, spec.detail, job.regions if spec.regions else ()
    return digest(RESULT_FORMAT, job.fit_fingerprint, protocols, *what)


def failed_rows(job: Job, metrics: Sequence[MetricSpec], error: Exception) -> pd.DataFrame:
    """Rows that show a failed cell as failed, with its error."""
    reason = f"{type(error).__name__}: {error}"
    rows = [
        _row(job, spec, protocol, None, math.nan, "failed", reason)
        for spec in metrics
        for protocol in (job.protocols.values() if spec.per_frame else [None])
    ]
    return to_frame(rows)


def workload(
    form: AdaptedClip, protocols: Mapping[str, Protocol], size: tuple[int, int] | None = None
) -> list[tuple[Camera, HeadPose]]:
    """Return a walk over the cameras and poses of the scored frames, a new camera and pose at every step.

    ``size`` is the (width, height) that the cameras are brought to, None for their own.
    """
    clip = form.clip
    keys = [form.key(k) for p in protocols.values() for k in p.keys if k.subject == clip.subject]
    timesteps = sorted({k.timestep for k in keys})
    cameras = [
        camera if size is None else camera.resized(*size) for _, camera in sorted(clip.cameras.items())
    ]
    steps = max(len(timesteps), len(cameras), 2)
    walk = [(cameras[i % len(cameras)], clip.poses[timesteps[i % len(timesteps)]]) for i in range(steps)]
    first, last = walk[0], walk[-1]
    return walk[:-1] if len(walk) > 2 and first[0] is last[0] and first[1] is last[1] else walk


def _score(job: Job, specs: Sequence[MetricSpec], protocol: Protocol) -> dict[str, list[Row]]:
    """Rows of each metric over a protocol's frames of the job's subject."""
    keys = [key for key in protocol.keys if key.subject == job.clip.subject]
    frames = Frames(lambda key: read_png(job.cell.render(protocol.task, key)), job.clip)
    by_name = {spec.name: spec for spec in specs}
    with progress(f"{job.name}: measuring {protocol.task}") as report:
        scored = score_frames(keys, frames, specs, job.regions, report)
    return {
        name: [
            _row(job, by_name[name], protocol, s.key, s.value, s.status, s.reason, s.region) for s in scores
        ]
        for name, scores in scored.items()
    }


def _measure_avatar(job: Job, spec: MetricSpec, avatar: Avatar) -> Measurement | UnavailableError:
    metric = make_metric(spec)
    try:
        if spec.training:
            measured: Measurement = metric(job.cell.stage("fit") or {})
        else:
            size = job.method.spec.resolution.speed_size
            measured = metric(avatar, workload(job.form, job.protocols, size))
    except UnavailableError as error:
        return error
    return measured


def _avatar_row(job: Job, spec: MetricSpec, outcome: Measurement | UnavailableError) -> Row:
    if isinstance(outcome, UnavailableError):
        return _row(job, spec, None, None, math.nan, "missing", str(outcome))
    if not spec.detail:
        return _row(job, spec, None, None, outcome.value, "ok", "")
    if spec.detail not in outcome.details:
        return _row(job, spec, None, None, math.nan, "missing", "This avatar does not tell it.")
    return _row(job, spec, None, None, float(outcome.details[spec.detail]), "ok", "")


def _row(
    job: Job,
    spec: MetricSpec,
    protocol: Protocol | None,
    key: FrameKey | None,
    value: float,
    status: str,
    reason: str,
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
    )
