"""The numbers of a finished run as the gate compares them: one for each task, method, subject, region and metric."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ..rows import ALL, FRAME
from ..runner.scoring import FULL
from ..runner.store import RunFolder
from ..specs import MetricSpec

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
    """What was measured, and of what it lacks a number, with the reason.

    ``frames`` tells how many frames of each seed a number is the mean of; 1 for a number of the avatar.
    ``unavailable`` numbers are those that no seed could have: an avatar that offers no stage times, a metric whose
    weights are not installed. ``problems`` are all others.
    """

    source: Path
    values: Mapping[Place, float]
    problems: Mapping[Place, str]
    metrics: Mapping[str, MetricSpec]
    protocols: Mapping[str, ProtocolIdentity]
    frames: Mapping[Place, int]
    environment: Mapping[str, Any] = field(default_factory=dict)
    unavailable: Mapping[Place, str] = field(default_factory=dict)


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
    manifest.check_done(folder.manifest)
    rows = folder.read_rows(manifest)
    metrics = {spec.name: spec for spec in manifest.metrics}
    expected = {task: Counter(key.subject for key in p.keys) for task, p in manifest.protocols.items()}
    protocols = {task: ProtocolIdentity(p.id, p.hash, p.design) for task, p in manifest.protocols.items()}
    seeds = set(manifest.configuration.seeds)
    rows.check_protocols(folder.rows, {task: identity.hash for task, identity in protocols.items()})
    values: dict[Place, float] = {}
    frames: dict[Place, int] = {}
    problems: dict[Place, str] = {}
    unavailable: dict[Place, str] = {}
    columns = ["task", "method", "subject", "region", "metric"]
    every = rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    for parts, own in every.groupby(columns, sort=True):
        task, *rest = map(str, parts)
        place = Place(task or AVATAR, *rest)
        wanted = expected[task][place.subject] if task else 1
        reason = _lacking(own, wanted, seeds)
        if (own["status"] == "missing").all():
            unavailable[place] = reason
        elif reason:
            problems[place] = reason
        else:
            values[place] = _mean(own)
            frames[place] = len(own) // len(seeds)
    environment = {"device": manifest.configuration.device, **manifest.machine}
    return Results(root, values, problems, metrics, protocols, frames, environment, unavailable)


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
        frames = own.groupby(FRAME).ngroups
    measured = own.drop_duplicates(["seed", *FRAME])
    if len(measured) != len(own):
        return "frames measured twice"
    if set(own["seed"]) != seeds or len(own) != frames * len(seeds):
        return f"{len(own)} values, {frames * len(seeds)} expected ({frames} frames, {len(seeds)} seeds)"
    return ""


def _mean(own: pd.DataFrame) -> float:
    sequences = own.groupby(["seed", "sequence"])["value"].mean()
    return float(sequences.groupby(level="seed").mean().mean())
