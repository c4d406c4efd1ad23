"""Runs a comparison: checks everything, then fits, renders and measures cell by cell, then reports."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..condition import Condition, label_of
from ..contracts import CheckedMethod, Clip
from ..errors import (
    HeadbenchError,
    InputError,
    LeftOutError,
    UnavailableError,
    is_damage,
    reason_of,
)
from ..executors.outcome import outcome_path
from ..executors.settings import Execution, check_executor
from ..io.files import check_kind, check_output_folder
from ..io.lock import locked
from ..machine import check_device_answers, machine_record, peak_memory_bytes
from ..manifest import AdaptedRecord, ClipRecord, Manifest, MethodRecord, ProtocolRecord
from ..progress import counted, duration, run_progress
from ..protocol import TASK_TITLES, Protocol, make_protocols, missing_tasks
from ..registry import discover, get, resolve
from ..rows import DISCARD, Rows
from ..specs import ConditionSpec, DatasetSpec, MetricSpec
from . import adaptation
from .captures import open_clips, relative_paths
from .config import ResolvedMethod, RunConfig, resolve_cells, resolve_metrics
from .job import Job
from .jobs import make_jobs, run_cell, steps_ahead
from .measuring import failed_rows
from .scoring import compared_over_time, make_metric
from .store import RunFolder
from .tasks import execute, machine_of
from .trust import PROGRAMS, check_trusted, names_of, programs

log = logging.getLogger(__name__)
RunCell = Callable[[Job, Sequence[MetricSpec]], Rows]


def run(
    config: RunConfig,
    execution: Execution | None = None,
    *,
    unchecked: bool = False,
    clips: Sequence[Clip] | None = None,
    reports: bool = True,
    **record: Any,
) -> Rows:
    """Run the cells of a configuration into ``config.out`` and return the rows of the whole folder.

    Everything that can be checked is checked before the first long step: settings, device, methods, captures,
    the output folder, and that no other process uses it. A method that fails is recorded as failed and the
    others continue. A restart with the same configuration keeps finished steps and resumes the others. In a
    folder with other methods, seeds, metrics, conditions or frames it adds the new ones, see `grown`.

    Parameters
    ----------
    execution : Execution, optional
        How to execute the cells. Default: sequentially in this process.
    unchecked : bool
        Do not search the captures for errors that change results (see `DatasetSpec.errors`). A run is
        continued without a search, too.
    clips : Sequence[Clip], optional
        Captures of the configuration, if they are already open.
    reports : bool
        Write the registered reports at the end.
    record : Any
        Values to add to the manifest.
    """
    check_kind(Path(config.out), "a run")
    check_output_folder(Path(config.out))
    with locked(Path(config.out)):
        return run_locked(config, execution, unchecked=unchecked, clips=clips, reports=reports, **record)


def run_locked(
    config: RunConfig,
    execution: Execution | None = None,
    *,
    unchecked: bool = False,
    clips: Sequence[Clip] | None = None,
    cells: Sequence[tuple[ResolvedMethod, Condition]] | None = None,
    metrics: Sequence[MetricSpec] | None = None,
    each: RunCell | None = None,
    trust: bool = False,
    reports: bool = True,
    **record: Any,
) -> Rows:
    """Run the cells of a configuration like `run`, in a folder that the caller has locked.

    Parameters
    ----------
    cells, metrics : sequence, optional
        Resolved cells and metrics, if the configuration does not name them; they require ``each``.
    each : callable, optional
        Executes a cell in this process, instead of `run_cell`.
    trust : bool
        Import modules and run programs that only a run in the folder names.
    """
    start = time.perf_counter()
    folder = RunFolder(Path(config.out))
    config = grown(config, folder, trust=trust) if cells is None else config
    cells = resolve_cells(config) if cells is None else cells
    metrics = resolve_metrics(config) if metrics is None else metrics
    execution = execution or Execution()
    check_executor(execution, config.device)
    rows = _run(config, cells, metrics, folder, execution, clips, each or run_cell, unchecked, record)
    if reports:
        log.info("writing tables, pictures and the report")
        write_reports(folder.root)  # after the captures were freed
    log.info("finished in %s: %s", duration(time.perf_counter() - start), folder.root)
    return rows


def _run(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    folder: RunFolder,
    execution: Execution,
    clips: Sequence[Clip] | None,
    each: RunCell,
    unchecked: bool,
    record: Mapping[str, Any],
) -> Rows:
    start = time.perf_counter()
    clips = open_clips(config) if clips is None else clips
    planned, protocols, jobs = _planned(config, cells, metrics, folder, clips)
    known: set[str] = set()
    with suppress(InputError):  # of a new run, or of one whose record is damaged
        earlier = folder.read_manifest()
        known = {clip.fingerprint for clip in earlier.clips}
        if earlier.unchecked and not unchecked:
            unchecked = True
            log.warning("The captures are not searched for errors, as this run was begun with --unchecked.")
    if not config.drive:
        warn_of_missing_metrics(metrics, clips[0])
    if not unchecked and not config.source:
        for clip in {job.clip.subject: job.clip for job in jobs if not job.cell.ended("fit")}.values():
            if clip.fingerprint not in known:
                check_capture(config, clip)

    forms = tuple(
        AdaptedRecord(**adaptation.record(job.clip, job.adapted, job.label))
        for job in jobs
        if job.adapted is not None and job.seed == config.seeds[0]
    )
    manifest = replace(planned, adapted=forms, unchecked=unchecked or None, **record)
    manifest.write(folder.manifest)
    for reason in {} if config.drive else missing_tasks(config.tasks, protocols).values():
        log.warning("%s", reason)
    for protocol in protocols.values():
        log.info("%s: %d frames to score", TASK_TITLES[protocol.task], len(protocol.keys))
    if execution.executor == "inline":
        rows = run_jobs(jobs, metrics, each)
    else:
        rows = execute(jobs, metrics, folder, execution)
        manifest = replace(manifest, machine=dict(machine_of(jobs, manifest.machine)))
    folder.write_rows(rows)
    folder.speed_pass.unlink(missing_ok=True)
    seconds = round(time.perf_counter() - start, 3)
    methods = tuple(replace(method, codec=_codec(method.label, jobs)) for method in manifest.methods)
    manifest = replace(manifest, methods=methods)
    done = replace(manifest, status="done", seconds=seconds, peak_memory_bytes=peak_memory_bytes())
    done.write(folder.manifest)
    return rows


def _codec(label: str, jobs: Sequence[Job]) -> str | None:
    """Codecs of the measured avatars of a method and condition, see `MethodRecord`."""
    steps = [job.cell.step("measure") for job in jobs if job.label == label]
    found = {str(step["codec"]) for step in steps if step is not None and "codec" in step}
    return "; ".join(sorted(found)) if found else None


def _planned(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    folder: RunFolder,
    clips: Sequence[Clip],
    out: Path | None = None,
) -> tuple[Manifest, dict[str, Protocol], list[Job]]:
    """The record, the protocols and the cells of a run, all checked; ``out`` as for `make_jobs`."""
    for method, condition in cells:
        places = product([clip.subject for clip in clips], config.seeds)
        label = label_of(method.spec.name, condition.name)
        if not all(folder.cell(s, label, seed).ended("measure") for s, seed in places):
            check_settings([(method, condition)])
    if config.drive:
        driven = make_jobs(config, cells, clips, {}, folder, out)
        spec: ConditionSpec = get("conditions", config.drive.name)
        protocols: dict[str, Protocol] = resolve(spec.protocols)(driven, **config.drive.parameters)
    else:
        protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    planned = describe(config, cells, metrics, clips, protocols)
    folder.check_kept(planned)
    jobs = make_jobs(config, cells, clips, protocols, folder, out)
    for job in jobs:
        job.check()
        job.check_method()
    return planned, protocols, jobs


def planned_cells(config: RunConfig) -> dict[str, str]:
    """State of each cell that `run` would execute, with the same checks: done, trained, to train or to derive.

    Nothing is written into ``config.out``.
    """
    folder = RunFolder(Path(config.out))
    config = grown(config, folder)
    with TemporaryDirectory() as scratch:
        clips = open_clips(replace(config, out=scratch))
        metrics = resolve_metrics(config)
        forms = replace(config, out=scratch)
        jobs = _planned(forms, resolve_cells(config), metrics, folder, clips, Path(scratch))[2]
    return {job.name: _state(job) for job in jobs}


def _state(job: Job) -> str:
    if not job.cell.is_done("fit", job.fit_fingerprint):
        return "to train" if job.source is None else "to derive"
    return "done" if job.cell.ended("measure") else "trained"


def grown(config: RunConfig, folder: RunFolder, *, trust: bool = False) -> RunConfig:
    """The configuration extended by methods, seeds, tasks, metrics, conditions of the run in the folder.

    Raises `InputError` if a setting that determines the results of all cells differs.
    """
    if not folder.rows.is_file() or not folder.manifest.is_file():
        return config
    try:
        earlier = folder.read_manifest().configuration
    except InputError as error:
        if not is_damage(error):
            raise
        log.warning("%s It is written again.", error)
        return config  # rows that would be lost are an error when they are written
    _check_additions(earlier, config, folder.manifest, trust=trust)
    before = product(earlier.methods, earlier.seeds)
    asked = product(config.methods, config.seeds)
    every = product({*earlier.methods, *config.methods}, {*earlier.seeds, *config.seeds})
    if more := sorted({*every} - {*before} - {*asked}):
        text = ", ".join(f"{method} seed {seed}" for method, seed in more)
        log.warning("A run has every method with every seed; this one gets %s, too.", text)
    source = (folder.read_manifest().paths or {}).get("source")
    places = [earlier.source, *([] if source is None else [str(folder.root / source)])]
    for name in ("preset", "device", "divide", "clip", "source", "drive"):
        then, now = getattr(earlier, name), getattr(config, name)
        if then != now and not (name == "source" and any(_same_place(place, now) for place in places)):
            raise InputError(
                folder.manifest, f"configuration.{name}", f"{then}, as in this run", str(now), DISCARD
            )
    union: dict[str, Any] = {
        name: tuple(dict.fromkeys((*getattr(earlier, name), *getattr(config, name))))
        for name in ("methods", "seeds", "tasks", "metrics", "metric_profiles")
    }
    named = {condition.name: condition for condition in (*earlier.conditions, *config.conditions)}
    for condition in config.conditions:
        before_methods = {c.name: c.methods for c in earlier.conditions}.get(condition.name)
        if before_methods is not None:
            both = () if () in (before_methods, condition.methods) else (*before_methods, *condition.methods)
            named[condition.name] = replace(condition, methods=tuple(dict.fromkeys(both)))
    # Methods named in this call use the settings of this call, which may contain programs.
    asked_names = {get("methods", name).name for name in config.methods}
    others = {name: values for name, values in earlier.settings.items() if name not in asked_names}
    frames = (earlier.frames_per_task, config.frames_per_task)
    return replace(
        config,
        **union,
        conditions=tuple(named.values()),
        settings={**others, **config.settings},
        frames_per_task=None if None in frames else max(frames),  # type: ignore[type-var]
    )


def _check_additions(earlier: RunConfig, config: RunConfig, manifest: Path, *, trust: bool) -> None:
    """Apply `check_trusted` to what only the run in the folder names."""
    known = {condition.name for condition in config.conditions}
    others = [condition for condition in earlier.conditions if condition.name not in known]
    named, given = names_of(earlier, others), names_of(config)
    del named["reader"]  # that of this call is used
    check_trusted(manifest, named, given, trust=trust)
    # Settings of a condition may name another program of a method in this call.
    more = config.methods if any(condition.settings for condition in others) else ()
    added = [name for name in earlier.methods if name not in config.methods]
    check_trusted(manifest, {PROGRAMS: programs([*added, *more])}, trust=trust)


def _same_place(first: str, second: str) -> bool:
    return bool(first and second) and Path(first).resolve() == Path(second).resolve()


def check_settings(cells: Iterable[tuple[ResolvedMethod, Condition]]) -> None:
    """Create the method of each cell, so that its settings are checked before any long step.

    Raises `InputError` for settings that a method refuses, and whatever importing or creating it raises.
    """
    for method, _ in cells:
        if not method.spec.implementation:
            continue  # a folder of images
        made = method.create()
        if isinstance(made, CheckedMethod):
            made.check(None, method.budget)


def write_reports(run_folder: Path) -> list[Path]:
    """Write every registered report of a finished run. One that fails is logged and the others are written."""
    written: list[Path] = []
    for name, plugin in discover("reports").items():
        if plugin.spec is None:
            log.warning("report %r of %s is broken: %s", name, plugin.origin, plugin.error)
        elif plugin.spec.writes:
            try:
                written += resolve(plugin.spec.implementation)(run_folder)
            except (HeadbenchError, OSError) as error:
                log.error("report %r of %s failed: %s; the rows are complete", name, plugin.origin, error)
            except Exception:
                log.exception("report %r of %s failed; the rows are complete", name, plugin.origin)
    return written


def run_jobs(jobs: Sequence[Job], metrics: Sequence[MetricSpec], each: RunCell) -> Rows:
    """Execute each cell, with one progress line; a cell that fails has failed rows."""
    with run_progress({job.name: steps_ahead(job, metrics) for job in jobs}) as line:
        return Rows.joined([_run_inline(replace(job, line=line), metrics, each) for job in jobs])


def _run_inline(job: Job, metrics: Sequence[MetricSpec], each: RunCell) -> Rows:
    log.info("%s", job.name)
    outcome_path(job.cell.folder).unlink(missing_ok=True)  # left by an earlier process or job
    try:
        return each(job, metrics)
    except HeadbenchError as error:
        log.error("%s failed: %s", job.name, error)
        return failed_rows(job, metrics, reason_of(error))
    except Exception as error:
        log.exception("%s failed", job.name)
        check_device_answers(job.device)
        return failed_rows(job, metrics, reason_of(error))
    finally:
        job.created.clear()  # so that a run does not keep every method in memory


def warn_of_missing_metrics(metrics: Sequence[MetricSpec], clip: Clip) -> None:
    """Report unavailable metrics before the training."""
    image = clip.image(clip.splits["train"][0])
    for spec in metrics:
        metric = make_metric(spec)
        if not spec.per_frame:
            continue
        try:
            value = compared_over_time(metric, spec.kind)(image, image)
        except LeftOutError:
            continue
        except UnavailableError as error:
            log.warning("%s will be missing: %s", spec.label, error)
        else:
            if not np.isfinite(value):
                raise HeadbenchError(f"metric {spec.name} gives {value} for identical images")


def check_capture(config: RunConfig, clip: Clip) -> None:
    """Raise `InputError` for errors of a capture that change results, see `DatasetSpec.errors`."""
    spec: DatasetSpec = get("datasets", config.reader)
    found = resolve(spec.errors)(clip) if spec.errors else []
    if found:
        raise InputError(
            config.data,
            f"capture of {clip.subject}",
            "a capture without errors that change results",
            found[0].rstrip(".") + (f"; and {counted(len(found) - 1, 'other error')}" if found[1:] else ""),
            "`headbench lint` shows more; `headbench run --unchecked` trains all the same.",
        )


def describe(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
) -> Manifest:
    """Create the manifest of a new run."""
    return Manifest(
        configuration=config,
        paths=relative_paths(config),
        methods=tuple(
            MethodRecord(**method.record(), condition=condition.name) for method, condition in cells
        ),
        metrics=tuple(metrics),
        clips=tuple(
            ClipRecord(
                subject=clip.subject,
                fingerprint=clip.fingerprint,
                steps=[asdict(step) for step in clip.steps],
                splits={name: len(keys) for name, keys in clip.splits.items()},
                excluded={str(key): reason for key, reason in sorted(clip.excluded.items())},
                training_cameras=tuple(sorted({key.camera for key in clip.splits.get("train", ())})),
            )
            for clip in clips
        ),
        protocols={task: ProtocolRecord.of(protocol) for task, protocol in protocols.items()},
        machine=machine_record(config.device),
    )
