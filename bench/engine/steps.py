"""The steps of one cell (a subject, a method, a seed): fit, render, measure. Each can resume."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from ..condition import PLAIN, Condition, label_of
from ..contracts import (
    Avatar,
    Camera,
    CheckedMethod,
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
from ..errors import HeadbenchError, InputError, UnavailableError, is_damage, text_of
from ..io.documents import read_json
from ..io.files import digest, digest_file, grouped_writes, refuse_links, write_text
from ..io.images import quantise, read_png, write_png
from ..isolation.parent import IsolatedAvatar, IsolatedMethod
from ..machine import PeakMemory, ProcessorLoad, machine_name, processor_seconds, use_device
from ..progress import RunProgress, duration, progress
from ..protocol import Protocol
from ..registry import get
from ..rows import ALL, SUSPECT, Row, Rows
from ..source import code_digest, is_outside
from ..specs import ConditionSpec, MetricSpec
from .adaptation import AdaptedClip
from .config import ResolvedMethod, RunConfig, resolve_change
from .guard import TrainingView, check_frame, check_unchanged, state_digest
from .scoring import FULL, Score, ScoredFrames, make_metric, score_frames
from .store import Cell, StepState, avatar_files
from .stored import AVATAR_FILE, shown_by, training_losses, write_avatar_record

log = logging.getLogger(__name__)
RESULT_FORMAT = 1  # raise when the output of a step changes
TRAINING, RENDERING, MEASURING_AVATAR = "training", "rendering", "measuring the avatar"
DIGESTS = "digests"
RECORD_EVERY_S = 10.0
"""Seconds between records of the frames rendered; those after the last one are rendered again after a kill."""


@dataclass(frozen=True)
class Job:
    """One cell with its inputs.

    ``clip`` is the ground truth of every metric. ``adapted`` is the clip adapted to this method and
    condition, None if that is the clip itself. ``regions`` are evaluated besides the whole frame. ``source``
    is the cell whose avatar is used instead of training. ``config`` is that of the run. ``kept`` is a cache
    shared by the cells of a run. ``line`` shows the progress of the run. ``hidden``: the method runs in
    processes of its own that cannot read these folders; None for this process.
    """

    clip: Clip
    method: ResolvedMethod
    seed: int
    device: str
    cell: Cell
    protocols: Mapping[str, Protocol]
    adapted: AdaptedClip | None = None
    regions: tuple[str, ...] = ()
    condition: Condition = PLAIN
    source: Cell | None = None
    config: RunConfig | None = None
    line: RunProgress | None = None
    hidden: tuple[Path, ...] | None = None
    created: list[Any] = field(default_factory=list, repr=False, compare=False)
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def create(self) -> Any:
        """The `Method` of this cell, created when it is first asked for."""
        if not self.created:
            own = self.hidden is not None
            made = IsolatedMethod(self.method, self.cell.avatar, self.hidden or ()) if own else None
            self.created.append(made or self.method.create())
        return self.created[0]

    def check_unchanged(self) -> None:
        """Raise `ChangedInputError` if the clip in memory differs from when it was first given to a method."""
        clip = self.form.clip
        place = f"state of {id(clip)}"
        check_unchanged(clip, self.kept.setdefault(place, state_digest(clip)), self.label)

    def progress(self, step: str) -> AbstractContextManager[Progress]:
        """The progress of a step: of the run if the cell belongs to one, otherwise a separate one."""
        return self.line.step(self.name, step) if self.line else progress(f"{self.name}: {step}")

    @property
    def form(self) -> AdaptedClip:
        """The clip adapted to the method."""
        return self.adapted or AdaptedClip(self.clip)

    @property
    def name(self) -> str:
        return f"{self.clip.subject} {self.label} seed {self.seed}"

    @property
    def run(self) -> Path:
        """Folder of the run."""
        return self.cell.folder.parents[2]

    @property
    def follows(self) -> bool:
        """Whether its avatar is derived from that of another cell of the same run, which is worked on before."""
        return self.source is not None and self.source.folder.parents[2] == self.run

    @property
    def label(self) -> str:
        """Label of the method and its condition in tables and folder names."""
        return label_of(self.method.spec.name, self.condition.name)

    @property
    def fit_fingerprint(self) -> str:
        """Digest of everything the trained avatar depends on."""
        made_of = {**self.method.identity(), "name": self.label}
        derived = [asdict(self.condition.derive)] if self.condition.derive else []
        return digest(RESULT_FORMAT, made_of, self.seed, self.device, self.form.clip.fingerprint, *derived)

    @property
    def frame_paths(self) -> dict[Path, tuple[Protocol, FrameKey]]:
        """The frames to score, by the path of their renders."""
        return {
            self.cell.render(protocol.task, key): (protocol, key)
            for protocol in self.protocols.values()
            for key in protocol.keys
            if key.subject == self.clip.subject
        }

    def check(self) -> None:
        """Refuse a folder with an avatar from other inputs or other code, or with links that lead out of it.

        Damaged records of steps are removed, with a warning.
        """
        refuse_links(self.cell.folder)
        self.cell.drop_damaged_records()
        if self.source is not None and not self.follows:
            source_digest(self)
        state = self.cell.step("fit")
        if state is None or state.get("fingerprint") == self.fit_fingerprint:
            return
        file, remedy = self.cell.folder / "fit.json", f"Choose another --out, or delete {self.cell.folder}."
        code, earlier = (record.get("code") for record in (self.method.record(), state.get("method", {})))
        if is_outside(self.method.spec.implementation) and "method" in state and code != earlier:
            expected = f"{code}, the digest of the code of {self.method.spec.implementation}"
            found = "none: it was trained before the code of plug-ins was recorded"
            if earlier:
                found = f"{earlier}: the code of the plug-in has changed since its training {_age(state)}"
            raise InputError(file, "method, code", expected, found, remedy)
        raise InputError(
            file,
            "fingerprint",
            f"{self.fit_fingerprint[:12]}, that of this run's settings and data",
            f"{str(state.get('fingerprint'))[:12]}, an avatar of other settings, data, method version or code",
            remedy,
        )

    def check_method(self) -> None:
        """Let a method check that it can train and render, unless all steps are done."""
        method = self.create() if self.method.spec.implementation else None
        if isinstance(method, CheckedMethod) and not self.cell.is_done("measure", self.fit_fingerprint):
            method.check(TrainingView(self.form.clip), self.method.budget)


def steps_ahead(job: Job, metrics: Sequence[MetricSpec]) -> dict[str, str]:
    """The unfinished steps of a cell, each with the kind of cells of similar duration."""
    trained = job.cell.is_done("fit", job.fit_fingerprint)
    if trained and job.cell.is_done("measure", job.fit_fingerprint):
        return {}
    if job.condition.drive:
        return {} if stored_rows(job, metrics, retry=True) is not None else {RENDERING: job.label}
    method = job.label
    steps = {} if trained or job.source is not None else {TRAINING: method}
    steps[RENDERING] = method
    if any(spec.per_frame for spec in metrics):
        steps |= {f"measuring {task}": "" for task in job.protocols}
    if not all(spec.per_frame for spec in metrics):
        steps[MEASURING_AVATAR] = method
    return steps


def fit(job: Job) -> Avatar:
    """Train, resume training or read the trained avatar; return the avatar as read back from disk.

    A method can only read images of the training split. The recorded seconds start at the last of
    ``interruptions``. An avatar with damaged files is trained again, with a warning.
    """
    method = job.create()
    earlier = job.cell.step("fit")
    if earlier is not None and earlier["status"] == "done":
        damaged = job.cell.damage(earlier.get("files", {}))
        if damaged:
            _warn(job, damaged, "it is trained again")
            earlier = None
    if earlier is None and job.cell.avatar.exists():
        job.cell.set_aside(job.cell.avatar)  # it is damaged, or its inputs are unknown
    if earlier is None or earlier["status"] != "done":
        interruptions = 0 if earlier is None else earlier.get("interruptions", 0) + 1
        record = job.method.record()
        job.check_unchanged()
        use_device(job.device)  # before a record says that a training has begun
        job.cell.begin("fit", job.fit_fingerprint, interruptions=interruptions, method=record)
        if isinstance(method, PreparedMethod):
            method.prepare(job.device)
        start, processor = time.perf_counter(), processor_seconds()
        load = ProcessorLoad(job.device)
        with load, PeakMemory(job.device) as memory, job.progress(TRAINING) as report:
            try:
                _train(job, method, report)
            except InputError as error:
                kept = Path(error.file)
                if (
                    earlier is None
                    or not is_damage(error)
                    or not (job.cell.avatar in kept.parents and kept.is_file())
                ):
                    raise
                log.warning("%s: %s It is trained from the start.", job.name, error)
                job.cell.set_aside(job.cell.avatar)
                _train(job, method, report)
        seconds = time.perf_counter() - start
        job.check_unchanged()
        clip, budget = job.form.clip, asdict(job.method.budget)
        origin = {"seed": job.seed, "budget": budget, "capture": clip.fingerprint}
        write_avatar_record(job.cell.avatar, job.method, *shown_by(clip), "training", origin)
        job.cell.finish(
            "fit",
            job.fit_fingerprint,
            seconds=round(seconds, 3),
            processor_seconds=round(processor_seconds() - processor, 3),
            interruptions=interruptions,
            **({} if job.hidden is None else {"landlock": method.landlock}),
            peak_memory_bytes=memory.peak,
            memory_before_bytes=memory.before,
            **memory.device_record,
            load={"machine": load.machine, **load.details},
            method=record,
            finished_at=datetime.now(UTC).timestamp(),
            files=job.cell.digests(avatar_files(job.cell.avatar)),
        )
        log.info("%s: trained in %s", job.name, duration(seconds))
        write_losses(job)
    else:
        log_kept(job)
    avatar: Avatar = method.load(job.cell.avatar, device=job.device)
    return avatar


def write_losses(job: Job) -> None:
    """Write the losses of a training to ``losses.csv`` and, if it is installed, for TensorBoard into the cell's folder."""
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


def source_digest(job: Job) -> str:
    """Digest of the trained avatar of the job's ``source``.

    Raises `InputError` where there is none, and for one that was trained with other settings or on another capture.
    """
    assert job.source is not None
    state, path = job.source.step("fit"), job.source.folder / "fit.json"
    if state is None or state["status"] != "done":
        found = "none" if state is None else "one whose training did not end"
        raise InputError(path, "", "a trained avatar", found, "Start the run again.")
    own = json.loads(json.dumps(job.method.record()["config"]))
    if "config" in state.get("method", {}) and state["method"]["config"] != own:
        expected = "an avatar of the settings of this run"
        raise InputError(
            path, "method.config", expected, "one of other settings", "Give the settings of the source."
        )
    record = job.source.avatar / AVATAR_FILE
    capture = read_json(record).get("origin", {}).get("capture") if record.is_file() else None
    if capture not in (None, job.form.clip.fingerprint):
        raise InputError(record, "origin.capture", "an avatar of this capture", "one of another")
    return digest(state["fingerprint"], state.get("files"))


def _source_now(job: Job) -> str:
    """`source_digest`; "" where the cell of this run that the avatar is derived from has none yet."""
    try:
        return source_digest(job)
    except InputError:
        if not job.follows:
            raise
        return ""


def derive(job: Job) -> Avatar:
    """Use the avatar of the job's ``source``, or the one that the condition derives from it without training.

    Raises `InputError` if the source has no trained avatar.
    """
    assert job.source is not None
    derived_from = source_digest(job)
    change, clip = job.condition.derive, job.form.clip
    if change:
        make = resolve_change(change, "derive")
        avatar: Avatar = make(
            job.method.spec, job.source.avatar, job.cell.avatar, TrainingView(clip), job.device
        )
        origin = {"variant": job.condition.name, "of": derived_from}
        write_avatar_record(job.cell.avatar, job.method, *shown_by(clip), "variant", origin)
    else:
        avatar = job.create().load(job.source.avatar, device=job.device)
    files = job.cell.digests(path for path in job.cell.avatar.rglob("*") if path.is_file())
    job.cell.finish("fit", job.fit_fingerprint, derived_from=derived_from, files=files)
    return avatar


def drive(job: Job, avatar: Avatar) -> Rows:
    """Render and evaluate the avatar with the condition's change; write the rows and a record to the cell.

    The record has the details of the change, and digests of its files by their place in the run folder.
    """
    change = job.condition.drive
    with job.progress(RENDERING) as report:
        rows, details, files = resolve_change(change, "drive")(job, avatar, report)
    job.check_unchanged()
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
        RESULT_FORMAT, job.fit_fingerprint, asdict(change), code, source, _avatar_record(job), protocols
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
        _warn(job, damaged, "rendered again")
    return None if damaged or (retry and not rows.metrics_with_values) else rows


def log_kept(job: Job) -> None:
    """Log when the avatar of a finished training was trained; warn if the code of its method has changed since."""
    state = job.cell.step("fit")
    assert state is not None
    spec = job.method.spec
    log.info("%s: kept: trained %s, version %s", job.name, _age(state), spec.version)
    earlier = state.get("method", {}).get("code")
    if earlier and earlier != job.method.record().get("code"):
        package = spec.implementation.partition(":")[0].rpartition(".")[0]
        log.warning(
            "%s: the code of %s has changed since this avatar was trained. It is kept because the version is still %s. If "
            "the change affects results, raise the version in the spec, or delete %s to train it again.",
            *(job.name, package, spec.version, job.cell.folder),
        )


def _age(state: StepState) -> str:
    """How long ago a training ended; records of unfinished trainings have no time."""
    if "finished_at" not in state:
        return "in an earlier run"
    return f"{duration(max(0.0, datetime.now(UTC).timestamp() - state['finished_at']))} ago"


def _train(job: Job, method: Any, report: Progress) -> None:
    method.fit(
        TrainingView(job.form.clip),
        job.cell.avatar,
        job.method.budget,
        device=job.device,
        seed=job.seed,
        progress=report,
    )


def _warn(job: Job, damaged: Mapping[str, str], remedy: str) -> None:
    first, *more = (f"{job.cell.folder / name} {why}" for name, why in damaged.items())
    log.warning("%s: %s%s; %s", job.name, first, f", {len(more)} more are damaged" if more else "", remedy)


def render(job: Job, avatar: Avatar) -> None:
    """Render every frame of every protocol to 8-bit PNG of the protocol's size.

    Frames of this avatar are kept if they match their recorded digests. Damaged frames are rendered again,
    with a warning, as are frames without a record after an interruption.
    """
    cell, form = job.cell, job.form
    made_of = digest(job.fit_fingerprint, _avatar_record(job))
    state = cell.step(DIGESTS)
    known = {} if state is None or state["fingerprint"] != made_of else dict(state.get("files", {}))
    wanted = {cell.name(path): frame for path, frame in job.frame_paths.items()}
    damaged = cell.damage({name: known[name] for name in wanted if name in known})
    if damaged:
        _warn(job, damaged, "rendered again")
        known = {name: known[name] for name in known.keys() - damaged.keys()}
    missing = {name: frame for name, frame in wanted.items() if name not in known}
    if not missing and cell.is_done(DIGESTS, made_of):
        return
    recorded = time.monotonic()
    with job.progress(RENDERING) as report, grouped_writes():
        for index, (name, frame) in enumerate(_drawn(job, avatar, missing, report)):
            protocol, key = missing[name]
            camera = form.clip.cameras[form.key(key).camera]
            check_frame(frame, (camera.height, camera.width), job.name, key)
            written = write_png(cell.folder / name, quantise(form.restore(key, frame.rgb)))
            known[name] = hashlib.sha256(written).hexdigest()
            if time.monotonic() - recorded > RECORD_EVERY_S:
                cell.begin(DIGESTS, made_of, files=known)
                recorded = time.monotonic()
            report(index + 1, len(missing), protocol.task)
        job.check_unchanged()
        lacking = missing.keys() - known.keys()
        if lacking:
            first = missing[min(lacking)][1]
            raise InputError(job.name, str(first), "a render", f"none of it and {len(lacking) - 1} more")
        cell.finish(DIGESTS, made_of, files=dict(sorted(known.items())))


def _drawn(
    job: Job, avatar: Avatar, missing: Mapping[str, tuple[Protocol, FrameKey]], report: Progress
) -> Iterator[tuple[str, Frame]]:
    """Path and frame of each render: one by one, or by task if the avatar renders lists."""
    clip = job.form.clip
    views: dict[str, dict[FrameKey, tuple[str, tuple[Camera, HeadPose], Sequence[float]]]] = {}
    for name, (protocol, key) in missing.items():
        seen = job.form.key(key)
        view = clip.cameras[seen.camera], clip.poses[seen.timestep]
        if isinstance(avatar, ListedFrames):
            views.setdefault(protocol.task, {})[seen] = (name, view, protocol.background)
        else:
            yield name, avatar.render(*view, protocol.background)
    before = 0
    for task, listed in views.items():
        assert isinstance(avatar, ListedFrames)
        background = next(iter(listed.values()))[2]
        asked = {key: view for key, (_, view, _) in listed.items()}

        def drawing(done: int, total: int, note: str = "", task: str = task, before: int = before) -> None:
            report(before, len(missing), f"{task}, {done} of {total} drawn {note}")  # none of them read yet

        for key, frame in avatar.render_listed(asked, background, drawing):
            yield listed[key][0], frame
        before += len(listed)


def recorded_frames(job: Job) -> dict[str, str]:
    """SHA-256 of the rendered frames, by their path in the cell's folder."""
    state = job.cell.step(DIGESTS)
    return {} if state is None else state.get("files", {})


def trained_files(job: Job) -> Mapping[str, str]:
    """SHA-256 of the files of a cell's avatar, by their path in the cell's folder."""
    return _avatar_record(job)[1]


def _avatar_record(job: Job) -> tuple[str, Mapping[str, str]]:
    """What distinguishes trained avatars of the same settings."""
    state = job.cell.step("fit")
    return ("", {}) if state is None else (state.get("derived_from", ""), state.get("files", {}))


def measure(
    job: Job, avatar: Avatar, metrics: Sequence[MetricSpec], again: Sequence[MetricSpec] = ()
) -> Rows:
    """Evaluate the stored frames and the avatar as a whole; existing results are read back.

    Metrics of one implementation are one measurement and are read back or repeated together. A measurement
    with any value is read back; a failed one is repeated. Damaged rows are measured again, with a warning.
    Rows of metrics that are not requested stay in the cell's file, with the record of their inputs.

    Parameters
    ----------
    again : Sequence[MetricSpec]
        Metrics to measure again, a subset of ``metrics`` that concern the avatar as a whole; others that
        were already measured or tried are not. Former values stay in the record of the measurements,
        under ``earlier``.

    Raises
    ------
    UnavailableError
        A metric in ``again`` has a value but can no longer be measured; nothing is changed then.
    """
    known, details, old = _measured_before(job)
    repeated = {spec.implementation for spec in again}
    rendered = recorded_frames(job)
    earlier = {
        spec.name: old.select(method=ALL, condition=ALL, metric=spec.name, task=ALL, region=ALL, seeds=ALL)
        for spec in metrics
    }
    fingerprints = {spec.name: _measure_fingerprint(job, spec, rendered) for spec in metrics}
    had = {spec.implementation for spec in metrics if "ok" in set(earlier[spec.name]["status"])}
    new = {spec.implementation for spec in metrics if known.get(spec.name) != fingerprints[spec.name]}
    settled = ({spec.implementation for spec in metrics} if again else had) - new - repeated
    wanted = [spec for spec in metrics if spec.implementation not in settled]
    per_frame = [spec for spec in wanted if spec.per_frame]
    scored = [_score(job, per_frame, protocol) for protocol in job.protocols.values() if per_frame]
    measured: dict[str, Measurement | UnavailableError] = {}
    of_avatar = [spec for spec in wanted if not spec.per_frame]
    with job.progress(MEASURING_AVATAR) if of_avatar else nullcontext():
        for spec in of_avatar:
            if spec.implementation not in measured:
                measured[spec.implementation] = outcome = _measure_avatar(job, spec, avatar)
                if isinstance(outcome, UnavailableError) and spec.implementation in repeated & had:
                    raise outcome
                found = outcome.details.items() if isinstance(outcome, Measurement) else ()
                # JSON has only finite numbers; a metric with another value has its own row.
                details[spec.name] = {k: v for k, v in found if not isinstance(v, float) or math.isfinite(v)}
    job.check_unchanged()
    replaced = [spec.name for spec in metrics if spec.implementation in repeated & had]
    step = job.cell.step("measure")
    history = [] if step is None else [*step.get("earlier", [])]
    if replaced:
        history.append(_replaced(old.of_metrics(replaced)))
    record: dict[str, Any] = {"earlier": history} if history else {}
    parts: list[Rows] = []
    for spec in metrics:
        if spec not in wanted:
            parts.append(Rows(earlier[spec.name]))
        elif spec.per_frame:
            parts.append(Rows.of(row for of_protocol in scored for row in of_protocol[spec.name]))
        else:
            parts.append(Rows.of([_avatar_row(job, spec, measured[spec.implementation])]))
    result = Rows.joined(parts)
    if lost := result.values_lacking(old.of_metrics(replaced)):
        raise UnavailableError(
            f"The new measurement has no value of {lost[0]}, and the former has one.", "The former is kept."
        )
    others = sorted(old.metrics - fingerprints.keys())
    job.cell.begin("measure", job.fit_fingerprint, **record)  # interrupted between the rows and their record
    Rows.joined([result, old.of_metrics(others)] if others else [result]).write(job.cell.rows)
    job.cell.finish(
        "measure",
        job.fit_fingerprint,
        fingerprints=known | fingerprints,
        details=details,
        rows=digest_file(job.cell.rows),
        codec=avatar.codec if isinstance(avatar, CodedAvatar) else "",
        **record,
    )
    return result


def _replaced(rows: Rows) -> dict[str, Any]:
    """Record of the values of a cell before they are replaced, with the conditions of their measurement."""
    table = rows.select(method=ALL, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    table = table[table["status"] == "ok"]
    first = table.iloc[0]
    conditions = {name: first[name].item() for name in ("threads", "other_cores")}
    return {
        "replaced": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": str(first["machine"]),
        **{name: value for name, value in conditions.items() if math.isfinite(value)},
        "values": dict(zip(map(str, table["metric"]), map(float, table["value"]))),
    }


def stored_rows(job: Job, metrics: Sequence[MetricSpec], *, retry: bool = False) -> Rows | None:
    """Stored rows of a finished cell; None if something is missing, damaged or made from other inputs.

    ``retry``: failed measurements count as missing, so that they are repeated.
    """
    if job.condition.drive:
        return _driven_before(job, retry)
    fitted = job.cell.step("fit")
    made_of = digest(job.fit_fingerprint, _avatar_record(job))
    if job.source is not None and fitted is not None and fitted.get("derived_from") != _source_now(job):
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
    """Fingerprints and details of the measurements that were taken, by metric, and the rows."""
    step = job.cell.step("measure")
    if step is None or step["status"] != "done" or "rows" not in step:
        return {}, {}, Rows.of([])
    damaged = job.cell.damage({job.cell.name(job.cell.rows): step["rows"]})
    if damaged:
        _warn(job, damaged, "measured again")
        return {}, {}, Rows.of([])
    return step.get("fingerprints", {}), dict(step.get("details", {})), Rows.read(job.cell.rows)


def _measure_fingerprint(job: Job, spec: MetricSpec, rendered: Mapping[str, str]) -> str:
    """Digest of everything a metric's values depend on."""
    protocols = sorted(protocol.hash for protocol in job.protocols.values())
    regions = job.regions if spec.kind == "regional" else ()
    what: Any = _avatar_record(job)
    if spec.per_frame:
        what = {name: rendered.get(name) for name in map(job.cell.name, job.frame_paths)}
    metric: tuple[str, ...] = (spec.name, spec.implementation, spec.detail)
    if is_outside(spec.implementation):
        metric = (*metric, code_digest(spec.implementation))
    return digest(RESULT_FORMAT, job.fit_fingerprint, protocols, *metric, regions, what)


def reason_of(error: Exception) -> str:
    """Reason of a failed cell for its rows; running out of memory is always "out of memory"."""
    name, text = type(error).__name__, text_of(error)
    wanted = ("out of memory", "can't allocate memory", "cannot allocate memory")
    if isinstance(error, MemoryError) or name == "OutOfMemoryError" or any(w in text.lower() for w in wanted):
        return f"out of memory: {text or name}"
    return f"{name}: {text}"


def failed_rows(job: Job, metrics: Sequence[MetricSpec], reason: str) -> Rows:
    """Rows that show a failed cell as failed, with its reason."""
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

    ``size`` is the (width, height) that the cameras are brought to, None for their own.
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
    """Reason of a row whose value is too good to be true, "" for any other."""
    if spec.suspect_above is None or score.region != FULL or not score.value > spec.suspect_above:
        return ""
    return f"{SUSPECT}above {spec.suspect_above:g} {spec.unit}"


def _measure_avatar(job: Job, spec: MetricSpec, avatar: Avatar) -> Measurement | UnavailableError:
    metric = make_metric(spec)
    try:
        if spec.kind == "training":
            return metric(job.cell.step("fit") or {})  # type: ignore[no-any-return]
        pairs = workload(job.form, job.protocols, job.method.spec.resolution.speed_size)
        if not spec.machine_bound:
            return metric(avatar, pairs)  # type: ignore[no-any-return]
        with ProcessorLoad(job.device, wait=True) as load:
            if isinstance(avatar, IsolatedAvatar):
                found = avatar.measured(metric, pairs)
            else:
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
    return replace(_row(job, spec, value=value, status="ok"), **_conditions(job, spec, outcome.details))


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
