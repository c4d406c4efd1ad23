"""Claims of a paper against measured values: each is met, missed or not run, with the rows that say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from .aggregate import conditions, summarise, whole_images
from .papers import OF_AVATARS, OF_FRAMES, Claim, Paper, PrintedRow
from .runs import RunSet
from .writers import pipe_table


@dataclass(frozen=True)
class ClaimValue:
    """One value of a claim: printed, measured, and where it was measured. For a sign both are differences of two rows."""

    key: str
    printed: float
    measured: float | None
    """None if it was not measured."""
    holds: bool
    source: str
    """Run folder, methods and number of rows, or the reason why there are none."""


@dataclass(frozen=True)
class JudgedClaim:
    """A claim with its findings, and the grade of the table that printed it."""

    claim: Claim
    grade: str
    findings: tuple[ClaimValue, ...]

    @property
    def status(self) -> Literal["met", "missed", "not run"]:
        """Missed if a measured value does not hold; otherwise not run if a value was not measured."""
        if any(each.measured is not None and not each.holds for each in self.findings):
            return "missed"
        return "met" if all(each.holds for each in self.findings) else "not run"

    def record(self) -> dict[str, Any]:
        """Everything as plain values."""
        return {**asdict(self), "status": self.status}


def judge(paper: Paper, runs: Mapping[str, RunSet]) -> list[JudgedClaim]:
    """Compare every claim with runs.

    Parameters
    ----------
    runs : Mapping[str, RunSet]
        Runs by the name of the table that they measure, by the paper's protocol; tables without runs are not run.
    """
    tables = {table.table: table for table in paper.tables}
    verdicts = []
    for claim in paper.claims:
        rows = {row.name: row for row in tables[claim.table].rows}
        pair = [rows[name] for name in (claim.row, claim.than) if name]
        findings = tuple(_finding(claim, key, pair, runs.get(claim.table)) for key in claim.values)
        verdicts.append(JudgedClaim(claim, tables[claim.table].grade, findings))
    return verdicts


def _finding(claim: Claim, key: str, pair: Sequence[PrintedRow], runs: RunSet | None) -> ClaimValue:
    printed = _difference([float(row.values[key]) for row in pair])
    if runs is None:
        return ClaimValue(key, printed, None, False, f"no run of {claim.table}")
    task, _, metric = key.rpartition("/")
    values, sources, labels = [], [], []
    for row in pair:
        if not (label := measured_label(runs, row)):
            return ClaimValue(key, printed, None, False, f"{row.name} was not run")
        found = summarise(runs.rows, label, metric, task)
        if found.value is None:
            return ClaimValue(key, printed, None, False, f"{label}: {found.reason}")
        count = len(whole_images(runs.rows, label, metric, task))
        values.append(found.value)
        labels.append(label)
        folder = runs.pictured[label][0].folder.root
        sources.append(f"{folder.parent.name}/{folder.name}: {label}, {count} rows")
    if differ := _different_places(runs, metric, labels):
        return ClaimValue(key, printed, None, False, f"{metric} was measured on different machines: {differ}")
    measured = _difference(values)
    higher = (OF_FRAMES if task else OF_AVATARS)[metric][2]
    return ClaimValue(
        key, printed, measured, _holds(claim, key, printed, measured, higher), "; ".join(sources)
    )


def _different_places(runs: RunSet, metric: str, labels: Sequence[str]) -> str:
    """Where a time was measured by method, if that differs, as tables mark it; otherwise ""."""
    specs = [spec for spec in runs.metrics if spec.name == metric]
    places = {
        label: found.text or runs.pictured[label][0].machine
        for label, found in conditions(runs.rows, specs, labels).get(metric, {}).items()
    }
    differ = len({*places.values()}) > 1
    return "; ".join(f"{label}: {place}" for label, place in places.items()) if differ else ""


def _difference(values: Sequence[float]) -> float:
    """The first value, minus the second if there is one."""
    return values[0] - sum(values[1:])


def _holds(claim: Claim, key: str, printed: float, measured: float, higher: bool) -> bool:
    tolerance = claim.values[key]
    if claim.comparison == "sign":
        return (measured if printed > 0 else -measured) > tolerance
    worse = (printed - measured) if higher else (measured - printed)
    return (abs(worse) if claim.comparison == "near" else worse) <= tolerance


def measured_label(runs: RunSet, row: PrintedRow) -> str:
    """Label of the measured method of a printed row, without a condition if there is one; "" if it was not run."""
    labels = [label for label, record in runs.records.items() if row.is_of(record)]
    return min(labels, key=lambda label: bool(runs.records[label].condition), default="")


def claims_text(verdicts: Sequence[JudgedClaim]) -> str:
    """The claims with their verdicts as Markdown."""
    counts = dict.fromkeys(("met", "missed", "not run"), 0)
    lines = [["claim", "verdict", "text", "printed in", "grade"], ["---"] * 5]
    for verdict in verdicts:
        claim, counts[verdict.status] = verdict.claim, counts[verdict.status] + 1
        lines.append([claim.id, f"**{verdict.status}**", claim.text, claim.table, verdict.grade])
    summary = ", ".join(f"{count} {status}" for status, count in counts.items())
    return f"{len(verdicts)} claims: {summary}.\n\n{pipe_table(lines)}"


def values_text(verdicts: Sequence[JudgedClaim]) -> str:
    """Every compared value as Markdown, with the rows that it comes from."""
    lines = [
        ["claim", "value", "compared", "tolerance", "printed", "measured", "holds", "rows"],
        ["---", "---", "---", "--:", "--:", "--:", "---", "---"],
    ]
    for verdict in verdicts:
        claim = verdict.claim
        against = f"{claim.row} - {claim.than}: sign" if claim.than else f"{claim.row}: {claim.comparison}"
        for found in verdict.findings:
            measured = holds = "–"
            if found.measured is not None:
                measured, holds = f"{found.measured:.4g}", "yes" if found.holds else "no"
            numbers = [f"{claim.values[found.key]:g}", f"{found.printed:.4g}", measured]
            lines.append([claim.id, found.key, against, *numbers, holds, found.source])
    return pipe_table(lines)
