"""Runs a comparison: checks everything, then fits, renders and measures cell by cell, then reports."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..contracts import Avatar, CheckedMethod, Clip
from ..errors import HeadbenchError, InputError, UnavailableError
from ..executors.outcome import outcome_path
from ..executors.settings import Execution, check_executor
from ..io.files import atomic_path, check_kind, check_output_folder, output_inside
from ..io.lock import locked
from ..machine import check_device_answers, machine_record, peak_memory_bytes
from ..manifest import AdaptedRecord, ClipRecord, Manifest, MethodRecord, ProtocolRecord
from ..progress import duration, run_progress
from ..protocol import Protocol, make_protocols, missing_tasks
from ..registry import discover, get, resolve
from ..rows import Rows
from ..specs import DatasetSpec, MetricSpec
from . import adaptation
from .adaptation import AdaptedClip, MethodNeeds
from .captures import open_clips, open_run_clips, relative_paths, run_configuration
from .config import ResolvedMethod, RunConfig, RunOptions, resolve_methods, resolve_metrics
from .scoring import check_regions, make_metric
from .steps import Job, failed_rows, fit, measure, reason_of, render, steps_ahead
from .store import RunFolder

log = logging.getLogger(__name__)


def run(
    config: RunConfig, execution: Execution | None = None, *, unchecked: bool = False, **record: Any
) -> Rows:
    """Run a comparison into ``config.out`` and return its rows; ``record`` is added to the manifest.

    ``execution`` says where its cells are executed, None for this process. ``unchecked`` trains although a capture has an
    error that makes results meaningless (see `DatasetSpec.errors`).

    Everything that can be checked is checked before the first long step: settings, device, methods, captures, the
    output folder, and that no other process works in it. A method that fails is recorded as failed and the others
    go on. Started again with the same configuration after a kill, it keeps what is done and continues what is not.
    """
    methods, metrics = resolve_methods(config), resolve_metrics(config)
    execution = execution or Execution()
    check_executor(execution, config.device)
    folder = RunFolder(Path(config.out))
    check_kind(folder.root, "a run")
    check_output_folder(folder.root)
    start = time.perf_counter()
    with locked(folder.root):
        rows = _run(config, methods, metrics, folder, execution, unchecked, record)
        write_reports(folder.root)  # with the captures gone from memory
    log.info("finished in %s: %s", duration(time.perf_counter() - start), folder.root)
    return rows


def _run(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    metrics: Sequence[MetricSpec],
    folder: RunFolder,
    execution: Execution,
    unchecked: bool,
    record: Mapping[str, Any],
) -> Rows:
    start = time.perf_counter()
    for method in methods:
        method.create()  # an implementation that cannot be imported or made is not to be found out hours later
    clips = open_clips(config)
    for method in methods:
        cells = [folder.cell(clip.subject, method.spec.name, seed) for clip in clips for seed in config.seeds]
        if not all(cell.ended("measure") for cell in cells):
            check_settings(method)
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    planned = describe(config, methods, metrics, clips, protocols)
    folder.check_kept(planned)
    jobs = make_jobs(config, methods, clips, protocols, folder)
    for job in jobs:
        job.check()
        job.check_method()
    warn_of_missing_metrics(metrics, clips[0])
    if not unchecked:
        for clip in {job.clip.subject: job.clip for job in jobs if not job.cell.ended("fit")}.values():
            check_capture(config, clip)

    forms = tuple(
        AdaptedRecord(**adaptation.record(job.clip, job.adapted, job.method.spec.name))
        for job in jobs
        if job.adapted is not None and job.seed == config.seeds[0]
    )
    manifest = replace(planned, adapted=forms, **record)
    manifest.write(folder.manifest)
    for reason in missing_tasks(config.tasks, protocols).values():
        log.warning("%s", reason)
    for protocol in protocols.values():
        log.info("%s, protocol %s: %d frames", protocol.task, protocol.hash, len(protocol.keys))
    if execution.executor == "inline":
        rows = run_jobs(jobs, metrics)
    else:
        from ..executors.run import execute, machine_of

        rows = execute(jobs, metrics, folder, execution)
        manifest = replace(manifest, machine=dict(machine_of(jobs, manifest.machine)))
    folder.write_rows(rows)
    folder.speed_pass.unlink(missing_ok=True)
    seconds = round(time.perf_counter() - start, 3)
    done = replace(manifest, status="done", seconds=seconds, peak_memory_bytes=peak_memory_bytes())
    done.write(folder.manifest)
    return rows


def check_settings(method: ResolvedMethod) -> None:
    """Let a method that can tell refuse its settings before anything is made that takes long."""
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


def make_jobs(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
    folder: RunFolder,
    out: Path | None = None,
) -> list[Job]:
    """Make the cells of a comparison, each clip in the form that its method needs; first make sure that all can be had.

    Parameters
    ----------
    folder : run folder of the cells.
    out : where to keep what took long in adapting clips, its lock is held; what ``folder`` kept is copied there first,
        since nothing is written in a run by what looks at it. None: ``folder`` itself.
    """
    regions = {clip.subject: check_regions(clip, config.regions) if protocols else () for clip in clips}
    adapted = _adapt(clips, methods, config, folder, RunFolder(out or folder.root))
    return [
        Job(
            clip,
            method,
            seed,
            config.device,
            folder.cell(clip.subject, method.spec.name, seed),
            protocols,
            adapted.get((clip.subject, MethodNeeds.of(method.spec))),
            regions[clip.subject],
        )
        for clip in clips
        for method in methods
        for seed in config.seeds
    ]


def _adapt(
    clips: Sequence[Clip],
    methods: Sequence[ResolvedMethod],
    config: RunConfig,
    run: RunFolder,
    out: RunFolder,
) -> dict[tuple[str, MethodNeeds], AdaptedClip]:
    """Bring every clip into every form that a method needs, once each."""
    planned = {}
    for clip in clips:
        for needs in {MethodNeeds.of(method.spec): None for method in methods}:
            step = adaptation.plan(clip, needs, config.heads)
            if step is not None:
                planned[clip.subject, needs] = step
    with output_inside(out.root):
        if out.root != run.root:
            for subject in {subject for subject, _ in planned}:
                _copy_kept(run.adapted / subject, out.adapted / subject)
        return {
            (subject, needs): adaptation.carry_out(step, needs, out.adapted / subject, f"adapting {subject}")
            for (subject, needs), step in planned.items()
        }


def _copy_kept(source: Path, folder: Path) -> None:
    """Copy the files that are not in ``folder`` yet; never what a link leads to, for the run may come from anybody."""
    if source.is_symlink() or source.parent.is_symlink():
        return
    for path in sorted(source.rglob("*")):
        target = folder / path.relative_to(source)
        if path.is_file() and not path.is_symlink() and not target.exists():
            with atomic_path(target) as temporary:
                shutil.copyfile(path, temporary)


def run_jobs(jobs: Sequence[Job], metrics: Sequence[MetricSpec]) -> Rows:
    """Fit, render and measure cell by cell, under one line of progress; a cell that fails has failed rows."""
    with run_progress({job.name: steps_ahead(job, metrics) for job in jobs}) as line:
        return Rows.joined([_run_cell(replace(job, line=line), metrics) for job in jobs])


def _run_cell(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    log.info("%s", job.name)
    outcome_path(job.cell.folder).unlink(missing_ok=True)  # of a process or a job that worked on it earlier
    try:
        avatar = fit(job)
        render(job, avatar)
        return measure(job, avatar, metrics)
    except HeadbenchError as error:
        log.error("%s failed: %s", job.name, error)
        return failed_rows(job, metrics, reason_of(error))
    except Exception as error:
        log.exception("%s failed", job.name)
        check_device_answers(job.device)
        return failed_rows(job, metrics, reason_of(error))


def warn_of_missing_metrics(metrics: Sequence[MetricSpec], clip: Clip) -> None:
    """Say before the training, not after it, which metric cannot be had."""
    image = clip.image(clip.splits["train"][0])
    for spec in metrics:
        metric = make_metric(spec)
        if not spec.per_frame:
            continue
        try:
            value = metric(image, image, image, image) if spec.kind == "temporal" else metric(image, image)
        except UnavailableError as error:
            log.warning("%s will be missing: %s", spec.label, error)
        else:
            if not np.isfinite(value):
                raise HeadbenchError(f"metric {spec.name} gives {value} for identical images")


def check_capture(config: RunConfig, clip: Clip) -> None:
    """Raise `InputError` for an error of a capture that makes every result meaningless, as `DatasetSpec.errors` finds it."""
    spec: DatasetSpec = get("datasets", config.reader)
    found = resolve(spec.errors)(clip) if spec.errors else []
    if found:
        raise InputError(
            config.data,
            f"capture of {clip.subject}",
            "a capture on which avatars can be trained",
            " ".join(found),
            "`headbench lint` shows more; `headbench run --unchecked` trains all the same.",
        )


def describe(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    metrics: Sequence[MetricSpec],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
) -> Manifest:
    """The manifest of a run that starts."""
    return Manifest(
        configuration=config,
        paths=relative_paths(config),
        methods=tuple(MethodRecord(**method.record()) for method in methods),
        metrics=tuple(metrics),
        clips=tuple(
            ClipRecord(
                subject=clip.subject,
                fingerprint=clip.fingerprint,
                steps=[asdict(step) for step in clip.steps],
                splits={name: len(keys) for name, keys in clip.splits.items()},
                excluded={str(key): reason for key, reason in sorted(clip.excluded.items())},
            )
            for clip in clips
        ),
        protocols={task: ProtocolRecord.of(protocol) for task, protocol in protocols.items()},
        machine=machine_record(config.device),
    )


def trained(
    run: Path, methods: Sequence[str], options: RunOptions, out: Path, only: int | None = None
) -> tuple[RunConfig, list[Job]]:
    """Return the settings of a run and its cells whose avatar is trained; `load` reads one.

    Parameters
    ----------
    run : folder of the run.
    methods : names of those wanted; empty: all but the trivial baselines, which nothing can drive to extremes.
    options : where the run's files are now.
    out : folder to keep clips in that methods need in another form; its lock is held. It becomes ``out`` of the settings.
    only : see `open_clips`.

    Raises
    ------
    InputError
        For a method that the run does not have, a capture that is not the one trained on, an avatar that is not
        there or whose training did not end, and a run without any avatar to look at.
    """
    folder = RunFolder(run)
    resolved = resolve_methods(run_configuration(run, options))
    names = [method.spec.name for method in resolved]
    for name in methods:
        if name not in names:
            raise InputError(folder.manifest, "methods", ", ".join(names), name)
    wanted = [m for m in resolved if (m.spec.name in methods if methods else not m.spec.trivial)]
    if not wanted:
        raise InputError(folder.manifest, "methods", "a method that is no trivial baseline", ", ".join(names))
    config, clips = open_run_clips(run, options, out=out, only=only)
    jobs = make_jobs(config, wanted, clips, {}, folder, out)
    for job in jobs:
        state = job.cell.step("fit")
        if state is None or state.get("status") != "done":
            found = "none" if state is None else "one whose training did not end"
            raise InputError(job.cell.folder, "fit.json", "a trained avatar", found, "Start the run again.")
    return config, jobs


def load(job: Job) -> Avatar:
    """Read the avatar of a cell."""
    avatar: Avatar = job.method.create().load(job.cell.avatar, device=job.device)
    return avatar
