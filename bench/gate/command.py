"""``headbench compare --baseline``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from ..errors import ExitCode, InputError, shortened
from ..io.files import check_writable, write_text
from ..io.style import escape_markdown
from ..specs import CommandResult
from .baseline import MACHINE, Baseline, Captures, ResultKey, Results, Tolerance, read_results

Outcome = Literal["pass", "regressed", "improved", "missing", "new", "unjudged"]
ORDER: tuple[Outcome, ...] = ("missing", "regressed", "improved", "new", "unjudged", "pass")
NOT_JUDGED = "such metrics depend on the machine and its load; --judge-speed judges them"
ROUNDING = 1e-9
"""Fraction of a tolerance that is allowed for rounding: a difference of exactly the tolerance passes."""


@dataclass(frozen=True)
class Verdict:
    """Verdict on a number. ``unjudged``: it depends on the machine, and is not to be judged or is from
    another one."""

    place: ResultKey
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
        what = f"{place.measured} of {place.method}, subject {place.subject}, {place.task}"
        if self.found is None:
            return f"{what}: {self.outcome}: {self.reason}"
        digits, unit = (self.tolerance.digits, self.tolerance.unit) if self.tolerance else (4, "")
        unit = f" {unit}" if unit else ""
        if self.baseline is None or self.tolerance is None:
            return f"{what}: {self.outcome}: {_shown(self.found, digits)}{unit}{self.reason and ': ' + self.reason}"
        moved = self.found - self.baseline
        allowed = self.tolerance.allowed(self.baseline)
        return (
            f"{what}: {self.outcome}: {_shown(self.baseline, digits)} to {_shown(self.found, digits)}{unit}, "
            f"{_shown(moved, digits + 1, '+')}{unit} (tolerance {_shown(allowed, digits + 1)})"
            f"{self.reason and ': ' + self.reason}"
        )


def _shown(value: float, digits: int, sign: str = "") -> str:
    """Format a number with a fixed number of decimals; very large numbers use scientific notation."""
    return f"{value:{sign}.{digits}f}" if abs(value) < 1e15 else f"{value:{sign}g}"


def judge(results: Results, baseline: Baseline, *, speed: bool = False) -> list[Verdict]:
    """Give every number of baseline and results a verdict, most severe first.

    Numbers of a task with another protocol than the baseline's are missing, since they measure something
    else. ``speed``: also judge machine-bound numbers, if both were measured on the same machine; otherwise
    they are unjudged, even if they are missing.
    """
    other = _other_protocols(results, baseline)
    same_machine = all(baseline.environment.get(name) == results.environment.get(name) for name in MACHINE)
    verdicts = []
    for place, expected in baseline.values.items():
        tolerance = baseline.tolerances[place.metric]
        value = results.values.get(place)
        outcome: Outcome = "missing"
        reason = other.get(place.task, "")
        if tolerance.machine_bound and not speed:
            outcome, reason = "unjudged", NOT_JUDGED
        elif reason:
            value = None
        elif value is None:
            excuse = results.problems.get(place) or results.unavailable.get(place)
            reason = excuse or "no rows; was it measured?"
        elif results.frames[place] < baseline.frames[place]:
            value, reason = None, f"{results.frames[place]} frames, {baseline.frames[place]} in the baseline"
        elif tolerance.machine_bound and not same_machine:
            outcome, reason = "unjudged", "measured on another machine"
        else:
            outcome = _outcome(value, expected, tolerance)
        verdicts.append(Verdict(place, outcome, value, expected, tolerance, reason))
    unavailable = {p: r for p, r in results.unavailable.items() if p not in baseline.unavailable}
    lacking = {**results.problems, **unavailable}
    for place in {**results.values, **lacking}.keys() - baseline.values.keys():
        tolerance = Tolerance.default(results.metrics[place.metric])
        if tolerance.machine_bound and not speed:
            verdicts.append(
                Verdict(place, "unjudged", results.values.get(place), None, tolerance, NOT_JUDGED)
            )
        elif place in lacking:
            reason = f"{lacking[place]} (not in the baseline either)"
            verdicts.append(Verdict(place, "missing", None, None, tolerance, reason))
        else:
            verdicts.append(Verdict(place, "new", results.values[place], None, tolerance))
    return sorted(verdicts, key=lambda verdict: (ORDER.index(verdict.outcome), verdict.place))


def exit_code(verdicts: Sequence[Verdict]) -> ExitCode:
    """3 if a number is missing or none was judged, since then no verdict is possible; else 1 if one
    regressed."""
    outcomes = {verdict.outcome for verdict in verdicts} - {"unjudged"}
    if "missing" in outcomes or not outcomes:
        return ExitCode.NO_VERDICT
    return ExitCode.NEGATIVE if "regressed" in outcomes else ExitCode.OK


MAX_NOTE = 400
"""Maximum characters of a note on the difference between environments."""


def environment_changes(baseline: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """The difference of two environments, as "name: before to now"."""
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
    """Tasks measured by another protocol than the baseline's, and the difference."""
    other = {}
    for task, expected in baseline.protocols.items():
        measured = results.protocols.get(task)
        if measured is None:
            continue  # its numbers are missing one by one
        agrees = measured.hash == expected.hash
        if baseline.captures == "remade":
            agrees = measured.design == expected.design
        if not agrees:
            what = "other captures" if measured.design == expected.design else "other frames or settings"
            other[task] = f"protocol {measured.hash}, the baseline's is {expected.hash}: {what}"
    return other


def _flat(record: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def unjudged_notes(verdicts: Sequence[Verdict]) -> list[str]:
    """A note for each reason why numbers were not judged, with the metrics."""
    places: dict[str, list[ResultKey]] = {}
    for verdict in verdicts:
        if verdict.outcome == "unjudged":
            places.setdefault(verdict.reason, []).append(verdict.place)
    return [
        f"Not judged, {len(group)} numbers of {', '.join(sorted({place.metric for place in group}))}: {reason}."
        for reason, group in places.items()
    ]


SHOWN = 20
TITLES = {0: "nothing got worse", 1: "regressed", 3: "missing or invalid"}


def headline(verdicts: Sequence[Verdict], code: int) -> str:
    """One line with the outcome and the count of each verdict."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    counted = ", ".join(f"{counts[outcome]} {outcome}" for outcome in ORDER if counts[outcome])
    return f"Gate: {TITLES[code]} ({counted or 'no numbers'})"


def to_text(verdicts: Sequence[Verdict], code: int, notes: Sequence[str]) -> str:
    """Headline, all judged numbers that did not pass (most severe first), and notes."""
    others = [verdict for verdict in verdicts if verdict.outcome not in ("pass", "unjudged")]
    lines = [headline(verdicts, code), *(f"  {verdict}" for verdict in others[:SHOWN])]
    if len(others) > SHOWN:
        lines.append(f"  and {len(others) - SHOWN} more")
    return "\n".join([*lines, *notes])


def to_markdown(verdicts: Sequence[Verdict], code: int, notes: Sequence[str]) -> str:
    """A summary: a table of the numbers that did not pass, the others folded below."""
    lines = [f"### {headline(verdicts, code)}", ""]
    others = [verdict for verdict in verdicts if verdict.outcome != "pass"]
    rest = [verdict for verdict in verdicts if verdict.outcome == "pass"]
    if others:
        lines += [*_table(others), ""]
    if rest:
        lines += [f"<details><summary>{len(rest)} passed</summary>", "", *_table(rest), "", "</details>", ""]
    lines += [f"- {escape_markdown(note)}" for note in notes]
    return "\n".join(lines).rstrip() + "\n"


def to_junit(verdicts: Sequence[Verdict], notes: Sequence[str]) -> str:
    """JUnit XML with a suite for each task: regressed is a failure, missing an error, unjudged skipped."""
    root = ElementTree.Element("testsuites", name="headbench compare", time="0")
    for task in dict.fromkeys(verdict.place.task for verdict in verdicts):
        of_task = [verdict for verdict in verdicts if verdict.place.task == task]
        counts = Counter(verdict.outcome for verdict in of_task)
        numbers = {"tests": len(of_task), "failures": counts["regressed"]}
        numbers |= {"errors": counts["missing"], "skipped": counts["unjudged"], "time": 0}
        attributes = {"name": _xml(task), **{name: str(number) for name, number in numbers.items()}}
        suite = ElementTree.SubElement(root, "testsuite", attributes)
        for verdict in of_task:
            place = verdict.place
            name = _xml(f"{place.metric} {place.region} subject {place.subject}")
            case = ElementTree.SubElement(
                suite, "testcase", classname=_xml(f"{task}.{place.method}"), name=name, time="0"
            )
            kind = {"regressed": "failure", "missing": "error", "unjudged": "skipped"}.get(verdict.outcome)
            if kind:
                ElementTree.SubElement(case, kind, message=_xml(str(verdict)))
            else:
                ElementTree.SubElement(case, "system-out").text = _xml(str(verdict))
        ElementTree.SubElement(suite, "system-out").text = _xml("\n".join(notes))
    return _document(root)


def failed_markdown(message: str) -> str:
    """The summary for missing or invalid results or baseline."""
    return f"### Gate: {TITLES[3]}\n\n{escape_markdown(message)}\n"


def failed_junit(message: str) -> str:
    """The JUnit XML for missing or invalid results or baseline: one test case, with an error."""
    root = ElementTree.Element("testsuites", name="headbench compare", time="0")
    counts = {"tests": "1", "failures": "0", "errors": "1", "skipped": "0", "time": "0"}
    suite = ElementTree.SubElement(root, "testsuite", {"name": "gate", **counts})
    case = ElementTree.SubElement(suite, "testcase", classname="gate", name="results and baseline", time="0")
    ElementTree.SubElement(case, "error", message=_xml(message))
    return _document(root)


def _document(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _table(verdicts: Sequence[Verdict]) -> list[str]:
    lines = [
        "| verdict | task | method | subject | metric | baseline | found | change | tolerance |",
        "| :-- | :-- | :-- | :-- | :-- | --: | --: | --: | --: |",
    ]
    for verdict in verdicts:
        place, tolerance = verdict.place, verdict.tolerance
        digits = tolerance.digits if tolerance else 4
        unit = f" ({tolerance.unit})" if tolerance and tolerance.unit else ""
        allowed = None
        if tolerance is not None and verdict.baseline is not None:
            allowed = tolerance.allowed(verdict.baseline)
        values = (verdict.baseline, verdict.found, verdict.change, allowed)
        forms = (f".{digits}f", f".{digits}f", f"+.{digits + 1}f", f".{digits + 1}f")
        numbers = ["" if value is None else format(value, form) for value, form in zip(values, forms)]
        numbers[1] = numbers[1] or verdict.reason
        named = [verdict.outcome, place.task, place.method, place.subject, f"{place.measured}{unit}"]
        lines.append("| " + " | ".join(escape_markdown(cell) for cell in [*named, *numbers]) + " |")
    return lines


def _xml(text: str) -> str:
    """Text without the control characters that XML cannot hold."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)


def compare_with_baseline(
    run: Path,
    baseline: Path,
    *,
    update: bool = False,
    captures: Captures | None = None,
    judge_speed: bool = False,
    junit: str | None = None,
    markdown: str | None = None,
) -> CommandResult:
    """Compare a run with a committed baseline: exit code 1 if a number got worse, 3 if one is missing.

    Results or a baseline that are missing or invalid are a finding too, with exit code 3, so that CI does not
    take them for a usage error. Nothing is written then but the reports asked for, which say so.
    """
    for option, path in (("--junit", junit), ("--markdown", markdown)):
        if path is not None:
            check_writable(Path(path), option)
            Path(path).unlink(missing_ok=True)  # a report of an earlier run could be mistaken for this one's
    if update:
        check_writable(baseline, "--baseline")
    try:
        if update:
            return _update(run, baseline, captures)
        result, xml, text = _judge(run, baseline, judge_speed)
    except InputError as error:
        xml, text = failed_junit(str(error)), failed_markdown(str(error))
        message = f"Gate: missing or invalid: {error}"
        result = CommandResult(message, {"error": str(error)}, False, ExitCode.NO_VERDICT)
    for path, content in ((junit, xml), (markdown, text)):
        if path is not None:
            write_text(Path(path), content)
    return result


def _judge(run: Path, baseline_file: Path, speed: bool) -> tuple[CommandResult, str, str]:
    """The result, and its reports as JUnit XML and Markdown."""
    baseline, results = Baseline.read(baseline_file), read_results(run)
    verdicts = judge(results, baseline, speed=speed)
    code = exit_code(verdicts)
    changes = environment_changes(baseline.environment, results.environment)
    notes = [*unjudged_notes(verdicts), *(f"Environment changed: {change}." for change in changes)]
    if baseline.captures == "remade":
        notes.append("Captures were made again for these results, as the baseline declares.")
    unavailable = results.unavailable.keys() & baseline.unavailable.keys()
    if unavailable:
        notes.append(f"Unavailable here as in the baseline: {len(unavailable)} numbers.")
    if any(verdict.outcome in ("improved", "new") for verdict in verdicts) and code == 0:
        notes.append("The baseline can be brought up to date with --update.")
    data = {
        "code": code,
        "verdicts": [{**asdict(v), "place": str(v.place), "change": v.change} for v in verdicts],
        "environment_changes": changes,
    }
    result = CommandResult(to_text(verdicts, code, notes), data, code == 0, code)
    return result, to_junit(verdicts, notes), to_markdown(verdicts, code, notes)


def _update(run: Path, path: Path, captures: Captures | None) -> CommandResult:
    earlier = Baseline.read(path) if path.exists() else None
    results = read_results(run)
    baseline = Baseline.of(results, earlier, captures)
    verdicts = judge(results, earlier) if earlier else []
    gone = sorted(earlier.values.keys() - baseline.values.keys()) if earlier else []
    before = earlier.frames if earlier else {}
    baseline.write(path)
    lines = [f"{path}: {len(baseline.values)} numbers written."]
    lines += [
        f"  was: {verdict}" for verdict in verdicts if verdict.outcome not in ("pass", "missing", "unjudged")
    ]
    for place, count in baseline.frames.items():
        if before.get(place, count) != count:
            lines.append(f"  frames: {place}: {before[place]} to {count}")
    lines += [f"  gone: {place}" for place in gone]
    by_reason: dict[str, list[str]] = {}
    for place, reason in baseline.unavailable.items():
        by_reason.setdefault(reason, []).append(str(place))
    lines += [f"  unavailable: {', '.join(places)}: {reason}" for reason, places in by_reason.items()]
    data = {"baseline": path, "values": len(baseline.values), "gone": [str(place) for place in gone]}
    return CommandResult("\n".join(lines), data, True, 0)
