"""Plots quality over training conditions, with one panel per metric."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes

from ..plots import MARKERS, SMALL, cost_axis, plot_file, show_missing, start_axes


@dataclass(frozen=True)
class CurvePanel:
    """One plot: (cost, quality, half the interval's width) of each method; ``reason`` if empty."""

    title: str
    lines: Mapping[str, Sequence[tuple[float, float, float]]]
    reason: str


def write_plot(path: Path, rows: Sequence[Sequence[CurvePanel]], cost: str, note: str) -> None:
    """Draw rows of panels of equal number and write a PNG, atomically; costs on a logarithmic axis if all are above 0."""
    names = (name for row in rows for panel in row for name in panel.lines)
    size = (4.2 * len(rows[0]), 3.2 * len(rows) + 0.8)
    with plot_file(path, size, 150, names, note, line="-", markers=MARKERS) as (figure, looks):
        grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for axes, panel in zip(grid.ravel(), itertools.chain(*rows)):
            _draw(axes, panel, cost, looks)


def _draw(axes: Axes, panel: CurvePanel, cost: str, looks: Mapping[str, tuple[str, str]]) -> None:
    start_axes(axes, panel.title)
    axes.set_xlabel(cost, fontsize=SMALL)
    if not any(panel.lines.values()):
        show_missing(axes, textwrap.fill(f"missing: {panel.reason or 'the trainings failed'}", 44))
        return
    for name, points in panel.lines.items():
        if points:
            costs, values, halves = zip(*points)
            bars = halves if any(halves) else None
            colour, marker = looks[name]
            line = axes.errorbar(costs, values, bars, color=colour, linewidth=1.2, capsize=2)
            line.lines[0].set(marker=marker, markersize=4)
    each = [paid for line in panel.lines.values() for paid, _, _ in line]
    cost_axis(axes, logarithmic=min(each) > 0, whole=all(paid == round(paid) for paid in each))
