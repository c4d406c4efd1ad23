"""Cards of registered methods: source, citation, and the figures that papers printed for them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bench.io.documents import read_json
from ..bench.registry import discover
from ..bench.specs import MethodSpec
from .papers import COMPARABLE, papers

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
    found = []
    for name, paper in papers().items():
        for table in paper.tables:
            if table.grade not in COMPARABLE or "ablation" in table.table:
                continue
            for row in table.rows:
                if row.method == spec.name:
                    own = paper.arxiv in numbers
                    found.append(PrintedFigures(name, table.table, table.data, table.grade, own, row.values))
    return sorted(found, key=lambda figures: not figures.own)


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
        lines = [spec.summary, f"Source: {spec.source}"]
        code = (
            "of headbench, written from the paper"
            if spec.native
            else "of the authors, in a checkout of yours"
        )
        lines.append(f"Code: {code}")
        lines += [f"Printed: {figure_text(figure)}" for figure in figures]
        measured = measured_figures(name)
        lines += [f"Measured: {measured_text(measured)}"] if measured else []
        lines += [spec.bibtex.strip()] if spec.bibtex else []
        text = "\n".join(lines).replace("\n", "\n  ")
        cards.append(
            {
                "name": name,
                "error": "",
                "summary": f"{text}\n",
                "source": spec.source,
                "bibtex": spec.bibtex.strip(),
                "native": spec.native,
                "printed": [vars(figure) for figure in figures],
                "measured": vars(measured) if measured else None,
            }
        )
    return cards


SHOWN = {"novel_view/psnr": "novel view", "self_reenactment/psnr": "self-reenactment", "fps": "speed"}
UNITS = {"fps": "FPS"}


def figure_text(figures: PrintedFigures) -> str:
    """PSNR and speed of a published row as text, with the source."""
    by = "claimed" if figures.own else "run by others"
    return f"{_shown(figures.values)} ({by}: {figures.paper}, {figures.table}, {figures.data}, grade {figures.grade})"


def measured_text(figures: MeasuredFigures) -> str:
    """PSNR and speed in the suite as text."""
    return f"{_shown(figures.values)} (by headbench, {figures.suite}: {figures.data})"


def _shown(values: dict[str, str]) -> str:
    shown = [f"{label} {values[key]} {UNITS.get(key, 'dB')}" for key, label in SHOWN.items() if key in values]
    return ", ".join(shown) or "other metrics"
