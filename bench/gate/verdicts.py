"""Results against a baseline: a verdict for every number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ..errors import ExitCode, shortened
from ..runner.scoring import FULL
from .baseline import Baseline, Tolerance
from .results import Place, Results

Outcome = Literal["pass", "regressed", "improved", "missing", "new", "unjudged"]
ORDER: tuple[Outcome, ...] = ("missing", "regressed", "improved", "new", "unjudged", "pass")
ROUNDING = 1e-9
"""Share of a tolerance that is rounding: a number moved by exactly the tolerance passes."""


@dataclass(frozen=True)
class Verdict:
    """What became of one number. ``unjudged``: bound to a machine, and measured on another one."""

    place: Place
    outcome: Outcome
    found: float | None = None
    baseline: float | None = None
    tolerance: Tolerance | None = None
    reason: str = ""

    @property
    def change(self) -> float | None:
        """Found minus baseline."""
        return None if self.found is None or self.baseline is None else self.found - self.baseline

    def __str__(self) -> str:
        place = self.place
        region = "" if place.region == FULL else f" ({place.region})"
        what = f"{place.metric}{region} of {place.method}, subject {place.subject}, {place.task}"
        if self.outcome == "missing" or self.found is None:
            return f"{what}: missing: {self.reason}"
        digits, unit = (self.tolerance.digits, self.tolerance.unit) if self.tolerance else (4, "")
        unit = f" {unit}" if unit else ""
        if self.baseline is None or self.tolerance is None:
            return f"{what}: new: {_shown(self.found, digits)}{unit}"
        moved = self.found - self.baseline
        allowed = self.tolerance.allowed(self.baseline)
        return (
            f"{what}: {self.outcome}: {_shown(self.baseline, digits)} to {_shown(self.found, digits)}{unit}, "
            f"{_shown(moved, digits + 1, '+')}{unit} (tolerance {_shown(allowed, digits + 1)})"
            f"{self.reason and ': ' + self.reason}"
        )


def _shown(value: float, digits: int, sign: str = "") -> str:
    """A number with so many digits behind the point; one too large for that to mean anything, in powers of ten."""
    return f"{value:{sign}.{digits}f}" if abs(value) < 1e15 else f"{value:{sign}g}"


def judge(results: Results, baseline: Baseline) -> list[Verdict]:
    """Give every number of baseline and results its verdict, the gravest first.

    Numbers of a task whose protocol is not the baseline's are missing: they were measured, but of something else.
    """
    other = _other_protocols(results, baseline)
    same_machine = baseline.same_machine(results.environment)
    verdicts = []
    for place, expected in baseline.values.items():
        tolerance = baseline.tolerances[place.metric]
        found = results.values.get(place)
        if place.task in other:
            verdicts.append(Verdict(place, "missing", None, expected, tolerance, other[place.task]))
        elif found is None:
            reason = (
                results.problems.get(place) or results.unavailable.get(place) or "no rows; was it measured?"
            )
            verdicts.append(Verdict(place, "missing", None, expected, tolerance, reason))
        elif results.frames[place] < baseline.frames[place]:
            reason = f"{results.frames[place]} frames, {baseline.frames[place]} in the baseline"
            verdicts.append(Verdict(place, "missing", None, expected, tolerance, reason))
        elif tolerance.machine_bound and not same_machine:
            reason = "measured on another machine"
            verdicts.append(Verdict(place, "unjudged", found, expected, tolerance, reason))
        else:
            verdicts.append(Verdict(place, _outcome(found, expected, tolerance), found, expected, tolerance))
    lacking = {
        **results.problems,
        **{p: r for p, r in results.unavailable.items() if p not in baseline.unavailable},
    }
    for place in {**results.values, **lacking}.keys() - baseline.values.keys():
        tolerance = Tolerance.default(results.metrics[place.metric])
        if place in lacking:
            reason = f"{lacking[place]} (not in the baseline either)"
            verdicts.append(Verdict(place, "missing", None, None, tolerance, reason))
        else:
            verdicts.append(Verdict(place, "new", results.values[place], None, tolerance))
    return sorted(verdicts, key=lambda verdict: (ORDER.index(verdict.outcome), verdict.place))


def exit_code(verdicts: Sequence[Verdict]) -> ExitCode:
    """3 where a number is missing, since what cannot be compared is not judged; else 1 where one regressed."""
    outcomes = {verdict.outcome for verdict in verdicts}
    if "missing" in outcomes or not verdicts:
        return ExitCode.NO_VERDICT
    return ExitCode.NEGATIVE if "regressed" in outcomes else ExitCode.OK


MAX_NOTE = 400
"""Characters of a note on what differs between environments."""


def environment_changes(baseline: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """What differs between two environments, as "name: before to now"."""
    before, now = _flat(baseline), _flat(found)
    return [
        shortened(f"{name}: {before.get(name)} to {now.get(name)}", MAX_NOTE)
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    ]


def _outcome(found: float, expected: float, tolerance: Tolerance) -> Outcome:
    better = found - expected if tolerance.higher_is_better else expected - found
    allowed = tolerance.allowed(expected) * (1.0 + ROUNDING) + ROUNDING * abs(expected)
    if better < -allowed:
        return "regressed"
    return "improved" if better > allowed else "pass"


def _other_protocols(results: Results, baseline: Baseline) -> dict[str, str]:
    """Tasks measured by another protocol than the baseline's, and how it differs."""
    other = {}
    for task, expected in baseline.protocols.items():
        found = results.protocols.get(task)
        if found is None:
            continue  # its numbers are missing one by one
        agrees = found.hash == expected.hash
        if baseline.captures == "remade":
            agrees = found.design == expected.design
        if not agrees:
            what = "other captures" if found.design == expected.design else "other frames or settings"
            other[task] = f"protocol {found.hash}, the baseline's is {expected.hash}: {what}"
    return other


def _flat(record: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat
