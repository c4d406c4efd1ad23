"""The run folder: the files of a comparison. A run does not change; a killed one resumes from the records of its cells.

::

    run.json                      resolved configuration, machine, hashes of protocols, fingerprints
    protocols/<hash>.json         frames and rules of a task
    run.log
    rows.parquet                  one row per method, seed, frame and metric
    <subject>/<method>/seed-<n>/
        cell.json                 inputs of the avatar, state, times, details of the measurements, see `CellRecord`
        avatar/                   files of the method
        losses.csv, tensorboard/  losses of the training, for methods that record them
        renders/<task>/*.png      8-bit frames, named by key
        rows.parquet              results
        job.log                   of the process or job of the cell, see `bench.executors`
    adapted/<subject>/            tracking refitted for methods that want another head model
    tables/, contact_sheet.png, report.html    views of the rows
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Required

from typing_extensions import TypedDict

from ..contracts import Clip, FrameKey
from ..errors import InputError
from ..io.documents import checked, read_json
from ..io.files import write_json
from ..manifest import Manifest
from ..rows import Rows


class TaskOutcome(TypedDict, total=False):
    """Entry ``task`` of ``cell.json``: current activity of a task's process or job, or how it ended."""

    status: Required[Literal["running", "done", "failed"]]
    """A job that no longer exists while it is "running" was killed."""
    speed: Required[bool]
    """Whether speed is measured, in a separate pass over a run's cells."""
    reason: str
    """Reason of the failure, as in the rows of a cell."""
    doing: str  # current step
    since: str  # ISO 8601, UTC
    seconds: float
    restarts: int
    job: str
    """Job of the cluster, "" for a process of ``host``."""
    process: int
    host: str
    threads: str
    """Value of OMP_NUM_THREADS, "" for the number of cores."""
    machine: dict[str, Any]
    """See `machine_record`."""


class CellRecord(TypedDict, total=False):
    """Content of ``cell.json``."""

    state: Literal["training", "trained"]
    """Whether the avatar is complete. Only a complete avatar is rendered."""
    fingerprint: str
    """Digest of everything that the avatar depends on."""
    method: dict[str, Any]
    """Method and settings of the training, see `ResolvedMethod.record`."""
    training: dict[str, Any]
    """Times, memory, load and interruptions of the training; empty for a derived avatar."""
    derived_from: str
    """Fingerprint of the trained avatar from which this one was derived without training."""
    measured: list[str]
    """Metrics whose rows are complete."""
    details: dict[str, dict[str, Any]]
    """Details of the measurements by metric."""
    codec: str
    """Codec of the measured avatar, see `CodedAvatar`."""
    task: TaskOutcome
    """Of the process or job of the cell."""


def record_path(folder: Path) -> Path:
    """The record of a cell, or of another task, in its folder."""
    return folder / "cell.json"


def read_record(folder: Path) -> dict[str, Any]:
    """Read the record of a folder; empty if it is missing."""
    path = record_path(folder)
    return read_json(path) if path.exists() else {}


def update_record(folder: Path, **changes: Any) -> None:
    """Write entries of the record atomically; None removes one."""
    record = {**read_record(folder), **changes}
    write_json(record_path(folder), {key: value for key, value in record.items() if value is not None})


def read_outcome(folder: Path) -> TaskOutcome | None:
    """Read the outcome of a task's folder; None if it is missing."""
    outcome = read_record(folder).get("task")
    return None if outcome is None else checked(outcome, TaskOutcome, record_path(folder), "task")


@dataclass(frozen=True)
class Cell:
    """The folder of one avatar: a subject, a method, a seed."""

    folder: Path

    @property
    def avatar(self) -> Path:
        return self.folder / "avatar"

    @property
    def rows(self) -> Path:
        return self.folder / "rows.parquet"

    @property
    def file(self) -> Path:
        """``cell.json``."""
        return record_path(self.folder)

    def render(self, task: str, key: FrameKey) -> Path:
        """Path of the render of ``key``."""
        return self.folder / "renders" / task / f"{key.sequence}_{key.timestep:05d}_{key.camera}.png"

    @property
    def record(self) -> CellRecord:
        """``cell.json``, empty without one."""
        try:
            return checked(read_record(self.folder), CellRecord, self.file)  # type: ignore[no-any-return]
        except InputError as error:
            remedy = f"Delete {self.folder}; the same command makes it again."
            raise InputError(error.file, error.key, error.expected, error.found, remedy) from error

    def update(self, **changes: Any) -> None:
        """Write entries of the record, see `CellRecord`."""
        update_record(self.folder, **changes)

    @property
    def is_trained(self) -> bool:
        """Whether its avatar is complete."""
        return self.record.get("state") == "trained"


@dataclass(frozen=True)
class RunFolder:
    """The folder of a comparison."""

    root: Path

    @property
    def manifest(self) -> Path:
        return self.root / "run.json"

    @property
    def rows(self) -> Path:
        return self.root / "rows.parquet"

    @property
    def adapted(self) -> Path:
        """Folder with results of adapting clips to methods, by subject."""
        return self.root / "adapted"

    @property
    def tables(self) -> Path:
        return self.root / "tables"

    @property
    def contact_sheet(self) -> Path:
        return self.root / "contact_sheet.png"

    @property
    def page(self) -> Path:
        return self.root / "report.html"

    def cell(self, subject: str, method: str, seed: int) -> Cell:
        """Return the folder of one avatar."""
        return Cell(self.root / subject / method / f"seed-{seed}")

    def read_manifest(self) -> Manifest:
        """Read ``run.json``."""
        if not self.manifest.exists():
            raise InputError(self.root, "run.json", "the folder of a run", "no run.json")
        return Manifest.read(self.manifest)

    def read_rows(self, manifest: Manifest) -> Rows:
        """Read ``rows.parquet`` with the label of method and condition as the method, see `Rows.labelled`."""
        rows = Rows.read(self.rows).labelled()
        for what, found, known in (
            ("method", rows.methods, {method.label for method in manifest.methods}),
            ("metric", rows.metrics, {metric.name for metric in manifest.metrics}),
            ("task", rows.tasks, {protocol.task for protocol in manifest.protocols.values()}),
        ):
            if found - known:
                names = ", ".join(sorted(known)), ", ".join(sorted(found - known))
                raise InputError(self.rows, what, f"those of {self.manifest.name}: {names[0]}", names[1])
        return rows


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run in memory: what its reports are made of. ``clips`` are its captures by subject."""

    folder: RunFolder
    manifest: Manifest
    rows: Rows
    clips: Mapping[str, Clip]
