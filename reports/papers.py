"""Published tables of papers as data, one file per paper in `published`, and measured tables in their form.

Light to import: without pandas.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..bench.configuration import build_folder, build_named
from ..bench.errors import InputError
from ..bench.specs import MetricKind, MetricSpec

if TYPE_CHECKING:
    from ..bench.manifest import MethodRecord
    from .runs import RunSet
    from .tables import Table
from ..bench.io.documents import read_json
from ..bench.registry import discover
from ..bench.specs import MethodSpec

FOLDER = Path(__file__).with_name("published")

TASKS = ("novel_view", "self_reenactment", "cross_reenactment")
OF_FRAMES = {
    "psnr": ("PSNR", "dB", True),
    "ssim": ("SSIM", "", True),
    "ms_ssim": ("MS-SSIM", "", True),
    "lpips": ("LPIPS", "", False),
    "l1": ("L1", "", False),
    "l2": ("L2", "", False),
    "csim": ("CSIM", "", True),
    "akd": ("AKD", "", False),
    "aed": ("AED", "", False),
    "apd": ("APD", "", False),
    "jod": ("JOD", "", True),
    "fid": ("FID", "", False),
}
OF_AVATARS = {
    "storage": ("Storage", "MB", False),
    "fps": ("Speed", "FPS", True),
    "training_time": ("Training", "min", False),
}
"""Metrics in papers: label, unit, and whether higher values are better; first those of a task, then the others."""

COMPARABLE = ("A", "B")
"""Grades of tables that are shown next to measurements."""


@dataclass(frozen=True)
class PrintedRow:
    """A row of a printed table."""

    name: str  # as printed, like the values
    values: dict[str, str]  # by ``task/metric``, or ``metric`` for one of the avatar as a whole
    method: str = ""  # name of the registered method; "" if it is not registered
    settings: dict[str, Any] = field(default_factory=dict)  # of methods that match this row, by dotted name

    def __post_init__(self) -> None:
        """Refuse values that are not numbers as text, and unknown metrics."""
        if not self.values:
            raise ValueError("values: at least one; found none")
        for key, value in self.values.items():
            task, _, metric = key.rpartition("/")
            if metric not in (OF_FRAMES if task else OF_AVATARS) or task not in ("", *TASKS):
                expected = f"TASK/METRIC of {', '.join(TASKS)} and {', '.join(OF_FRAMES)}; or {', '.join(OF_AVATARS)}"
                raise ValueError(f"values: {expected}; found {key}")
            if not isinstance(value, str) or not re.fullmatch(r"-?\d*\.?\d+", value):
                raise ValueError(f"values, {key}: a number as printed, in quotes; found {value!r}")

    def is_of(self, record: MethodRecord) -> bool:
        """Whether a measured method, as in a run's manifest, matches this row."""

        def setting(name: str) -> Any:
            value: Any = record.config
            for part in name.split("."):
                value = value.get(part) if isinstance(value, Mapping) else None
            return value

        return record.name == self.method and all(setting(n) == value for n, value in self.settings.items())


@dataclass(frozen=True)
class PrintedTable:
    """A table of a paper.

    ``grade`` says how it was read. "A": in the paper's full text or supplement, or in its authors' repository; "B": as the full
    text of another paper quotes it; "C": in a summary.
    """

    table: (
        str  # name, such as "Table 3" or "Table 3 (left part)", or a description if its number was not read
    )
    data: str  # subjects or data set
    conditions: str  # size, split, mask, definitions of metrics, iterations, hardware
    grade: Literal["A", "B", "C"]
    read: str  # where
    rows: tuple[PrintedRow, ...]  # all that were read

    def __post_init__(self) -> None:
        """Refuse tables without rows or with duplicate names of rows."""
        names = [row.name for row in self.rows]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"rows: at least one, each name once; found {', '.join(names) or 'none'}")

    @property
    def number(self) -> str:
        """Number in the paper or, if unknown, name of the table."""
        match = re.match(r"Tables? ([0-9A-Z]+)", self.table)
        return match[1] if match else self.table

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the values of all rows, in the order of the file."""
        return tuple(dict.fromkeys(key for row in self.rows for key in row.values))

    def decimals(self, metric: str) -> int:
        """Maximum number of printed decimals of a metric."""
        values = [v for row in self.rows for key, v in row.values.items() if key.rpartition("/")[2] == metric]
        return max(len(value.partition(".")[2]) for value in values)


@dataclass(frozen=True)
class Claim:
    """A statement of a paper about a row of one of its tables, which measured values confirm or not, see `claims.judge`.

    ``values`` are tolerances by the keys of the row, in the unit of the metric. "near": a measured value differs from the printed
    one by at most the tolerance; "reaches": it is not worse than that; "sign": its difference from that of the row ``than`` has the
    sign of the printed difference, and is larger than the tolerance.
    """

    id: str
    text: str
    table: str
    row: str
    comparison: Literal["near", "reaches", "sign"]
    values: dict[str, float]
    than: str = ""

    def __post_init__(self) -> None:
        """Refuse a sign without a second row, and no values."""
        if (self.comparison == "sign") != bool(self.than):
            raise ValueError(f"than: a row for a comparison by sign, and for no other; found {self.than!r}")
        if not self.values:
            raise ValueError("values: at least one; found none")


@dataclass(frozen=True)
class Paper:
    """A paper, its tables of results and its claims; ``arxiv`` is its number there, None without one."""

    title: str
    venue: str
    arxiv: str | None
    tables: tuple[PrintedTable, ...]
    claims: tuple[Claim, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a paper without tables, and claims about values that are not in them."""
        if self.arxiv is not None and not re.fullmatch(r"\d{4}\.\d{4,5}", self.arxiv):
            raise ValueError(f"arxiv: a number such as 2504.14967, in quotes, or null; found {self.arxiv!r}")
        if not self.tables:
            raise ValueError("tables: at least one; found none")
        printed = {
            (table.table, row.name, key): float(text)
            for table in self.tables
            for row in table.rows
            for key, text in row.values.items()
        }
        for claim, key in ((each, key) for each in self.claims for key in each.values):
            for row in filter(None, (claim.row, claim.than)):
                if (claim.table, row, key) not in printed:
                    raise ValueError(f"claims, {claim.id}: printed values; found {claim.table}, {row}, {key}")
            if claim.than and printed[claim.table, claim.row, key] == printed[claim.table, claim.than, key]:
                raise ValueError(f"claims, {claim.id}: a printed difference; found equal values of {key}")

    @property
    def citation(self) -> str:
        """Title, venue if known, and arXiv number."""
        venue = [] if self.venue == "arXiv" or self.venue.startswith("not stated") else [self.venue]
        return ", ".join([self.title, *venue, *([f"arXiv {self.arxiv}"] if self.arxiv is not None else [])])


@cache
def papers() -> dict[str, Paper]:
    """All papers by name."""
    return build_folder(Paper, FOLDER)


@cache
def paper_named(name: str) -> Paper:
    """Look up a paper. Raises `InputError` for an unknown one."""
    return build_named(Paper, FOLDER, name, "--as")


def printed_tables(name: str, number: str | None) -> tuple[PrintedTable, ...]:
    """The tables of a paper that may be shown next to measurements, or one by number. Raises `InputError` if there is none."""
    tables = [table for table in paper_named(name).tables if table.grade in COMPARABLE]
    requested = tuple(table for table in tables if number is None or table.number == number)
    if not requested:
        offered = ", ".join(dict.fromkeys(table.table for table in tables)) or "none of them read in full"
        option, value = ("--as", name) if number is None else ("--table", number)
        raise InputError("command line", option, f"a table of {name}: {offered}", value)
    return requested


def as_printed(runs: RunSet, name: str, printed: PrintedTable) -> Table:
    """A table with the columns of a published one: measured methods, then the published rows, which are not ranked.

    Values are means over all cameras, as in papers. Methods have the names used in the paper. Of conditions, those are
    shown that are a row of the table by their settings alone. Raises `InputError` if the runs have no task of the table.
    """
    from ..bench.protocol import TASK_TITLES
    from .tables import TableCell, TableRow, build_table

    metrics = _printed_metrics(runs, printed)
    asked = {key.rpartition("/")[0] for key in printed.keys} - {""}
    tasks = [task for task in TASKS if task in asked and task in runs.tasks]
    if asked and not tasks:
        raise InputError(runs.runs[0].folder.root, "tasks", " or ".join(sorted(asked)), ", ".join(runs.tasks))
    names = {label: _printed_name(runs.records[label], label, printed) for label in _measured(runs, printed)}
    name_of_table = f"{name}-{printed.number}"
    measured = build_table(runs.listing([*names]), metrics, tasks, name=name_of_table)
    measured = measured.mapped(lambda row: replace(row, method=names[row.method]))
    rows = []
    for row in printed.rows:
        texts = [_column_text(column.name, row.values.get(column.name, "")) for column in measured.columns]
        cells = (
            TableCell("published", float(text), text) if text else TableCell("none", None, "")
            for text in texts
        )
        rows.append(TableRow(row.name, "", True, tuple(cells)))
    title = f"Printed in {printed.table} of the paper (not comparable): {printed.data}"
    absent = [TASK_TITLES[task] for task in TASKS if task in asked and task not in tasks]
    missing = [f"{task} is printed, but not measured here." for task in absent]
    said = (
        f"Printed values: {paper_named(name).citation}.",
        f"Their conditions: {printed.conditions}. Read in: {printed.read} (grade {printed.grade}).",
    )
    return replace(
        measured,
        groups=(*measured.groups, (title, tuple(rows))),
        missing=(*measured.missing, *missing),
        printed=said,
    )


def _measured(runs: RunSet, printed: PrintedTable) -> list[str]:
    """Labels of the ranked methods, and of conditions whose changed settings, and nothing else, make them a row of the table."""
    conditions = {c.name: c for run in runs.runs for c in run.manifest.configuration.conditions}
    labels = {*runs.ranked}
    for row in printed.rows:
        of_row = {label for label, record in runs.records.items() if row.is_of(record)}
        if of_row.isdisjoint(runs.ranked):
            labels |= {n for n in of_row if conditions[runs.records[n].condition].changes_settings_alone}
    return [label for label in runs.methods if label in labels]


def _printed_metrics(runs: RunSet, printed: PrintedTable) -> list[MetricSpec]:
    """The metrics of a published table with its decimals, even if the runs lack them."""
    measured = {spec.name: spec for spec in runs.metrics}
    used = {key.rpartition("/")[2]: bool(key.rpartition("/")[0]) for key in printed.keys}
    metrics = []
    for metric, of_frames in used.items():
        label, unit, higher = (OF_FRAMES if of_frames else OF_AVATARS)[metric]
        kind: MetricKind = "frame" if of_frames else "avatar"
        spec = measured.get(metric, MetricSpec(metric, label, unit, higher, 0, "", kind=kind))
        # Printed training times are stored in seconds.
        digits = 1 if metric == "training_time" else printed.decimals(metric)
        metrics.append(replace(spec, digits=digits))
    return metrics


def _printed_name(record: MethodRecord, label: str, printed: PrintedTable) -> str:
    for row in printed.rows:
        if row.method and row.is_of(record):
            condition = f" ({record.condition})" if record.condition else ""
            return f"{row.name}{condition}{label.removeprefix(record.label)}"
    return label


def _column_text(name: str, text: str) -> str:
    """A stored value in the unit of its column: training times are stored in seconds and shown in minutes."""
    if not text or name != "training_time":
        return text
    minutes = float(text) / 60
    return f"{minutes:.1f}" if minutes >= 1 else f"{minutes:.2g}"


def listed() -> list[dict[str, Any]]:
    """Name, citation and tables of every paper, for ``headbench list papers``."""
    return [
        {
            "name": name,
            "error": "",
            "summary": f"{paper.citation}: {', '.join(f'{table.table} ({table.grade})' for table in paper.tables)}",
            **asdict(paper),
        }
        for name, paper in papers().items()
    ]


def counts() -> dict[str, dict[str, int]]:
    """Numbers of tables, rows and values of all papers, by grade."""
    tables = [table for paper in papers().values() for table in paper.tables]
    by_grade = {}
    for grade in ("A", "B", "C"):
        of_grade = [table for table in tables if table.grade == grade]
        values = [len(row.values) for table in of_grade for row in table.rows]
        by_grade[grade] = {"tables": len(of_grade), "rows": len(values), "values": sum(values)}
    return by_grade


MEASURED = Path(__file__).with_name("measured.json")
"""Written with the tables of the suite (``docs/_ext/stored_results.py``)."""


@dataclass(frozen=True)
class PrintedFigures:
    """Published values of a method; ``own``: whether by the method's own paper. Values by "task/metric", as printed."""

    paper: str
    table: str
    data: str
    grade: str
    own: bool
    values: dict[str, str]


def printed_figures(spec: MethodSpec) -> list[PrintedFigures]:
    """Rows of a method in all stored tables of grades A and B, those of its own paper first, without ablations."""
    numbers = {*re.findall(r"\d{4}\.\d{4,5}", spec.source)}
    figures = [
        PrintedFigures(name, t.table, t.data, t.grade, paper.arxiv in numbers, row.values)
        for name, paper in papers().items()
        for t in paper.tables
        if t.grade in COMPARABLE and "ablation" not in t.table
        for row in t.rows
        if row.method == spec.name
    ]
    return sorted(figures, key=lambda printed: not printed.own)


@dataclass(frozen=True)
class MeasuredFigures:
    """Values of a method measured in the suite, by "task/metric", as displayed."""

    suite: str
    data: str
    values: dict[str, str]


def measured_figures(name: str) -> MeasuredFigures | None:
    """Values of the named method; None if it is not in the suite."""
    if not MEASURED.is_file():
        return None
    stored = read_json(MEASURED)
    values = stored["methods"].get(name)
    return None if values is None else MeasuredFigures(stored["suite"], stored["data"], values)


def citations() -> list[dict[str, Any]]:
    """A card for every registered method, for ``headbench list methods --cite``: ``summary`` has its text."""
    cards = []
    for name, plugin in discover("methods").items():
        spec = plugin.spec
        if not isinstance(spec, MethodSpec) or not spec.source:
            continue
        figures = printed_figures(spec)
        code = "headbench, written from the paper" if spec.native else "the authors, in a checkout of yours"
        lines = [spec.summary, f"Source: {spec.source}", f"Code: of {code}"]
        for printed in figures:
            by = f"{'claimed' if printed.own else 'run by others'}: {printed.paper}, {printed.table}"
            text = f"{_psnr_and_speed(printed.values)} ({by}, {printed.data}, grade {printed.grade})"
            lines.append(f"Printed: {text}")
        measured = measured_figures(name)
        lines += [f"Measured: {measured_text(measured)}"] if measured else []
        lines += [spec.bibtex.strip()] if spec.bibtex else []
        text = "\n".join(lines).replace("\n", "\n  ")
        card: dict[str, Any] = {"name": name, "error": "", "summary": f"{text}\n", "source": spec.source}
        card |= {"bibtex": spec.bibtex.strip(), "native": spec.native}
        card["printed"] = [vars(figure) for figure in figures]
        cards.append({**card, "measured": vars(measured) if measured else None})
    return cards


SHOWN = {"novel_view/psnr": "novel view", "self_reenactment/psnr": "self-reenactment", "fps": "speed"}
UNITS = {"fps": "FPS"}


def measured_text(figures: MeasuredFigures) -> str:
    """PSNR and speed in the suite as text."""
    return f"{_psnr_and_speed(figures.values)} (by headbench, {figures.suite}: {figures.data})"


def _psnr_and_speed(values: dict[str, str]) -> str:
    shown = [f"{label} {values[key]} {UNITS.get(key, 'dB')}" for key, label in SHOWN.items() if key in values]
    return ", ".join(shown) or "other metrics"


if __name__ == "__main__":  # for `make check`
    from ..bench.protocol import named_protocols

    print(f"{len(papers())} papers, {len(named_protocols())} protocols")
    for grade, numbers in counts().items():
        print(f"grade {grade}: {', '.join(f'{number} {what}' for what, number in numbers.items())}")
