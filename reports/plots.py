"""Shared elements of plots of quality over a cost: colours, legend, a note below and a logarithmic axis."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from ..bench.io.figures import Canvas
from ..bench.io.files import atomic_path

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
"""Colour-blind-safe palette of Okabe and Ito, with an olive by Tol instead of their yellow."""
MARKERS = "osD^vPX"
"""Markers by method; their number differs from that of the colours, which gives more distinct combinations."""
GREY, LIGHT_GREY = "#6e6e6e", "#cdcdcd"
SMALL = 8
"""Size of text next to plots, in points."""
CHARACTERS = 14
"""Number of characters of that size per inch of width."""


@contextmanager
def plot_file(
    path: Path,
    size: tuple[float, float],
    dpi: int,
    names: Iterable[str],
    note: str,
    *,
    line: Literal["-", ""],
    markers: str = "o",
) -> Iterator[tuple[Figure, dict[str, tuple[str, str]]]]:
    """A figure of ``size`` inches with a legend of ``names``, their colours and markers; written as a PNG at the end, atomically.

    ``line`` is matplotlib's style of the lines in the legend, ``markers`` are the shapes that methods have in turn.
    """
    with style.context(["default", {"text.parse_math": False, "font.size": 10}]):
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        Canvas(figure)
        wrapped = textwrap.fill(note, int(size[0] * CHARACTERS))
        figure.supxlabel(wrapped, x=0.01, ha="left", fontsize=SMALL, color=GREY)
        looks = dict(zip(dict.fromkeys(names), zip(itertools.cycle(COLOURS), itertools.cycle(markers))))
        handles = [Line2D([], [], marker=m, linestyle=line, color=c, label=n) for n, (c, m) in looks.items()]
        figure.legend(handles=handles, loc="outside upper left", ncols=8, fontsize=SMALL, frameon=False)
        yield figure, looks
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")


def start_axes(axes: Axes, title: str) -> None:
    """A plot without a frame, its title at the left."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.spines[["top", "left", "right"]].set_visible(False)


def show_missing(axes: Axes, text: str) -> None:
    """Write the reason of an empty plot."""
    axes.text(0.5, 0.5, text, color=GREY, ha="center", va="center", transform=axes.transAxes)
    axes.set(xticks=[], yticks=[])


def cost_axis(axes: Axes, *, logarithmic: bool = True, whole: bool = False) -> None:
    """A horizontal axis, set after drawing. A logarithmic one has numbers at 1, 2 and 5, or evenly spaced ones if fewer than three of
    those are in view; ``whole``: whole numbers, if the range is not too narrow."""
    axes.margins(0.08, 0.12)
    if logarithmic:
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)))
        marks = [
            tick for power in powers for part in (1, 2, 5) if low <= (tick := part * 10.0**power) <= high
        ]
        few = len(marks) < 3
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=whole) if few else FixedLocator(marks))
        axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(axis="y", color=LIGHT_GREY, linewidth=0.5)
    axes.tick_params(labelsize=SMALL, labelcolor=GREY)
