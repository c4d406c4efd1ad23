"""Lines of quality over training time, a panel for each metric."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from ...bench.io.files import atomic_path
from ..drawing import LINE, MUTED
from ..pareto.plot import COLOURS, SMALL


@dataclass(frozen=True)
class Panel:
    """One plot: (seconds, quality) of each method's points, by rising part; ``reason`` why there are none."""

    title: str
    lines: Mapping[str, Sequence[tuple[float, float]]]
    reason: str


def write_plot(path: Path, rows: Sequence[Sequence[Panel]], cost: str, note: str) -> None:
    """Draw rows of panels of equal number and write a PNG, atomically. Seconds are above 0, on a logarithmic axis."""
    names = dict.fromkeys(name for row in rows for panel in row for name in panel.lines)
    colours = dict(zip(names, itertools.cycle(COLOURS)))
    with style.context(["default", {"text.parse_math": False, "font.size": 10}]):
        size = (4.2 * len(rows[0]), 3.2 * len(rows) + 0.8)
        figure = Figure(figsize=size, dpi=150, layout="constrained")
        figure.supxlabel(note, x=0.01, ha="left", fontsize=SMALL, color=MUTED)
        handles = [Line2D([], [], marker="o", color=c, label=name) for name, c in colours.items()]
        figure.legend(handles=handles, loc="outside upper left", ncols=8, fontsize=SMALL, frameon=False)
        grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for axes, panel in zip(grid.ravel(), itertools.chain(*rows)):
            _draw(axes, panel, cost, colours)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")


def _draw(axes: Axes, panel: Panel, cost: str, colours: Mapping[str, str]) -> None:
    axes.set_title(panel.title, loc="left", fontsize=10)
    axes.set_xlabel(cost, fontsize=SMALL)
    axes.spines[["top", "left", "right"]].set_visible(False)
    if not any(panel.lines.values()):
        text = textwrap.fill(f"missing: {panel.reason or 'the trainings failed'}", 44)
        axes.text(0.5, 0.5, text, color=MUTED, ha="center", va="center", transform=axes.transAxes)
        axes.set(xticks=[], yticks=[])
        return
    for name, points in panel.lines.items():
        if points:
            axes.plot(*zip(*points), marker="o", markersize=4, linewidth=1.2, color=colours[name])
    axes.set_xscale("log")
    axes.margins(0.08, 0.12)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", color=LINE, linewidth=0.5)
    axes.tick_params(labelsize=SMALL, labelcolor=MUTED)
