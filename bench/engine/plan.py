"""The plan of a run: its cells (a subject, a method, a condition, a seed), each with its inputs, all checked before any work."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..condition import PLAIN, Condition, label_of
from ..contracts import Avatar, CheckedMethod, Clip, FrameKey, Progress
from ..errors import InputError
from ..io.documents import read_json
from ..io.files import atomic_path, digest
from ..machine import machine_record
from ..manifest import (
    AdaptedRecord,
    ClipRecord,
    Manifest,
    MethodRecord,
    ProtocolRecord,
    identity_differences,
)
from ..progress import RunProgress, duration, progress
from ..protocol import Protocol, protocol_name, run_protocols
from ..registry import get, resolve
from ..rows import ALL, Rows
from ..specs import ConditionSpec, MetricSpec
from . import adaptation
from .adaptation import AdaptedClip, MethodNeeds
from .captures import PROGRAMS, changed, check_trusted, open_clips, open_run_clips, run_configuration
from .config import ResolvedMethod, RunConfig, RunOptions, resolve_cells, resolve_metrics
from .scoring import TrainingView, check_regions
from .store import Cell, CellRecord, RunFolder
from .stored import AVATAR_FILE

if TYPE_CHECKING:
    import pandas as pd

RESULT_FORMAT = 1  # raise when the output of a stage changes
TRAINING, RENDERING, MEASURING_AVATAR = "training", "rendering", "measuring the avatar"


@dataclass(frozen=True)
class Job:
    """One cell with its inputs.

    ``clip`` is the ground truth of every metric. ``adapted`` is the clip adapted to this method and
    condition, None if that is the clip itself. ``regions`` are evaluated besides the whole frame. ``source``
    is the cell whose avatar is used instead of training. ``config`` is that of the run. ``kept`` is a cache
    shared by the cells of a run. ``line`` shows the progress of the run.
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
    created: list[Any] = field(default_factory=list, repr=False, compare=False)
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def create(self) -> Any:
        """The `Method` of this cell, created on first use."""
        if not self.created:
            self.created.append(self.method.create())
        return self.created[0]

    def rows_of(self, rows: Rows) -> pd.DataFrame:
        """Select the rows of this cell from those of a run."""
        return rows.select(
            method=self.method.spec.name,
            condition=self.condition.name,
            metric=ALL,
            task=ALL,
            region=ALL,
            seeds=(self.seed,),
            subject=self.clip.subject,
        )

    def progress(self, step: str) -> AbstractContextManager[Progress]:
        """Progress of a step: part of the run's if the cell belongs to one, otherwise separate."""
        return self.line.step(self.name, step) if self.line else progress(f"{self.name}: {step}")

    @property
    def form(self) -> AdaptedClip:
        """The clip adapted to the method."""
        return self.adapted or AdaptedClip(self.clip)

    @property
    def name(self) -> str:
        return f"{self.label}, subject {self.clip.subject}, seed {self.seed}"

    @property
    def run(self) -> Path:
        """Folder of the run."""
        return self.cell.folder.parents[2]

    @property
    def follows(self) -> bool:
        """Whether its avatar is derived from that of another cell of the same run, which runs first."""
        return self.source is not None and self.source.folder.parents[2] == self.run

    @property
    def label(self) -> str:
        """Label of the method and its condition in tables and folder names."""
        return label_of(self.method.spec.name, self.condition.name)

    @property
    def fit_fingerprint(self) -> str:
        """Digest of everything the trained avatar depends on."""
        made_of = {**self.method.identity(), "name": self.label}
        derived = [asdict(change) for change in (self.condition.derive, self.condition.views) if change]
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

    def is_measured(self, metrics: Iterable[MetricSpec]) -> bool:
        """Whether the rows of these metrics are complete."""
        return {metric.name for metric in metrics} <= {*self.cell.record.get("measured", ())}

    def check(self) -> None:
        """Refuse a folder with an avatar from other inputs or other code.

        The method also checks that it can train and render, unless that is done.
        """
        if self.source is not None and not self.follows:
            source_fingerprint(self)
        record = self.cell.record
        if record.get("fingerprint", self.fit_fingerprint) != self.fit_fingerprint:
            now = self.method.identity()
            changed = identity_differences(record.get("method", now), now, "method")[:3]
            raise InputError(
                self.cell.file,
                ", ".join(key for key, _, _ in changed) or "fingerprint",
                ", ".join(then for _, then, _ in changed) or "the data, device and condition of this run",
                ", ".join(now for _, _, now in changed) or "others",
                f"Choose another --out, or delete {self.cell.folder}.",
            )
        if self.method.spec.implementation and "measured" not in record:
            method = self.create()
            if isinstance(method, CheckedMethod):
                method.check(TrainingView(self.form.clip), self.method.budget)

    def steps(self, metrics: Sequence[MetricSpec]) -> dict[str, str]:
        """The unfinished steps, each with the group of cells whose duration is similar."""
        if self.is_measured(metrics):
            return {}
        if self.condition.drive:
            return {RENDERING: self.label}
        steps = {} if self.cell.is_trained or self.source is not None else {TRAINING: self.label}
        steps[RENDERING] = self.label
        if any(spec.per_frame for spec in metrics):
            steps |= {f"measuring {task}": "" for task in self.protocols}
        if not all(spec.per_frame for spec in metrics):
            steps[MEASURING_AVATAR] = self.label
        return steps

    def load(self) -> Avatar:
        """Read the avatar: the cell's own, also one derived from another, or that of its source."""
        cell = self.cell if self.source is None or self.condition.derive else self.source
        avatar: Avatar = self.create().load(cell.avatar, device=self.device)
        return avatar


def source_fingerprint(job: Job) -> str:
    """Fingerprint of the trained avatar of the job's ``source``."""
    assert job.source is not None
    record, identity = trained_record(job.source), job.method.identity()
    if not job.source.avatar.is_dir():
        remedy = "Name the run that trained it, if its avatars were not deleted."
        raise InputError(job.source.avatar, "", "a stored avatar", "none", remedy)
    now = {name: identity[name] for name in ("version", "config", "budget")}
    if changed := identity_differences(record.get("method", now), now, "method")[:3]:
        keys, found, wanted = (", ".join(each) for each in zip(*changed))
        expected = f"an avatar of the settings of this run, {wanted}"
        raise InputError(job.source.file, keys, expected, found, "Give the settings of the source.")
    file = job.source.avatar / AVATAR_FILE
    capture = read_json(file).get("origin", {}).get("capture") if file.is_file() else None
    if capture not in (None, job.form.clip.fingerprint):
        raise InputError(file, "origin.capture", "an avatar of this capture", "one of another")
    return record["fingerprint"]


def trained_record(cell: Cell) -> CellRecord:
    """The record of a cell."""
    record = cell.record
    if record.get("state") != "trained":
        found = "one whose training did not end" if "state" in record else "none"
        raise InputError(cell.file, "", "a trained avatar", found, "Start the run again.")
    return record


def trained_ago(record: CellRecord) -> str:
    """How long ago a training ended."""
    seconds = datetime.now(UTC).timestamp() - record.get("training", {}).get("finished_at", 0.0)
    return f"{duration(max(0.0, seconds))} ago"


@dataclass(frozen=True)
class Plan:
    """What a run does: its cells, those that derive the avatar of another cell last, and its record."""

    config: RunConfig
    folder: RunFolder
    clips: Sequence[Clip]
    metrics: Sequence[MetricSpec]
    protocols: Mapping[str, Protocol]
    jobs: Sequence[Job]
    manifest: Manifest
    earlier: Manifest | None
    """Record of a former start of the same run."""


def make_plan(
    config: RunConfig,
    clips: Sequence[Clip] | None = None,
    cells: Sequence[tuple[ResolvedMethod, Condition]] | None = None,
    metrics: Sequence[MetricSpec] | None = None,
    scratch: Path | None = None,
) -> Plan:
    """Resolve and check a configuration; adapt the captures to its methods.

    Parameters
    ----------
    clips, cells, metrics : sequence, optional
        Open captures of the configuration; resolved cells and metrics, if the configuration does not name them.
    scratch : Path, optional
        Folder to write instead of ``config.out``, see `make_jobs`.
    """
    folder = RunFolder(Path(config.out))
    cells = resolve_cells(config) if cells is None else cells
    metrics = resolve_metrics(config) if metrics is None else metrics
    config = config if scratch is None else replace(config, out=str(scratch))
    earlier = folder.read_manifest() if folder.manifest.exists() else None
    if earlier is None or earlier.status != "done":
        check_settings(cells)
    clips = open_clips(config) if clips is None else clips
    jobs: list[Job] = []
    if config.drive:
        jobs = make_jobs(config, cells, clips, {}, folder, scratch)
        spec: ConditionSpec = get("conditions", config.drive.name)
        protocols: dict[str, Protocol] = resolve(spec.protocols)(jobs, **config.drive.parameters)
        jobs = [replace(job, protocols=_own(protocols, job.method, job.condition)) for job in jobs]
    else:
        protocols = run_protocols(config.tasks, clips, config.frames_per_task)
    manifest = _described(config, cells, metrics, clips, protocols)
    if earlier is not None:
        identities = {label_of(m.spec.name, c.name): m.identity() for m, c in cells}
        manifest.check_same(earlier, identities, folder.manifest)
    jobs = jobs or make_jobs(config, cells, clips, protocols, folder, scratch)
    for job in jobs:
        job.check()
    forms = tuple(
        AdaptedRecord(**adaptation.record(job.clip, job.adapted, job.label))
        for job in jobs
        if job.adapted is not None and job.seed == config.seeds[0]
    )
    return Plan(config, folder, clips, metrics, protocols, jobs, replace(manifest, adapted=forms), earlier)


def check_settings(cells: Iterable[tuple[ResolvedMethod, Condition]]) -> None:
    """Create the method of each cell, so that its settings are checked before any long step."""
    for method, _ in cells:
        if not method.spec.implementation:
            continue  # a folder of images
        created = method.create()
        if isinstance(created, CheckedMethod):
            created.check(None, method.budget)


def _described(
    config: RunConfig,
    cells: Sequence[tuple[ResolvedMethod, Condition]],
    metrics: Sequence[MetricSpec],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
) -> Manifest:
    """The record of a new run."""
    return Manifest(
        configuration=config,
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
    """
    regions = {clip.subject: check_regions(clip, config.regions) if protocols else () for clip in clips}
    source = RunFolder(Path(config.source)) if config.source else None
    changes = {repr(condition.clip): condition.clip for _, condition in cells}
    shown = {
        (clip.subject, name): changed(clip, change, config)
        for clip, (name, change) in product(clips, changes.items())
    }
    adapted = _adapted(
        config.heads,
        [(shown[clip.subject, repr(c.clip)], method) for clip in clips for method, c in cells],
        [each.adapted for each in (folder, source) if each is not None],
        RunFolder(out or folder.root),
    )

    def form(clip: Clip, method: ResolvedMethod, condition: Condition) -> AdaptedClip | None:
        """The clip under a condition, adapted to a method; None if that is the clip itself."""
        trained_on = shown[clip.subject, repr(condition.clip)]
        form_of_training = adapted[trained_on.fingerprint, MethodNeeds.of(method.spec)]
        return form_of_training or (None if trained_on is clip else AdaptedClip(trained_on))

    def source_of(clip: Clip, method: ResolvedMethod, condition: Condition, seed: int) -> Cell | None:
        """The cell whose avatar is used; None for a training. What is derived or driven is the plain avatar."""
        origin = source or (folder if condition.follows else None)
        plain = condition.follows or condition.drive
        label = label_of(method.spec.name, "" if plain else condition.name)
        return None if origin is None else origin.cell(clip.subject, label, seed)

    kept: dict[str, Any] = {}
    jobs = [
        Job(
            clip,
            method,
            seed,
            config.device,
            folder.cell(clip.subject, label_of(method.spec.name, condition.name), seed),
            _own(protocols, method, condition),
            form(clip, method, condition),
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


def _own(
    protocols: Mapping[str, Protocol], method: ResolvedMethod, condition: Condition
) -> Mapping[str, Protocol]:
    """The protocols of a cell: all, or, if it is driven, those of the method's needs."""
    needs = MethodNeeds.of(method.spec)
    return {n: p for n, p in protocols.items() if not condition.drive or n == protocol_name(p.task, needs)}


def _adapted(
    heads: Mapping[str, str],
    clips: Iterable[tuple[Clip, ResolvedMethod]],
    stored: Iterable[Path],
    out: RunFolder,
) -> dict[tuple[str, MethodNeeds], AdaptedClip | None]:
    """Each clip adapted once to each set of needs; None if it meets them. All are checked before the first is adapted."""
    planned = {}
    for clip, method in clips:
        needs = MethodNeeds.of(method.spec)
        if (clip.fingerprint, needs) not in planned:
            try:
                planned[clip.fingerprint, needs] = clip, adaptation.plan(clip, needs, heads)
            except InputError as error:
                if error.key != "head_models":
                    raise
                key = f"{error.key} of {method.spec.name}"
                raise InputError(error.file, key, error.expected, error.found, error.remedy) from error
    forms: dict[tuple[str, MethodNeeds], AdaptedClip | None] = dict.fromkeys(planned)
    for subject in {clip.subject for clip, step in planned.values() if step is not None}:
        for folder in stored:
            if folder != out.adapted:
                _copy_missing(folder / subject, out.adapted / subject)
    for (fingerprint, needs), (clip, step) in planned.items():
        if step is not None:
            folder, label = out.adapted / clip.subject, f"adapting {clip.subject}"
            forms[fingerprint, needs] = adaptation.apply(step, needs, folder, label)
    return forms


def _copy_missing(source: Path, folder: Path) -> None:
    """Copy the files missing from ``folder``."""
    for path in sorted(source.rglob("*")):
        target = folder / path.relative_to(source)
        if path.is_file() and not target.exists():
            with atomic_path(target) as temporary:
                shutil.copyfile(path, temporary)


def trained(run: Path, methods: Sequence[str], options: RunOptions, out: Path) -> tuple[RunConfig, list[Job]]:
    """Return the settings of a run and its cells with a trained avatar, which `Job.load` reads.

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
        trained_record(job.cell)
    return config, jobs
