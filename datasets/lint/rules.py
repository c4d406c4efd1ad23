"""Components of a check of the linter: a rule, its hits, and the resulting findings."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from ...bench.progress import some

if TYPE_CHECKING:
    from ..ga.transforms import FrameEntry
    from .evidence import Evidence

Severity = Literal["error", "warning", "note"]
"""error: results of this capture would be wrong or it cannot be read; warning: they may be wrong; note: information."""

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


class Hit(NamedTuple):
    """A fault found by a check, and its place."""

    message: str
    file: Path | str = ""
    key: str = ""


def at(entry: FrameEntry, key: str) -> tuple[Path, str]:
    """File and key of a hit in a frame's entry."""
    return entry.file, f"{entry.where}.{key}"


@dataclass(frozen=True)
class Rule:
    """A check with its code."""

    code: str
    """Stable name, "HB" and three digits; the first digit is the subject (see `catalogue`)."""
    severity: Severity
    title: str
    """The fault in a few words."""
    remedy: str
    """How to fix it."""
    check: Callable[[Evidence], Iterable[Hit]]
    """Function from evidence to hits; no hits if the data that it needs could not be read."""
    of_layout: bool = False
    """Whether it checks files of the GaussianAvatars/VHAP layout; skipped for captures of other readers."""
    refused: bool = False
    """Whether the layout's reader refuses a capture with this error. All other errors are searched for before a run, see
    `before_run`."""


@dataclass(frozen=True)
class Finding:
    """One line of the linter's report."""

    code: str
    severity: Severity
    message: str
    remedy: str
    file: str
    key: str


def rule(
    code: str, severity: Severity, *, of_layout: bool = False, refused: bool = False
) -> Callable[[Callable[[Evidence], Iterable[Hit]]], Rule]:
    """Make a rule of a check. The check's docstring gives the title in its first line, and the remedy below."""

    def make(check: Callable[[Evidence], Iterable[Hit]]) -> Rule:
        title, _, remedy = inspect.cleandoc(check.__doc__ or "").partition("\n\n")
        title = title[:1].lower() + title[1:].removesuffix(".")
        return Rule(code, severity, title, " ".join(remedy.split()), check, of_layout, refused)

    return make


def apply(
    rules: Sequence[Rule], evidence: Evidence, ignore: Collection[str] = (), *, base: Path | None = None
) -> list[Finding]:
    """Run the rules over the evidence; findings in order of severity, then code. Paths below ``base`` are reported
    relative to it."""
    findings = [
        Finding(rule.code, rule.severity, hit.message, rule.remedy, _relative(hit.file, base), hit.key)
        for rule in rules
        if rule.code not in ignore and (evidence.of_layout or not rule.of_layout)
        for hit in rule.check(evidence)
    ]
    findings = [finding for finding in findings if not _is_repeated(finding, findings)]
    return sorted(findings, key=lambda f: (SEVERITIES.index(f.severity), f.code))


REFUSAL = "HB100"
"""The rule that reports the first error of the reader."""


def _is_repeated(finding: Finding, findings: Sequence[Finding]) -> bool:
    """Whether it is the first error of the reader and another rule reports an error at the same place."""
    return finding.code == REFUSAL and any(
        other.code != REFUSAL
        and other.severity == "error"
        and (other.file, other.key) == (finding.file, finding.key)
        for other in findings
    )


def spans(numbers: Iterable[int], limit: int = 4) -> str:
    """Integers as ranges: "0-3, 7, 9-10"."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return some((f"{a}" if a == b else f"{a}-{b}" for a, b in runs), limit)


def _relative(file: Path | str, base: Path | None) -> str:
    """Path relative to ``base`` if it is below it, without ".."; other paths are unchanged."""
    if base is None or not str(file):
        return str(file)
    path = Path(os.path.normpath(file))
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else str(file)
