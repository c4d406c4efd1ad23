"""The run folder: what a comparison leaves on disk, and how a killed one finds what is already there.

::

    run.json                      resolved configuration, machine, protocols, fingerprints
    run.log
    rows.parquet                  one row per method, seed, frame and metric
    <subject>/<method>/seed-<n>/
        fit.json                  what the avatar was made of, how long it took
        avatar/                   what the method wrote
        renders/<task>/*.png      8-bit frames, named by key
        speed.json, rows.parquet
    adapted/<subject>/            tracking refitted for methods that want another head model
    tables/, contact_sheet.png    views of the rows
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import pandas as pd

from .contracts import FrameKey
from .errors import InputError
from .files import atomic_path, read_json, write_json

FORMAT = 1


@dataclass(frozen=True)
class Row:
    """One measured value, or why there is none. Per-avatar values have no task, timestep -1 and no camera."""

    method: str
    version: str
    seed: int
    task: str
    subject: str
    sequence: str
    timestep: int
    camera: str
    region: str
    metric: str
    value: float
    protocol: str
    status: str = "ok"  # ok | missing | failed
    reason: str = ""


COLUMNS = tuple(f.name for f in fields(Row))


def to_frame(rows: Iterable[Row]) -> pd.DataFrame:
    """Rows as a table with the columns of `Row`, typed even when empty."""
    frame = pd.DataFrame([asdict(row) for row in rows], columns=list(COLUMNS))
    return frame.astype({"seed": "int64", "timestep": "int64", "value": "float64"})


def write_rows(path: Path, frame: pd.DataFrame) -> None:
    """Write rows as Parquet, atomically."""
    with atomic_path(path) as temporary:
        frame.to_parquet(temporary, index=False)


def read_rows(path: Path) -> pd.DataFrame:
    """Read rows. Raises `InputError` for a file that is not there, not Parquet, or lacks a column."""
    try:
        frame = pd.read_parquet(path)
    except FileNotFoundError as error:
        raise InputError(
            path, "", "the rows of a finished run", "no such file", "Start the run again."
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(path, "", "a Parquet file of rows", " ".join(str(error).split())) from error
    missing = [c for c in COLUMNS if c not in frame.columns]
    if missing:
        raise InputError(path, "columns", ", ".join(COLUMNS), f"no {', '.join(missing)}")
    return frame


def check_protocols(
    rows: pd.DataFrame, source: Path | str, expected: Mapping[str, str] | None = None
) -> None:
    """Raise `InputError` where rows of one task come from several protocols, or from another than ``expected``.

    Numbers of different protocols do not compare. ``expected`` holds the hash of each task's protocol.
    """
    for task, hashes in rows[rows["task"] != ""].groupby("task")["protocol"].unique().items():
        found = sorted(map(str, hashes))
        if len(found) > 1:
            wanted = "one protocol: numbers of different protocols do not compare"
            remedy = "Take the rows of each protocol for themselves."
            raise InputError(source, f"protocol of {task}", wanted, ", ".join(found), remedy)
        if expected is not None and found != [expected.get(str(task))]:
            raise InputError(source, f"protocol of {task}", str(expected.get(str(task))), found[0])


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
        """Where the render of ``key`` lies."""
        return self.folder / "renders" / task / f"{key.sequence}_{key.timestep:05d}_{key.camera}.png"

    def stage(self, name: str) -> Mapping[str, Any] | None:
        """Return what `begin` or `finish` wrote for a stage, or None."""
        path = self.folder / f"{name}.json"
        return read_json(path) if path.exists() else None

    def is_done(self, name: str, fingerprint: str) -> bool:
        """Say whether the stage ended with exactly these inputs."""
        state = self.stage(name)
        return state is not None and state.get("fingerprint") == fingerprint and state.get("status") == "done"

    def begin(self, name: str, fingerprint: str, **record: Any) -> None:
        """Record that the stage works on these inputs."""
        write_json(self.folder / f"{name}.json", {"fingerprint": fingerprint, "status": "started", **record})

    def finish(self, name: str, fingerprint: str, **record: Any) -> None:
        """Record that the stage ended, with what it measured."""
        write_json(self.folder / f"{name}.json", {"fingerprint": fingerprint, "status": "done", **record})


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
        """Folder of what was computed to bring clips into the form that a method needs, by subject."""
        return self.root / "adapted"

    @property
    def tables(self) -> Path:
        return self.root / "tables"

    @property
    def contact_sheet(self) -> Path:
        return self.root / "contact_sheet.png"

    def cell(self, subject: str, method: str, seed: int) -> Cell:
        """Return the folder of one avatar."""
        return Cell(self.root / subject / method / f"seed-{seed}")

    def prepare(self) -> None:
        """Make the folder and prove that it can be written, before any work."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            with atomic_path(self.root / ".writable") as probe:
                probe.write_bytes(b"")
            (self.root / ".writable").unlink()
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            found = getattr(error, "strerror", None) or str(error)
            raise InputError(self.root, "--out", "a folder that can be written", found) from error

    def write_manifest(self, record: Mapping[str, Any]) -> None:
        """Write ``run.json``."""
        write_json(self.manifest, {"format": FORMAT, **record})

    def read_manifest(self) -> dict[str, Any]:
        """Read ``run.json``. Raises `InputError` where there is none, or one of another format."""
        if not self.manifest.exists():
            raise InputError(self.root, "run.json", "the folder of a run", "no run.json")
        record = read_json(self.manifest)
        if record.get("format") != FORMAT:
            raise InputError(self.manifest, "format", str(FORMAT), repr(record.get("format")))
        return record


def keys_of(record: Mapping[str, Any], task: str) -> Sequence[FrameKey]:
    """Return the frames of a task from a manifest."""
    return [FrameKey(*key) for key in record["protocols"][task]["keys"]]
