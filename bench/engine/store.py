"""The run folder: the files of a comparison, and how an interrupted one resumes.

::

    run.json                      resolved configuration, machine, hashes of protocols, fingerprints
    protocols/<hash>.json         frames and rules of a task
    run.log
    rows.parquet                  one row per method, seed, frame and metric
    <subject>/<method>/seed-<n>/
        fit.json                  inputs of the avatar, training time, digests of its files
        avatar/                   files of the method
        losses.csv, tensorboard/  losses of the training, for methods that record them
        renders/<task>/*.png      8-bit frames, named by key
        digests.json              digests of the rendered frames
        rows.parquet              results
        measure.json              inputs of the results, digest of the rows
        outcome.json, job.log     of the process or job of the cell, see `bench.executors`
    speed.json                    present while speed is measured at the end: cells that failed before
    adapted/<subject>/            tracking refitted for methods that want another head model
    tables/, contact_sheet.png, report.html    views of the rows
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Required

from typing_extensions import TypedDict

from ..contracts import FrameKey
from ..errors import InputError, is_damage
from ..io.documents import checked, read_json
from ..io.files import digest_file, is_system_file, write_json
from ..manifest import Manifest
from ..rows import DISCARD, Rows, earlier_rows, replace_rows

log = logging.getLogger(__name__)


class StepState(TypedDict, total=False):
    """Record of a step of a cell.

    Attributes
    ----------
    fingerprint : Required[str]
        Digest of everything that determines the step's result.
    files : dict[str, str]
        SHA-256 of the files that the step wrote, by their path in the cell's folder.
    rows : str
        SHA-256 of ``rows.parquet``.
    fingerprints, details : dict[str, str] or dict[str, dict[str, Any]]
        Fingerprints and details of the measurements, by metric.
    seconds, processor_seconds, interruptions, peak_memory_bytes, memory_before_bytes, method : float, int or dict[str, Any]
        Statistics of the training.
    finished_at : float
        End of the training, in seconds since 1970 (UTC).
    peak_device_memory_bytes, device_memory_before_bytes, tf32 : int or bool
        Memory and arithmetic of the training on a CUDA device; see `PeakMemory`.
    load : dict[str, Any]
        Machine, threads and cores of the training, and cores used by other processes; see
        `ProcessorLoad`.
    derived_from : str
        Digest of the trained avatar from which this one was derived without training.
    codec : str
        Codec of the measured avatar, see `CodedAvatar`.
    """

    fingerprint: Required[str]
    status: Required[Literal["started", "done"]]
    files: dict[str, str]
    rows: str
    fingerprints: dict[str, str]
    details: dict[str, dict[str, Any]]
    seconds: float
    processor_seconds: float
    interruptions: int
    peak_memory_bytes: int
    memory_before_bytes: int
    peak_device_memory_bytes: int
    device_memory_before_bytes: int
    tf32: bool
    method: dict[str, Any]
    finished_at: float
    load: dict[str, Any]
    derived_from: str
    codec: str


STAGES = ("fit", "digests", "measure")


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

    def render(self, task: str, key: FrameKey) -> Path:
        """Path of the render of ``key``."""
        return self.folder / "renders" / task / f"{key.sequence}_{key.timestep:05d}_{key.camera}.png"

    def step(self, name: str) -> StepState | None:
        """Return the record that `begin` or `finish` wrote, or None. Raises `InputError` for a damaged record."""
        path = self.folder / f"{name}.json"
        if not path.exists():
            return None
        step: StepState = checked(read_json(path), StepState, path)
        for file in map(PurePosixPath, step.get("files", {})):
            if file.is_absolute() or ".." in file.parts:
                raise InputError(path, "files", f"files inside {self.folder}", str(file))
        return step

    def drop_damaged_records(self) -> None:
        """Remove records of steps that cannot be read, with a warning; these steps are repeated."""
        for name in STAGES:
            try:
                self.step(name)
            except InputError as error:
                if not is_damage(error):
                    raise
                log.warning("%s What it records is made again.", error)
                (self.folder / f"{name}.json").unlink()

    def set_aside(self, folder: Path) -> None:
        """Rename a folder with invalid files instead of deleting it."""
        number = 1
        while (aside := folder.with_name(f"{folder.name}-damaged-{number}")).exists():
            number += 1
        folder.rename(aside)
        log.info("%s was moved to %s.", folder, aside.name)

    def digests(self, files: Iterable[Path]) -> dict[str, str]:
        """SHA-256 of files in the cell's folder, by their path in it."""
        return {self.name(path): digest_file(path) for path in sorted(files)}

    def name(self, path: Path) -> str:
        """The path of a file in the cell's folder."""
        return path.relative_to(self.folder).as_posix()

    def damage(self, files: Mapping[str, str]) -> dict[str, str]:
        """Files that do not match their digests, with the reason for each."""
        found = {name: _damage(self.folder / name, known) for name, known in files.items()}
        return {name: why for name, why in found.items() if why}

    def is_done(self, name: str, fingerprint: str) -> bool:
        """Whether the step finished with exactly these inputs."""
        state = self.step(name)
        return state is not None and state.get("fingerprint") == fingerprint and state.get("status") == "done"

    def ended(self, name: str) -> bool:
        """Whether the step finished, with any inputs; False for a record that cannot be read."""
        try:
            state = self.step(name)
        except InputError:
            return False
        return state is not None and state.get("status") == "done"

    def begin(self, name: str, fingerprint: str, *, status: str = "started", **record: Any) -> None:
        """Record the start of the step with these inputs."""
        write_json(self.folder / f"{name}.json", {"fingerprint": fingerprint, "status": status, **record})

    def finish(self, name: str, fingerprint: str, **record: Any) -> None:
        """Record the end of the step, with its results."""
        self.begin(name, fingerprint, status="done", **record)


def _kept_design(manifest: Manifest) -> dict[str, str]:
    """Fields that must not change when a run is restarted, by their name in error messages."""
    regions = manifest.configuration.regions
    protocols = sorted(manifest.protocols.items())
    return {
        "tasks": ", ".join(task for task, _ in protocols),
        "regions": "the default ones" if regions is None else ", ".join(regions) or "none",
        **{f"captures or frames of {task}": f"protocol {protocol.hash}" for task, protocol in protocols},
    }


def _has_all_frames(planned: Manifest, earlier: Manifest, key: str) -> bool:
    """Whether a planned run scores at least the frames that an earlier one scored of the same captures."""
    if key == "tasks":
        return set(earlier.protocols) <= set(planned.protocols)
    task = key.rpartition(" ")[2]
    new, old = planned.protocols.get(task), earlier.protocols.get(task)
    if new is None or old is None:
        return new is not None
    return set(old.keys) <= set(new.keys) and replace(new, keys=old.keys, hash=old.hash) == old


def avatar_files(folder: Path) -> list[Path]:
    """Files of an avatar's folder, sorted, without logs of official programs and files of operating systems."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".log")
    return sorted(path for path in files if not is_system_file(path.name))


def _damage(path: Path, known: str) -> str:
    if not path.is_file():
        return "is missing"
    if not path.stat().st_size:
        return "is empty"
    return "" if digest_file(path) == known else "is not as it was written (SHA-256)"


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
    def speed_pass(self) -> Path:
        """Present while speed is measured at the end of a run: cells that had failed before, with reasons."""
        return self.root / "speed.json"

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

    def check_kept(self, planned: Manifest) -> None:
        """Check that a planned run keeps all rows of the folder; called before execution.

        Methods, seeds and metrics may be added but not removed. Captures, frames, tasks and regions must be the same.

        Raises `InputError` for a plan that would lose rows.
        """
        earlier = earlier_rows(self.rows)
        if earlier is None:
            return
        earlier.labelled().check_kept(
            self.rows,
            method=[method.label for method in planned.methods],
            seed=planned.configuration.seeds,
            metric=[metric.name for metric in planned.metrics],
        )
        try:
            manifest = self.read_manifest()
            before = _kept_design(manifest)
        except InputError:
            return  # not readable; rows that would be lost are an error of `write_rows`
        for key, value in _kept_design(planned).items():
            if value != before.get(key) and not _has_all_frames(planned, manifest, key):
                raise InputError(self.rows, key, f"{before.get(key)}, as in the earlier run", value, DISCARD)

    def write_rows(self, rows: Rows) -> None:
        """Write ``rows.parquet``.

        Raises `InputError`, and does not change the file, if it has values that ``rows`` lack.
        """
        replace_rows(self.rows, rows)

    def read_manifest(self) -> Manifest:
        """Read ``run.json``. Raises `InputError` if it is missing or has another format."""
        if not self.manifest.exists():
            raise InputError(self.root, "run.json", "the folder of a run", "no run.json")
        return Manifest.read(self.manifest)

    def read_rows(self, manifest: Manifest) -> Rows:
        """Read ``rows.parquet`` with the label of method and condition as the method, see `Rows.labelled`.

        Raises `InputError` for rows of methods, metrics and tasks that the run does not have.
        """
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
