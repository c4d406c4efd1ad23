"""Runs a comparison: checks everything, then fits, renders and measures cell by cell, then reports."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..condition import Condition, label_of
from ..contracts import Avatar, CheckedMethod, Clip
from ..errors import HeadbenchError, InputError, UnavailableError, is_damage
from ..executors.outcome import outcome_path
from ..executors.settings import Execution, check_executor
from ..io.files import atomic_path, check_kind, check_output_folder, digest, output_inside
from ..io.lock import locked
from ..machine import check_device_answers, machine_record, peak_memory_bytes
from ..manifest import AdaptedRecord, ClipRecord, Manifest, MethodRecord, ProtocolRecord
from ..progress import duration, run_progress
from ..protocol import Protocol, make_protocols, missing_tasks, protocol_name
from ..registry import discover, get, resolve
from ..rows import DISCARD, Rows
from ..specs import ConditionSpec, DatasetSpec, MetricSpec
from . import adaptation
from .adaptation import AdaptedClip, MethodNeeds
from .captures import changed, open_clips, open_run_clips, relative_paths, run_configuration
from .config import ResolvedMethod, RunConfig, RunOptions, resolve_cells, resolve_metrics
from .scoring import check_regions, make_metric
from .steps import Job, derive, drive, failed_rows, fit, measure, reason_of, render, steps_ahead, stored_rows
from .store import RunFolder

log = logging.getLogger(__name__)


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

    Everything that can be checked is checked before the first long step: settings, device, methods, captures, the
    output folder, and that no other process works in it. A method that fails is recorded as failed and the others
    go on. Started again with the same configuration after a kill, it keeps what is done and continues what is not. In a
    folder that has other methods, seeds, metrics, conditions or frames it adds what is new, see `grown`.

    Parameters
    ----------
    execution : Execution, optional
        Where the cells are executed. Default: one after another in this process.
    unchecked : bool
        Train although a capture has an error that makes results meaningless (see `DatasetSpec.errors`).
    clips : sequence of Clip, optional
        The captures of the configuration, if they are open already.
    reports : bool
        Write the registered reports at the end.
    record : Any
        Added to the manifest.
    """
    resolve_cells(config)  # before a folder is made
    resolve_metrics(config)
    check_executor(execution or Execution(), config.device)
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
    reports: bool = True,
    **record: Any,
) -> Rows:
    """Run the cells of a configuration as `run` does, into a folder whose lock is held."""
    start = time.perf_counter()
    folder = RunFolder(Path(config.out))
    config = grown(config, folder)
    cells, metrics = resolve_cells(config), resolve_metrics(config)
    execution = execution or Execution()
    check_executor(execution, config.device)
    rows = _run(config, cells, metrics, folder, execution, clips, unchecked, record)
    if reports:
        write_reports(folder.root)  # with the captures gone from memory
    log.info("finished in %s: %s", duration(time.perf_counter() - start), folder.root)
    return rows


def _run(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    folder: RunFolder,
    execution: Execution,
    clips: Sequence[Clip] | None,
    unchecked: bool,
    record: Mapping[str, Any],
) -> Rows:
    start = time.perf_counter()
    clips = open_clips(config) if clips is None else clips
    for method, condition in cells:
        places = product([clip.subject for clip in clips], config.seeds)
        label = label_of(method.spec.name, condition.name)
        if not all(folder.cell(subject, label, seed).ended("measure") for subject, seed in places):
            check_settings([(method, condition)])
    if config.drive:
        driven = make_jobs(config, cells, clips, {}, folder)
        spec: ConditionSpec = get("conditions", config.drive.name)
        protocols: dict[str, Protocol] = resolve(spec.protocols)(driven, **config.drive.parameters)
    else:
        protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    planned = describe(config, cells, metrics, clips, protocols)
    folder.check_kept(planned)
    jobs = make_jobs(config, cells, clips, protocols, folder)
    for job in jobs:
        job.check()
        job.check_method()
    if not config.drive:
        warn_of_missing_metrics(metrics, clips[0])
    if not unchecked and not config.source:
        for clip in {job.clip.subject: job.clip for job in jobs if not job.cell.ended("fit")}.values():
            check_capture(config, clip)

    forms = tuple(
        AdaptedRecord(**adaptation.record(job.clip, job.adapted, job.label))
        for job in jobs
        if job.adapted is not None and job.seed == config.seeds[0]
    )
    manifest = replace(planned, adapted=forms, **record)
    manifest.write(folder.manifest)
    for reason in {} if config.drive else missing_tasks(config.tasks, protocols).values():
        log.warning("%s", reason)
    for protocol in protocols.values():
        log.info("%s, protocol %s: %d frames", protocol.task, protocol.hash, len(protocol.keys))
    if execution.executor == "inline":
        rows = run_jobs(jobs, metrics)
    else:
        from .tasks import execute, machine_of

        rows = execute(jobs, metrics, folder, execution)
        manifest = replace(manifest, machine=dict(machine_of(jobs, manifest.machine)))
    folder.write_rows(rows)
    folder.speed_pass.unlink(missing_ok=True)
    seconds = round(time.perf_counter() - start, 3)
    done = replace(manifest, status="done", seconds=seconds, peak_memory_bytes=peak_memory_bytes())
    done.write(folder.manifest)
    return rows


def grown(config: RunConfig, folder: RunFolder) -> RunConfig:
    """The configuration together with what the run in the folder has already: methods, seeds, tasks, metrics, conditions.

    Raises `InputError` where a setting of both, which decides results of all cells, has another value.
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
    for name in ("preset", "device", "divide", "clip", "source"):
        before, now = getattr(earlier, name), getattr(config, name)
        if before != now and not (name == "source" and _same_place(before, now)):
            raise InputError(
                folder.manifest, f"configuration.{name}", f"{before}, as in this run", str(now), DISCARD
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
    frames = (earlier.frames_per_task, config.frames_per_task)
    return replace(
        config,
        **union,
        conditions=tuple(named.values()),
        settings={**earlier.settings, **config.settings},
        frames_per_task=None if None in frames else max(frames),  # type: ignore[type-var]
    )


def _same_place(first: str, second: str) -> bool:
    return bool(first and second) and Path(first).resolve() == Path(second).resolve()


def check_settings(cells: Iterable[tuple[ResolvedMethod, Condition]]) -> None:
    """Create each method of some cells, and let it refuse its settings before anything that takes long.

    Raises `InputError` for settings that a method refuses, and whatever importing or creating it raises.
    """
    for method, _ in cells:
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
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
    folder: RunFolder,
    out: Path | None = None,
) -> list[Job]:
    """Make the cells of a run, each clip in the form that its method and condition need.

    Parameters
    ----------
    cells : sequence of (ResolvedMethod, Condition)
        See `resolve_cells`.
    folder : RunFolder
        Run folder of the cells.
    out : Path, optional
        Where to keep what took long in adapting clips, its lock is held; what ``folder`` kept is copied there first, since
        nothing is written in a run by what looks at it. Default: ``folder`` itself.

    Raises
    ------
    InputError
        For a region that a clip does not know, and for a form that a clip cannot be brought into.
    """
    regions = {clip.subject: check_regions(clip, config.regions) if protocols else () for clip in clips}
    forms = _Forms(config, folder, RunFolder(out or folder.root))
    forms.plan([(clip, method, condition) for clip in clips for method, condition in cells])
    source = RunFolder(Path(config.source)) if config.source else None
    kept: dict[str, Any] = {}
    return [
        Job(
            clip,
            method,
            seed,
            config.device,
            folder.cell(clip.subject, label_of(method.spec.name, condition.name), seed),
            {
                name: protocol
                for name, protocol in protocols.items()
                if not condition.drive or name == protocol_name(protocol.task, MethodNeeds.of(method.spec))
            },
            forms.of(clip, method, condition),
            regions[clip.subject],
            condition,
            None if source is None else source.cell(clip.subject, method.spec.name, seed),
            config,
            kept=kept,
        )
        for clip in clips
        for method, condition in cells
        for seed in config.seeds
    ]


class _Forms:
    """Clips in the forms that methods and conditions need, each made once."""

    def __init__(self, config: RunConfig, run: RunFolder, out: RunFolder):
        self._config, self._run, self._out = config, run, out
        self._changed: dict[str, Clip] = {}
        self._made: dict[tuple[str, MethodNeeds], AdaptedClip] = {}

    def plan(self, cells: Sequence[tuple[Clip, ResolvedMethod, Condition]]) -> None:
        """Check that every form can be had, then make them."""
        planned = {}
        for clip, method, condition in cells:
            changed, needs = self._clip(clip, condition), MethodNeeds.of(method.spec)
            if (changed.fingerprint, needs) not in planned:
                step = adaptation.plan(changed, needs, self._config.heads)
                planned[changed.fingerprint, needs] = (changed, step)
        with output_inside(self._out.root):
            if self._out.root != self._run.root:
                for subject in {changed.subject for changed, step in planned.values() if step is not None}:
                    _copy_kept(self._run.adapted / subject, self._out.adapted / subject)
            for (fingerprint, needs), (changed, step) in planned.items():
                if step is not None:
                    folder, label = self._out.adapted / changed.subject, f"adapting {changed.subject}"
                    self._made[fingerprint, needs] = adaptation.carry_out(step, needs, folder, label)

    def of(self, clip: Clip, method: ResolvedMethod, condition: Condition) -> AdaptedClip | None:
        """The form of a clip; None where it is the clip itself."""
        changed = self._clip(clip, condition)
        made = self._made.get((changed.fingerprint, MethodNeeds.of(method.spec)))
        return made or (None if changed is clip else AdaptedClip(changed))

    def _clip(self, clip: Clip, condition: Condition) -> Clip:
        key = digest(clip.fingerprint, asdict(condition.clip))
        if key not in self._changed:
            self._changed[key] = changed(clip, condition.clip, self._config)
        return self._changed[key]


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
        return Rows.joined([_run_inline(replace(job, line=line), metrics) for job in jobs])


def run_cell(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    """Train or derive the avatar of a cell, render its frames and measure them; each stage continues where it was.

    A cell whose condition drives the avatar is rendered and judged by that change in place of the last two.
    """
    if job.condition.drive and (kept := stored_rows(job, metrics, retry=True)) is not None:
        return kept
    avatar = fit(job) if job.source is None else derive(job)
    if job.condition.drive:
        return drive(job, avatar)
    render(job, avatar)
    return measure(job, avatar, metrics)


def _run_inline(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    log.info("%s", job.name)
    outcome_path(job.cell.folder).unlink(missing_ok=True)  # of a process or a job that worked on it earlier
    try:
        return run_cell(job, metrics)
    except HeadbenchError as error:
        log.error("%s failed: %s", job.name, error)
        return failed_rows(job, metrics, reason_of(error))
    except Exception as error:
        log.exception("%s failed", job.name)
        check_device_answers(job.device)
        return failed_rows(job, metrics, reason_of(error))
    finally:
        job.created.clear()  # so that a run does not hold every method that it has created


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
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
) -> Manifest:
    """The manifest of a run that starts."""
    return Manifest(
        configuration=config,
        paths=relative_paths(config),
        methods=tuple(
            MethodRecord(**method.record(), condition=condition.name, change=condition.summary)
            for method, condition in cells
        ),
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
    resolved = [cell for cell in resolve_cells(run_configuration(run, options)) if not cell[1].name]
    names = [method.spec.name for method, _ in resolved]
    for name in methods:
        if name not in names:
            raise InputError(folder.manifest, "methods", ", ".join(names), name)
    wanted = [(m, c) for m, c in resolved if (m.spec.name in methods if methods else not m.spec.trivial)]
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
    """Read the avatar of a cell, which was trained for it or for its source."""
    avatar: Avatar = job.create().load((job.source or job.cell).avatar, device=job.device)
    return avatar
