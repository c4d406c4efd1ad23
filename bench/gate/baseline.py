"""The baseline file: numbers, tolerances, protocols and the environment they come from. JSON, one number a line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from ..configuration import build
from ..errors import InputError
from ..files import read_json, write_json
from ..specs import MetricSpec
from .results import Place, ProtocolIdentity, Results
from .settings import Captures

FORMAT = 1
LAST_DIGITS = 10
MACHINE_SHARE = 0.3
KEPT_DIGITS = 3
MACHINE = ("processor", "cores", "device")


@dataclass(frozen=True)
class Tolerance:
    """Which way a metric is better, and how far it may move without a verdict.

    A number may differ by ``absolute`` or by ``relative`` times the baseline's size, whichever is more.
    ``machine_bound`` numbers are judged on the machine of the baseline alone.
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

    @classmethod
    def default(cls, spec: MetricSpec) -> Tolerance:
        """Ten units of the last digit that tables show (0.1 dB of PSNR); for speed and memory 30 % as well."""
        share = MACHINE_SHARE if spec.machine_bound else 0.0
        absolute = round(LAST_DIGITS * 10.0**-spec.digits, spec.digits)
        bound = spec.machine_bound
        return cls(spec.higher_is_better, absolute, share, bound, spec.unit, spec.digits)

    def allowed(self, value: float) -> float:
        """How far a number may lie from a baseline of ``value``."""
        return max(self.absolute, self.relative * abs(value))


@dataclass(frozen=True)
class Baseline:
    """A baseline, read or made from results."""

    captures: Captures
    environment: Mapping[str, Any]
    protocols: Mapping[str, ProtocolIdentity]
    tolerances: Mapping[str, Tolerance]
    values: Mapping[Place, float]

    @classmethod
    def of(
        cls, results: Results, earlier: Baseline | None = None, captures: Captures | None = None
    ) -> Baseline:
        """Make the baseline of some results, with the tolerances of an ``earlier`` one where it has them.

        Raises `InputError` where a number is missing: a baseline with holes would hide what is missing later.
        """
        if results.problems or not results.values:
            problem = next(iter(results.problems.items()), ("rows", "no numbers"))
            raise InputError(results.source, str(problem[0]), "a number for everything measured", problem[1])
        known = earlier.tolerances if earlier else {}
        metrics = sorted({place.metric for place in results.values})
        return cls(
            captures or (earlier.captures if earlier else "same"),
            dict(results.environment),
            dict(results.protocols),
            {name: known.get(name) or Tolerance.default(results.metrics[name]) for name in metrics},
            dict(sorted(results.values.items())),
        )

    @classmethod
    def read(cls, path: Path) -> Baseline:
        """Read a baseline file. Raises `InputError` naming what is missing or malformed."""
        record = read_json(path)
        if record.get("format") != FORMAT:
            raise InputError(path, "format", str(FORMAT), repr(record.get("format")))
        parts = {
            name: _mapping(path, name, record.get(name))
            for name in ("environment", "protocols", "tolerances", "values")
        }
        if record.get("captures") not in get_args(Captures):
            expected = " or ".join(get_args(Captures))
            raise InputError(path, "captures", expected, repr(record.get("captures")))
        protocols = {
            task: build(
                ProtocolIdentity, _mapping(path, f"protocols.{task}", value), str(path), f"protocols.{task}."
            )
            for task, value in parts["protocols"].items()
        }
        tolerances = {
            name: build(
                Tolerance, _mapping(path, f"tolerances.{name}", value), str(path), f"tolerances.{name}."
            )
            for name, value in parts["tolerances"].items()
        }
        values = {}
        for key, value in parts["values"].items():
            place = Place.parse(key)
            if place is None:
                raise InputError(path, f"values, {key}", "task/method/subject/region/metric", repr(key))
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise InputError(path, f"values, {key}", "a finite number", repr(value))
            if place.metric not in tolerances:
                raise InputError(path, "tolerances", f"an entry {place.metric!r}", "none")
            values[place] = float(value)
        return cls(record["captures"], parts["environment"], protocols, tolerances, values)

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
            "values": values,
        }
        write_json(path, record)

    def same_machine(self, environment: Mapping[str, Any]) -> bool:
        """Whether speed measured in an environment compares with the baseline's."""
        return all(self.environment.get(name) == environment.get(name) for name in MACHINE)


def _mapping(path: Path, key: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(path, key, "a JSON object", repr(value)[:60])
    return value
