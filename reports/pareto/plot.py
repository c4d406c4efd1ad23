"""Scatter plots of quality over costs, the Pareto front as a line."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator
from matplotlib.transforms import Bbox

from ...bench.io.files import atomic_path

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's, told apart with any colour vision."""
MUTED = "#6e6e6e"
SMALL = 8
MARKER = 7.0
"""Diameter of a point, in points of 1/72 inch."""
BESIDE = ((7, -8, "left"), (-7, 3, "right"), (7, 3, "left"), (-7, -8, "right"))
"""Where a label may stand: offset of its lower edge from the point, in points, and its alignment."""


@dataclass(frozen=True)
class Panel:
    """One plot. ``costs`` (None: not measured), ``qualities``, ``series``, ``variants`` go together.

    ``front`` indexes the front of all points, ``own_fronts`` that of each series. A variant's name stands beside its
    point on the front; "" for a trained avatar, drawn as a square.
    """

    label: str
    costs: Sequence[float | None]
    qualities: Sequence[float]
    front: Sequence[int]
    series: Sequence[str]
    variants: Sequence[str]
    own_fronts: Mapping[str, Sequence[int]]


def write_plot(path: Path, panels: Sequence[Panel], quality: str, machines: str) -> None:
    """Draw the panels side by side and write a PNG, atomically. Costs are on a logarithmic axis.

    Steps join the front of each series: the best quality of that series up to a cost. Points that no point of any
    series beats are filled.
    """
    derived = any(variant for panel in panels for variant in panel.variants)
    shapes = " Squares: trained; circles: derived from them without training." if derived else ""
    note = f"Lines: Pareto front of each method; filled: of all.{shapes} Measured on {machines}."
    with style.context(["default", {"text.parse_math": False, "font.size": 10}]):
        figure = Figure(figsize=(6.2 * len(panels), 4.9), dpi=200, layout="constrained")
        figure.supxlabel(note, x=0.01, ha="left", fontsize=SMALL, color=MUTED)
        names = dict.fromkeys(name for panel in panels for name in panel.series)
        colours = dict(zip(names, itertools.cycle(COLOURS)))
        handles = [
            Line2D([], [], marker="o", linestyle="", color=c, label=name) for name, c in colours.items()
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=8, fontsize=SMALL, frameon=False)
        plots = list(zip(figure.subplots(1, len(panels), squeeze=False)[0], panels))
        for axes, panel in plots:
            _draw(axes, panel, quality, colours)
        figure.draw_without_rendering()  # the layout, before labels look for room in it
        for axes, panel in plots:
            label_points(axes, panel)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")


def _draw(axes: Axes, panel: Panel, quality: str, colours: Mapping[str, str]) -> None:
    """Points, steps, axes and legend of one panel."""
    axes.set(xlabel=panel.label)
    axes.set_title(quality, loc="left", fontsize=10)
    axes.spines[["top", "left", "right"]].set_visible(False)
    shown = {i: cost for i, cost in enumerate(panel.costs) if cost is not None}
    if not shown:
        axes.text(0.5, 0.5, "not measured in these runs", color=MUTED, ha="center", transform=axes.transAxes)
        axes.set(xticks=[], yticks=[])
        return
    for name, own_front in panel.own_fronts.items():
        corners = [(shown[i], panel.qualities[i]) for i in own_front]
        axes.step(*zip(*corners), where="post", color=colours[name], linewidth=1) if corners else None
    for i, cost in shown.items():
        colour = colours[panel.series[i]]
        axes.plot(
            cost,
            panel.qualities[i],
            marker="o" if panel.variants[i] else "s",
            markersize=MARKER,
            color=colour,
            markerfacecolor=colour if i in panel.front else "white",
            zorder=3,
        )
    axes.set_xscale("log")
    axes.margins(0.08, 0.12)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", color="#cdcdcd", linewidth=0.5)
    axes.tick_params(labelsize=SMALL, labelcolor=MUTED)


def label_points(axes: Axes, panel: Panel) -> None:
    """Write the names of variants beside their points on a front, where they touch neither points nor each other.

    Those on the front of all points come first.
    """
    scale = axes.get_figure(root=True).dpi / 72  # type: ignore[union-attr]
    places = {i: (cost, panel.qualities[i]) for i, cost in enumerate(panel.costs) if cost is not None}
    taken = [
        Bbox.from_bounds(x, y, 0, 0).padded(scale * MARKER / 2)
        for x, y in axes.transData.transform(list(places.values()) or [(1, 1)])
    ]
    for index in dict.fromkeys([*panel.front, *itertools.chain(*panel.own_fronts.values())]):
        for right, up, align in BESIDE if panel.variants[index] else ():
            label = axes.annotate(
                panel.variants[index],
                places[index],
                (right, up),
                textcoords="offset points",
                ha=align,
                fontsize=7,
                color=MUTED,
                in_layout=False,
            )
            box = label.get_window_extent()
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            label.remove()
