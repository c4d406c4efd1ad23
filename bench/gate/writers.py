"""Verdicts for a terminal, as Markdown, and as JUnit XML, which every CI service shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from xml.etree import ElementTree

from ..runner.scoring import FULL
from .verdicts import ORDER, Verdict

SHOWN = 20
TITLES = {0: "nothing got worse", 1: "regressed", 3: "missing or invalid"}


def headline(verdicts: Sequence[Verdict], code: int) -> str:
    """One line: the outcome and how many of each verdict."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    counted = ", ".join(f"{counts[outcome]} {outcome}" for outcome in ORDER if counts[outcome])
    return f"Gate: {TITLES[code]} ({counted or 'no numbers'})"


def to_text(verdicts: Sequence[Verdict], code: int, notes: Sequence[str]) -> str:
    """Headline, everything that did not simply pass (the gravest first), notes."""
    told = [verdict for verdict in verdicts if verdict.outcome != "pass"]
    lines = [headline(verdicts, code), *(f"  {verdict}" for verdict in told[:SHOWN])]
    if len(told) > SHOWN:
        lines.append(f"  and {len(told) - SHOWN} more")
    return "\n".join([*lines, *notes])


def to_markdown(verdicts: Sequence[Verdict], code: int, notes: Sequence[str]) -> str:
    """A summary: what did not pass in a table, the rest folded below."""
    lines = [f"### {headline(verdicts, code)}", ""]
    told = [verdict for verdict in verdicts if verdict.outcome != "pass"]
    rest = [verdict for verdict in verdicts if verdict.outcome == "pass"]
    if told:
        lines += [*_table(told), ""]
    if rest:
        lines += [f"<details><summary>{len(rest)} passed</summary>", "", *_table(rest), "", "</details>", ""]
    lines += [f"- {_escaped(note)}" for note in notes]
    return "\n".join(lines).rstrip() + "\n"


def to_junit(verdicts: Sequence[Verdict], notes: Sequence[str]) -> str:
    """JUnit XML: a suite for each task; regressed is a failure, missing an error, unjudged skipped."""
    root = ElementTree.Element("testsuites", name="headbench gate")
    for task in dict.fromkeys(verdict.place.task for verdict in verdicts):
        own = [verdict for verdict in verdicts if verdict.place.task == task]
        counts = Counter(verdict.outcome for verdict in own)
        suite = ElementTree.SubElement(
            root,
            "testsuite",
            name=_xml(task),
            tests=str(len(own)),
            failures=str(counts["regressed"]),
            errors=str(counts["missing"]),
            skipped=str(counts["unjudged"]),
        )
        for verdict in own:
            place = verdict.place
            name = f"{place.metric} {place.region} subject {place.subject}"
            case = ElementTree.SubElement(
                suite, "testcase", classname=_xml(f"{task}.{place.method}"), name=_xml(name)
            )
            kind = {"regressed": "failure", "missing": "error", "unjudged": "skipped"}.get(verdict.outcome)
            if kind:
                ElementTree.SubElement(case, kind, message=_xml(str(verdict)))
            else:
                ElementTree.SubElement(case, "system-out").text = _xml(str(verdict))
        ElementTree.SubElement(suite, "system-out").text = _xml("\n".join(notes))
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
        metric = place.metric if place.region == FULL else f"{place.metric} ({place.region})"
        unit = f" ({tolerance.unit})" if tolerance and tolerance.unit else ""
        allowed = None
        if tolerance is not None and verdict.baseline is not None:
            allowed = tolerance.allowed(verdict.baseline)
        numbers = [
            _number(verdict.baseline, f".{digits}f"),
            _number(verdict.found, f".{digits}f") or verdict.reason,
            _number(verdict.change, f"+.{digits + 1}f"),
            _number(allowed, f".{digits + 1}f"),
        ]
        named = [verdict.outcome, place.task, place.method, place.subject, f"{metric}{unit}"]
        lines.append("| " + " | ".join(_escaped(cell) for cell in [*named, *numbers]) + " |")
    return lines


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _escaped(text: str) -> str:
    """Text that stays in its cell of a Markdown table and is no markup."""
    for character in "\\|<>*_`[]":
        text = text.replace(character, f"\\{character}")
    return " ".join(text.split())


def _xml(text: str) -> str:
    """Text without the control characters that XML cannot hold."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)
