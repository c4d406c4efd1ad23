"""The numbers of a finished run that the gate compares, and the baseline file that stores them (JSON)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ..engine.store import RunFolder
from ..errors import InputError
from ..io.documents import checked, read_json, shown
from ..io.files import check_name, write_json
from ..rows import ALL, FRAME, FULL
from ..specs import MAX_DIGITS, MetricSpec

if TYPE_CHECKING:
    import pandas as pd

AVATAR = "avatar"
Captures = Literal["same", "remade"]


class ResultKey(NamedTuple):
    """Identifies a number; written with slashes it is the key in a baseline file."""

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
    """Conditions that must agree for two numbers of a task to be comparable.

    ``design`` is the hash of all fields except the fingerprints of the captures.
    """

    id: str
    hash: str
    design: str


@dataclass(frozen=True)
class Results:
    """The measured numbers, and the missing ones with the reason.

    ``frames`` is the number of frames per seed that a number is the mean of; 1 for a number of the avatar.
    ``unavailable`` numbers are those that no seed could have: an avatar that reports no stage times, a metric
    whose weights are not installed. ``problems`` are all others.
    """

    source: Path
    values: Mapping[ResultKey, float]
    problems: Mapping[ResultKey, str]
    metrics: Mapping[str, MetricSpec]
    protocols: Mapping[str, ProtocolIdentity]
    frames: Mapping[ResultKey, int]
    environment: Mapping[str, Any] = field(default_factory=dict)
    unavailable: Mapping[ResultKey, str] = field(default_factory=dict)


def read_results(root: Path) -> Results:
    """Read a run folder.

    A number is the mean over the frames of a sequence, then over sequences, then over seeds. It is present
    only if every frame of the protocol has a value, for every seed.
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
    values: dict[ResultKey, float] = {}
    frames: dict[ResultKey, int] = {}
    problems: dict[ResultKey, str] = {}
    unavailable: dict[ResultKey, str] = {}
    every = rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    for parts, own in every.groupby([*ResultKey._fields], sort=True):
        task, *rest = map(str, parts)
        place = ResultKey(task or AVATAR, *rest)
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
    """Reason why these rows have no number; "" if they have one."""
    bad = own[own["status"] != "ok"]
    if len(bad):
        first = bad.iloc[0]
        return f"{first['status']}: {' '.join(str(first['reason']).split())}"
    if not own["value"].map(lambda value: abs(value) < float("inf")).all():
        return "a value that is not finite"
    if (own["region"] != FULL).all():  # visible in some frames only, which the ground truth determines
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
"""Environment entries that must be equal for speeds to be comparable."""


@dataclass(frozen=True)
class Tolerance:
    """The direction in which a metric is better, and its tolerance.

    A number may differ by ``absolute`` or by ``relative`` times the baseline's value, whichever is larger.
    ``machine_bound`` numbers are judged on request, and only on the baseline's kind of machine.
    """

    higher_is_better: bool
    absolute: float
    relative: float = 0.0
    machine_bound: bool = False
    unit: str = ""
    digits: int = 4

    def __post_init__(self) -> None:
        """Refuse a tolerance with which everything or nothing would pass."""
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
        """The tolerance for a baseline of ``value``."""
        return max(self.absolute, self.relative * abs(value))


@dataclass(frozen=True)
class _File:
    """The content of the file."""

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

    ``frames`` is the number of frames of each value, because the protocol does not state in which frames a
    region is visible. ``unavailable`` are the values that could not be measured when it was made, with the
    reason; they are not required.
    """

    captures: Captures
    environment: Mapping[str, Any]
    protocols: Mapping[str, ProtocolIdentity]
    tolerances: Mapping[str, Tolerance]
    values: Mapping[ResultKey, float]
    frames: Mapping[ResultKey, int]
    unavailable: Mapping[ResultKey, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, results: Results, earlier: Baseline | None = None, captures: Captures | None = None
    ) -> Baseline:
        """Make the baseline of some results, keeping the tolerances of an ``earlier`` one."""
        if results.problems or not results.values:
            problem = next(iter(results.problems.items()), ("rows", "no numbers"))
            raise InputError(results.source, str(problem[0]), "a number for everything measured", problem[1])
        lost = sorted(results.unavailable.keys() & earlier.values.keys()) if earlier else []
        if lost:
            remedy = "Install what is missing, or delete the number from the baseline."
            reason = results.unavailable[lost[0]]
            raise InputError(results.source, str(lost[0]), "a number, as in the baseline", reason, remedy)
        tolerances = earlier.tolerances if earlier else {}
        metrics = sorted({place.metric for place in results.values})
        return cls(
            captures or (earlier.captures if earlier else "same"),
            dict(results.environment),
            dict(results.protocols),
            {name: tolerances.get(name) or Tolerance.default(results.metrics[name]) for name in metrics},
            dict(sorted(results.values.items())),
            dict(sorted(results.frames.items())),
            dict(sorted(results.unavailable.items())),
        )

    @classmethod
    def read(cls, path: Path) -> Baseline:
        """Read a baseline file.

        A file without numbers to judge, or with fewer than it declares, is refused because everything would
        pass.
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
            place = _result_key(key, path, "values")
            if place.metric not in file.tolerances:
                raise InputError(path, "tolerances", f"an entry {place.metric!r}", "none")
            if place.task != AVATAR and place.task not in file.protocols:
                raise InputError(path, "protocols", f"an entry {place.task!r}", "none")
            values[place] = value
        unavailable = {_result_key(key, path, "unavailable"): why for key, why in file.unavailable.items()}
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


def _result_key(key: str, path: Path, group: str) -> ResultKey:
    parts = key.split("/")
    if len(parts) != len(ResultKey._fields) or not all(parts):
        raise InputError(path, f"{group}, {key}", "task/method/subject/region/metric", repr(key))
    return ResultKey(*(check_name(name, path, f"{group}, {key}") for name in parts))
