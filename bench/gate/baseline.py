"""The numbers of a finished run as the gate compares them, and the baseline file that keeps them (JSON)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd

from ..errors import InputError
from ..io.documents import checked, read_json, shown
from ..io.files import check_name, write_json
from ..rows import ALL, FRAME
from ..runner.scoring import FULL
from ..runner.store import RunFolder
from ..specs import MAX_DIGITS, MetricSpec
from .settings import Captures

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

    @property
    def measured(self) -> str:
        """The metric, and the region if that is not the whole frame."""
        return self.metric if self.region == FULL else f"{self.metric} ({self.region})"


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

    ``frames`` says how many frames of each seed a number is the mean of; 1 for a number of the avatar.
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
    InputError
        The run is not finished, its rows cannot be read, or they belong to other protocols than the
        manifest's.
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
    every = rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    for parts, own in every.groupby([*Place._fields], sort=True):
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
    if (own["region"] != FULL).all():  # seen in some frames only, which ones is the truth's matter
        frames = own.groupby(FRAME).ngroups
    if own.duplicated(["seed", *FRAME]).any():
        return "frames measured twice"
    if set(own["seed"]) != seeds or len(own) != frames * len(seeds):
        return f"{len(own)} values, {frames * len(seeds)} expected ({frames} frames, {len(seeds)} seeds)"
    return ""


def _mean(own: pd.DataFrame) -> float:
    sequences = own.groupby(["seed", "sequence"])["value"].mean()
    return float(sequences.groupby(level="seed").mean().mean())


FORMAT = 3
LAST_DIGITS = 10
MACHINE_SHARE = 0.3
KEPT_DIGITS = 3
MACHINE = ("processor", "cores", "device")
"""Entries of the environment in which two machines differ whose speeds do not compare."""


@dataclass(frozen=True)
class Tolerance:
    """Which way a metric is better, and how far it may move without a verdict.

    A number may differ by ``absolute`` or by ``relative`` times the baseline's size, whichever is more.
    ``machine_bound`` numbers are judged on request, and on the machine of the baseline alone.
    """

    higher_is_better: bool
    absolute: float
    relative: float = 0.0
    machine_bound: bool = False
    unit: str = ""
    digits: int = 4

    def __post_init__(self) -> None:
        """Refuse a tolerance that would let everything pass, or nothing."""
        for name in ("absolute", "relative"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value}; a finite number from 0")
        if not 0 <= self.digits <= MAX_DIGITS:
            raise ValueError(f"digits is {self.digits}; from 0 to {MAX_DIGITS}")

    @classmethod
    def default(cls, spec: MetricSpec) -> Tolerance:
        """Ten units of the last digit that tables show (0.1 dB of PSNR); for speed and memory 30 % as well."""
        absolute, bound = round(LAST_DIGITS * 10.0**-spec.digits, spec.digits), spec.machine_bound
        share = MACHINE_SHARE if bound else 0.0
        return cls(spec.higher_is_better, absolute, share, bound, spec.unit, spec.digits)

    def allowed(self, value: float) -> float:
        """How far a number may lie from a baseline of ``value``."""
        return max(self.absolute, self.relative * abs(value))


@dataclass(frozen=True)
class _File:
    """The file as it stands."""

    format: Literal[3]
    captures: Captures
    environment: dict[str, Any]
    protocols: dict[str, ProtocolIdentity]
    tolerances: dict[str, Tolerance]
    count: int
    values: dict[str, float]
    frames: dict[str, int]
    unavailable: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Baseline:
    """A baseline, read or made from results.

    ``frames`` holds how many frames stand behind each value, since those in which a region is seen are not in the protocol.
    ``unavailable`` holds what could not be measured when it was made, with the reason: to lack it is no loss.
    """

    captures: Captures
    environment: Mapping[str, Any]
    protocols: Mapping[str, ProtocolIdentity]
    tolerances: Mapping[str, Tolerance]
    values: Mapping[Place, float]
    frames: Mapping[Place, int]
    unavailable: Mapping[Place, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, results: Results, earlier: Baseline | None = None, captures: Captures | None = None
    ) -> Baseline:
        """Make the baseline of some results, with the tolerances of an ``earlier`` one where it has them.

        Raises `InputError` where a number is missing that could be had: a baseline with holes would hide what is missing
        later.
        """
        if results.problems or not results.values:
            problem = next(iter(results.problems.items()), ("rows", "no numbers"))
            raise InputError(results.source, str(problem[0]), "a number for everything measured", problem[1])
        lost = sorted(results.unavailable.keys() & earlier.values.keys()) if earlier else []
        if lost:
            remedy = "Install what is missing, or delete the number from the baseline."
            reason = results.unavailable[lost[0]]
            raise InputError(results.source, str(lost[0]), "a number, as in the baseline", reason, remedy)
        known = earlier.tolerances if earlier else {}
        metrics = sorted({place.metric for place in results.values})
        return cls(
            captures or (earlier.captures if earlier else "same"),
            dict(results.environment),
            dict(results.protocols),
            {name: known.get(name) or Tolerance.default(results.metrics[name]) for name in metrics},
            dict(sorted(results.values.items())),
            dict(sorted(results.frames.items())),
            dict(sorted(results.unavailable.items())),
        )

    @classmethod
    def read(cls, path: Path) -> Baseline:
        """Read a baseline file. Raises `InputError` naming what is missing or malformed.

        A file that holds nothing to judge by, or fewer numbers than it says, would let everything pass.
        """
        record = read_json(path)
        if record.get("format") != FORMAT:
            raise InputError(path, "format", str(FORMAT), shown(record.get("format")))
        file = checked(record, _File, path)
        if file.count != len(file.values) or not file.values:
            expected = f"as many as count says, {file.count}" if file.count > 0 else "at least one number"
            raise InputError(path, "values", expected, str(len(file.values)))
        if file.frames.keys() != file.values.keys() or min(file.frames.values()) < 1:
            raise InputError(path, "frames", "a number from 1 for each of values", "others")
        values = {}
        for key, value in file.values.items():
            place = _place(key, path, "values")
            if place.metric not in file.tolerances:
                raise InputError(path, "tolerances", f"an entry {place.metric!r}", "none")
            if place.task != AVATAR and place.task not in file.protocols:
                raise InputError(path, "protocols", f"an entry {place.task!r}", "none")
            values[place] = value
        unavailable = {_place(key, path, "unavailable"): why for key, why in file.unavailable.items()}
        frames = {place: file.frames[str(place)] for place in values}
        return cls(
            file.captures, file.environment, file.protocols, file.tolerances, values, frames, unavailable
        )

    def write(self, path: Path) -> None:
        """Write the file. Numbers keep three digits more than tables show, so that a diff shows what has changed."""
        values = {
            str(place): round(value, self.tolerances[place.metric].digits + KEPT_DIGITS)
            for place, value in self.values.items()
        }
        record = {
            "format": FORMAT,
            "captures": self.captures,
            "environment": self.environment,
            "protocols": {task: asdict(identity) for task, identity in self.protocols.items()},
            "tolerances": {name: asdict(tolerance) for name, tolerance in self.tolerances.items()},
            "unavailable": {str(place): reason for place, reason in self.unavailable.items()},
            "count": len(values),
            "frames": {str(place): self.frames[place] for place in self.values},
            "values": values,
        }
        write_json(path, record)


def _place(key: str, path: Path, group: str) -> Place:
    parts = key.split("/")
    if len(parts) != len(Place._fields) or not all(parts):
        raise InputError(path, f"{group}, {key}", "task/method/subject/region/metric", repr(key))
    return Place(*(check_name(name, path, f"{group}, {key}") for name in parts))
