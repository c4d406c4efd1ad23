"""Matplotlib figures without a window, in one style for all commands on captures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ..bench.contracts import ByteArray
from ..bench.io.figures import drawable

Colour = tuple[int, int, int]

TRAIN, HELD_OUT = "#0072b2", "#d55e00"
"""Two of Okabe and Ito's colours, distinguishable with any colour vision."""
MUTED, RULE, LEAK = "#737373", "#d6d6d6", "#be1e2d"
DPI = 100

_STYLE: Any = {
    "text.parse_math": False,  # names may have dollar signs
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.edgecolor": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelsize": 9,
    "axes.axisbelow": True,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """An empty figure of a size in inches; drawing and rasterising must happen within the context."""
    with style.context(["default", _STYLE]):  # independent of the user's matplotlibrc, such as text.usetex
        yield Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def bands(figure: Figure, heights: Sequence[float]) -> list[SubFigure]:
    """Vertically stacked parts of a figure with proportional heights."""
    return list(np.asarray(figure.subfigures(len(heights), 1, height_ratios=heights)))


def show(axes: Axes, image: ByteArray, *, frame: bool = False) -> None:
    """Show an image on new axes without ticks."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(frame)


def shortened(text: str, length: int) -> str:
    """The text as it is drawn, shortened with an ellipsis to a number of characters."""
    text = drawable(text)
    return text if len(text) <= length else f"{text[: length - 1]}…"


def hexadecimal(colour: str) -> Colour:
    """Levels of a colour such as `TRAIN`."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
