"""The cells of a run with their inputs, for runs, workers and commands that read a run's avatars."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..condition import Condition, label_of
from ..contracts import Avatar, Clip
from ..errors import InputError
from ..io.files import atomic_path, digest, output_inside
from ..protocol import Protocol, protocol_name
from ..rows import Rows
from ..specs import MetricSpec
from . import adaptation
from .adaptation import AdaptedClip, MethodNeeds
from .captures import changed, open_run_clips, run_configuration
from .config import ResolvedMethod, RunConfig, RunOptions, resolve_cells
from .job import MEASURING_AVATAR, RENDERING, TRAINING, Job
from .measuring import drive, measure, stored_rows
from .rendering import render
from .scoring import check_regions
from .store import Cell, RunFolder
from .training import derive, fit
from .trust import PROGRAMS, check_trusted


def make_jobs(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
    folder: RunFolder,
    out: Path | None = None,
) -> list[Job]:
    """Make the cells of a run, with clips adapted to each method and condition.

    Parameters
    ----------
    cells : Sequence[tuple[ResolvedMethod, Condition]]
        See `resolve_cells`.
    folder : RunFolder
        Run folder of the cells. Those that derive the avatar of another cell of this run come last.
    out : Path, optional
        Locked folder for results of slow adaptations of clips; those stored in ``folder`` are copied
        there first, since commands that read a run do not write to it. Default: ``folder`` itself.

    Raises
    ------
    InputError
        A clip has no such region or cannot be adapted to a method.
    """
    regions = {clip.subject: check_regions(clip, config.regions) if protocols else () for clip in clips}
    forms = _Forms(config, folder, RunFolder(out or folder.root))
    forms.plan([(clip, method, condition) for clip in clips for method, condition in cells])
    source = RunFolder(Path(config.source)) if config.source else None

    def source_of(clip: Clip, method: ResolvedMethod, condition: Condition, seed: int) -> Cell | None:
        """The cell whose avatar is used: of the source, or the plain one of this run; None for a training."""
        origin = source or (folder if condition.follows else None)
        return None if origin is None else origin.cell(clip.subject, method.spec.name, seed)

    kept: dict[str, Any] = {}
    jobs = [
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
            source_of(clip, method, condition, seed),
            config,
            kept=kept,
        )
        for clip in clips
        for method, condition in cells
        for seed in config.seeds
    ]
    return sorted(jobs, key=lambda job: job.follows)  # a stable sort


class _Forms:
    """Clips adapted to methods and conditions, each adapted once."""

    def __init__(self, config: RunConfig, run: RunFolder, out: RunFolder):
        self._config, self._run, self._out = config, run, out
        self._changed: dict[str, Clip] = {}
        self._made: dict[tuple[str, MethodNeeds], AdaptedClip] = {}

    def plan(self, cells: Sequence[tuple[Clip, ResolvedMethod, Condition]]) -> None:
        """Check that all clips can be adapted, then adapt them."""
        planned = {}
        for clip, method, condition in cells:
            changed, needs = self._clip(clip, condition), MethodNeeds.of(method.spec)
            if (changed.fingerprint, needs) not in planned:
                try:
                    step = adaptation.plan(changed, needs, self._config.heads)
                except InputError as error:
                    if error.key != "head_models":
                        raise
                    key = f"{error.key} of {method.spec.name}"
                    raise InputError(error.file, key, error.expected, error.found, error.remedy) from error
                planned[changed.fingerprint, needs] = (changed, step)
        with output_inside(self._out.root):
            if self._out.root != self._run.root:
                for subject in {changed.subject for changed, step in planned.values() if step is not None}:
                    _copy_kept(self._run.adapted / subject, self._out.adapted / subject)
            for (fingerprint, needs), (changed, step) in planned.items():
                if step is not None:
                    folder, label = self._out.adapted / changed.subject, f"adapting {changed.subject}"
                    self._made[fingerprint, needs] = adaptation.apply(step, needs, folder, label)

    def of(self, clip: Clip, method: ResolvedMethod, condition: Condition) -> AdaptedClip | None:
        """The adapted clip; None if no adaptation is needed."""
        changed = self._clip(clip, condition)
        made = self._made.get((changed.fingerprint, MethodNeeds.of(method.spec)))
        return made or (None if changed is clip else AdaptedClip(changed))

    def _clip(self, clip: Clip, condition: Condition) -> Clip:
        key = digest(clip.fingerprint, asdict(condition.clip))
        if key not in self._changed:
            self._changed[key] = changed(clip, condition.clip, self._config)
        return self._changed[key]


def _copy_kept(source: Path, folder: Path) -> None:
    """Copy the files missing from ``folder``; links are not followed, since the run may be untrusted."""
    if source.is_symlink() or source.parent.is_symlink():
        return
    for path in sorted(source.rglob("*")):
        target = folder / path.relative_to(source)
        if path.is_file() and not path.is_symlink() and not target.exists():
            with atomic_path(target) as temporary:
                shutil.copyfile(path, temporary)


def steps_ahead(job: Job, metrics: Sequence[MetricSpec]) -> dict[str, str]:
    """The unfinished steps of a cell, each with the group of cells whose duration is similar."""
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


def run_cell(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    """Train or derive the avatar of a cell, render its frames and measure them; each stage resumes.

    If the cell's condition animates the avatar, that change replaces the last two stages.
    """
    if job.source is not None and (kept := stored_rows(job, metrics, retry=True)) is not None:
        return kept
    avatar = fit(job) if job.source is None else derive(job)
    if job.condition.drive:
        return drive(job, avatar)
    render(job, avatar)
    return measure(job, avatar, metrics)


def trained(run: Path, methods: Sequence[str], options: RunOptions, out: Path) -> tuple[RunConfig, list[Job]]:
    """Return the settings of a run and its cells with a trained avatar, which `load` reads.

    Parameters
    ----------
    run : Path
        Run folder.
    methods : Sequence[str]
        Names of methods; empty: all except trivial baselines, which cannot show extreme poses.
    options : RunOptions
        Current locations of the run's files.
    out : Path
        Locked folder for adapted clips; replaces ``out`` of the settings.

    Raises
    ------
    InputError
        The run has no such method or no avatar, a capture differs from the one used for training, or
        an avatar is missing or its training did not finish.
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
    programs = [method.spec.name for method, _ in wanted if not method.spec.native]
    check_trusted(folder.manifest, {PROGRAMS: programs}, trust=options.trust)
    config, clips = open_run_clips(run, options, out=out)
    jobs = make_jobs(config, wanted, clips, {}, folder, out)
    for job in jobs:
        state = job.cell.step("fit")
        if state is None or state.get("status") != "done":
            found = "none" if state is None else "one whose training did not end"
            raise InputError(job.cell.folder, "fit.json", "a trained avatar", found, "Start the run again.")
    return config, jobs


def load(job: Job) -> Avatar:
    """Read the avatar of a cell: its own, also one derived from another, or that of its source."""
    cell = job.cell if job.source is None or job.condition.derive else job.source
    avatar: Avatar = job.create().load(cell.avatar, device=job.device)
    return avatar
