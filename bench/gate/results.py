"""The numbers of a finished run as the gate compares them: one for each task, method, subject, region and metric."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ..errors import InputError
from ..files import digest
from ..scoring import FULL
from ..specs import MetricSpec
from ..store import RunFolder, check_protocols, read_rows

AVATAR = "avatar"


class Place(NamedTuple):
    """What a number is of; written with slashes it is the key in a baseline file."""

    task: str  # AVATAR for a number of the avatar as a whole
    method: str
    subject: str
    region: str
    metric: str

    def __str__(self) -> str:
        return "/".join(self)

    @classmethod
    def parse(cls, text: str) -> Place | None:
        """Read what `str` wrote; None for anything else."""
        parts = text.split("/")
        return cls(*parts) if len(parts) == len(cls._fields) and all(parts) else None


@dataclass(frozen=True)
class ProtocolIdentity:
    """What must agree for two numbers of a task to compare.

    ``design`` is the hash of all but the fingerprints of the captures.
    """

    id: str
    hash: str
    design: str


@dataclass(frozen=True)
class Results:
    """What was measured, and of what it lacks a number, with the reason."""

    source: Path
    values: Mapping[Place, float]
    problems: Mapping[Place, str]
    metrics: Mapping[str, MetricSpec]
    protocols: Mapping[str, ProtocolIdentity]
    environment: Mapping[str, Any] = field(default_factory=dict)


def read_results(root: Path) -> Results:
    """Read a run folder.

    A number is the mean over the frames of a sequence, then over sequences, then over seeds. It is there only where
    every frame of the protocol has one, for every seed.

    Raises
    ------
    InputError : no finished run, rows that cannot be read, rows of other protocols than the manifest's.
    """
    folder = RunFolder(root)
    manifest = folder.read_manifest()
    if manifest.get("status") != "done":
        remedy = "Start the run again; it continues."
        raise InputError(folder.manifest, "status", "'done'", repr(manifest.get("status")), remedy)
    rows = read_rows(folder.rows)
    try:
        metrics = {spec.name: spec for spec in map(_metric, manifest["metrics"])}
        expected = {task: _frames(record) for task, record in manifest["protocols"].items()}
        protocols = {task: identity(record) for task, record in manifest["protocols"].items()}
        seeds = {int(seed) for seed in manifest["configuration"]["seeds"]}
        device = str(manifest["configuration"]["device"])
        machine = dict(manifest["machine"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(folder.manifest, "", "the manifest of a run", f"{error!r}") from error
    check_protocols(rows, folder.rows, {task: identity.hash for task, identity in protocols.items()})
    values: dict[Place, float] = {}
    problems: dict[Place, str] = {}
    columns = ["task", "method", "subject", "region", "metric"]
    for parts, own in rows.groupby(columns, sort=True):
        task, *rest = map(str, parts)
        place = Place(task or AVATAR, *rest)
        wanted = expected.get(task, {}).get(place.subject, 0) if task else 1
        reason = _lacking(own, wanted, seeds)
        if reason:
            problems[place] = reason
        else:
            values[place] = _mean(own)
    return Results(root, values, problems, metrics, protocols, {"device": device, **machine})


def identity(record: Mapping[str, Any]) -> ProtocolIdentity:
    """Identity of a protocol as a manifest records it."""
    design = {name: value for name, value in record.items() if name not in ("hash", "clips")}
    return ProtocolIdentity(str(record["id"]), str(record["hash"]), digest(design)[:12])


def _metric(record: Mapping[str, Any]) -> MetricSpec:
    known = {field.name for field in fields(MetricSpec)}
    return MetricSpec(**{name: value for name, value in record.items() if name in known})


def _frames(record: Mapping[str, Any]) -> dict[str, int]:
    """How many frames of each subject a protocol asks for."""
    subjects = [str(key[0]) for key in record["keys"]]
    return {subject: subjects.count(subject) for subject in set(subjects)}


def _lacking(own: pd.DataFrame, frames: int, seeds: set[int]) -> str:
    """Why these rows give no number; "" where they do."""
    bad = own[own["status"] != "ok"]
    if len(bad):
        first = bad.iloc[0]
        return f"{first['status']}: {' '.join(str(first['reason']).split())}"
    if not own["value"].map(lambda value: abs(value) < float("inf")).all():
        return "a value that is not finite"
    regional = (own["region"] != FULL).all()  # seen in some frames only, which ones is the truth's matter
    if regional:
        frames = own.groupby(["sequence", "timestep", "camera"]).ngroups
    measured = own.drop_duplicates(["seed", "sequence", "timestep", "camera"])
    if len(measured) != len(own):
        return "frames measured twice"
    if set(own["seed"]) != seeds or len(own) != frames * len(seeds):
        return f"{len(own)} values, {frames * len(seeds)} expected ({frames} frames, {len(seeds)} seeds)"
    return ""


def _mean(own: pd.DataFrame) -> float:
    sequences = own.groupby(["seed", "sequence"])["value"].mean()
    return float(sequences.groupby(level="seed").mean().mean())
