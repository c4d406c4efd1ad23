"""Sheets of pictures: rows and columns of images under headings, with labels, captions and a legend."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.io.files import atomic_path
from ..bench.io.images import write_png
from ..bench.io.provenance import COMPOSITE

if TYPE_CHECKING:  # slow to import: commands import it when they draw
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
"""Colour-blind-safe palette of Okabe and Ito, with an olive by Tol instead of their yellow."""
MARKERS = "osD^vPX"
"""Markers by method; their number differs from that of the colours, which gives more distinct combinations."""
GREY, LIGHT_GREY = "#6e6e6e", "#cdcdcd"
TEXT_POINTS = 8
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
    from matplotlib import style
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from ..bench.io.figures import Canvas

    with style.context(["default", {"text.parse_math": False, "font.size": 10}]):
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        Canvas(figure)
        wrapped = textwrap.fill(note, int(size[0] * CHARACTERS))
        figure.supxlabel(wrapped, x=0.01, ha="left", fontsize=TEXT_POINTS, color=GREY)
        looks = dict(zip(dict.fromkeys(names), zip(itertools.cycle(COLOURS), itertools.cycle(markers))))
        handles = [Line2D([], [], marker=m, linestyle=line, color=c, label=n) for n, (c, m) in looks.items()]
        figure.legend(handles=handles, loc="outside upper left", ncols=8, fontsize=TEXT_POINTS, frameon=False)
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
    from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

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
    axes.tick_params(labelsize=TEXT_POINTS, labelcolor=GREY)


INK, MUTED, LINE, BOX = "#1e1e1e", "#6e6e6e", "#cdcdcd", "#e1e1e1"
GAP, MARGIN, MARKED = 8, 24, 3
TITLE, TEXT, SMALL = 20, 15, 13
"""Sizes of text, pixels."""
SMALLEST_WIDTH = 760
"""Minimum width for a sheet's text, pixels."""
DPI = 100
WHITE: ByteArray = np.full((12, 12, 3), 255, np.uint8)


@dataclass(frozen=True)
class Tile:
    """An (H, W, 3) 8-bit image at its displayed size, or the reason why it is missing.

    ``mark`` is the colour of a wide border; "" for a hairline (white images need an edge on a white page).
    """

    picture: ByteArray | str
    caption: str = ""
    mark: str = ""


@dataclass(frozen=True)
class TileRow:
    """Images side by side, and short lines to their left."""

    labels: Sequence[str]
    tiles: Sequence[Tile]


@dataclass(frozen=True)
class SheetSection:
    """Rows under a heading, with a title over each column."""

    title: str
    heads: Sequence[str]
    rows: Sequence[TileRow]


@dataclass
class _Paper:
    """White page of fixed width, filled downwards from the height ``y``; coordinates are pixels."""

    width: int
    y: int = MARGIN
    images: list[tuple[int, int, ByteArray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        from matplotlib.figure import Figure

        self.figure = Figure(dpi=DPI)
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set_axis_off()

    def text(
        self, left: float, text: str, size: int, colour: str = INK, *, drop: int = 0, width: int | None = None
    ) -> None:
        """Write one line of text, its top ``drop`` below the current height, truncated to about ``width``."""
        from ..bench.io.figures import drawable

        text = drawable(text)
        limit = len(text) if width is None else _characters(width, size)
        text = text if len(text) <= limit else text[: limit - 1] + "…"
        points = size * 72 / DPI
        self.axes.text(left, self.y + drop, text, size=points, color=colour, va="top", parse_math=False)

    def fill(self, left: int, width: int, height: int, colour: str, *, drop: int = 0) -> None:
        """Fill a rectangle."""
        rgb = np.array([*bytes.fromhex(colour.removeprefix("#"))], np.uint8)
        self.images.append((left, self.y + drop, np.tile(rgb, (height, width, 1))))

    def framed(self, left: int, image: ByteArray, colour: str, line: int) -> None:
        """Place an image with a border outside of its pixels."""
        height, width = image.shape[:2]
        self.fill(left - line, width + 2 * line, height + 2 * line, colour, drop=-line)
        self.images.append((left, self.y, image))

    def tile(self, left: int, tile: Tile, width: int, height: int) -> None:
        """Draw an image, or a grey box with as much of its reason as fits."""
        if isinstance(tile.picture, str):
            from matplotlib.patches import Rectangle

            self.axes.add_patch(Rectangle((left, self.y), width, height, color=BOX, linewidth=0))
            fit, lines = _characters(width - 16, SMALL), max(1, (height - 8) // (SMALL + 4))
            words = textwrap.wrap(tile.picture, fit, max_lines=lines, placeholder=" …")
            for index, line in enumerate(words):
                self.text(left + 8, line, SMALL, MUTED, drop=8 + index * (SMALL + 4))
        else:
            height, width = tile.picture.shape[:2]
            self.framed(left, tile.picture, tile.mark or LINE, MARKED if tile.mark else 1)
        if tile.caption:
            self.text(left, tile.caption, SMALL, MUTED, drop=height + 3, width=width)

    def save(self, path: Path) -> None:
        """Write the page down to the current height as a PNG, atomically."""
        from ..bench.io import figures

        scale = min(1.0, figures.LONGEST / max(self.width, self.y))
        self.figure.set_size_inches(self.width / DPI, self.y / DPI)
        self.axes.set(xlim=(0, self.width), ylim=(self.y, 0))
        page = figures.pixels(self.figure)
        for left, top, image in self.images:  # pixel for pixel
            if scale < 1:
                left, top, height, width = (int(scale * size) for size in (left, top, *image.shape[:2]))
                size = (max(1, width), max(1, height))
                image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            page[top : top + image.shape[0], left : left + image.shape[1]] = image
        write_png(path, np.ascontiguousarray(page), COMPOSITE)


def write_sheet(
    path: Path,
    sections: Sequence[SheetSection],
    *,
    title: str,
    subtitle: str,
    marks: Mapping[str, str] | None = None,
    error_scale: tuple[int, str] | None = None,
    pairs: bool = False,
    label_width: int = 120,
) -> None:
    """Draw sections below each other and write a PNG, atomically.

    ``marks`` are the legend of the colours around images (meaning by colour), ``error_scale`` is the value of the brightest colour
    of error maps and the text after it, for a colour bar. ``pairs``: smaller gaps between columns 1 and 2, 3 and 4, ...;
    ``label_width``: of the row labels on the left, pixels.
    """
    from matplotlib import style

    with style.context("default"):  # independent of the user's matplotlibrc, such as text.usetex
        tiles = [tile for section in sections for row in section.rows for tile in row.tiles]
        width = max(
            (t.picture.shape[1] for t in tiles if not isinstance(t.picture, str)), default=label_width
        )

        def left(column: int) -> int:
            return MARGIN + label_width + column * (width + GAP) + (GAP * ((column + 1) // 2) if pairs else 0)

        columns = max(len(row.tiles) for section in sections for row in section.rows)
        paper = _Paper(max(left(columns) + MARGIN - GAP, SMALLEST_WIDTH))
        paper.text(MARGIN, title, TITLE)
        paper.y += TITLE + 10
        for line in textwrap.wrap(subtitle, _characters(paper.width - 2 * MARGIN, SMALL)):
            paper.text(MARGIN, line, SMALL, MUTED)
            paper.y += SMALL + 5
        paper.y += 8
        for index, (colour, meaning) in enumerate((marks or {}).items()):
            paper.framed(MARGIN + 260 * index, WHITE, colour, MARKED)
            paper.text(MARGIN + 260 * index + 28, meaning, SMALL, MUTED)
        paper.y += SMALL + 10 if marks else 0
        if error_scale is not None:
            _colour_bar(paper, *error_scale)

        for section in sections:
            paper.y += 10
            paper.text(MARGIN, section.title, TEXT)
            paper.y += TEXT + 8
            paper.fill(MARGIN, paper.width - 2 * MARGIN, 1, LINE)
            paper.y += 8
            for column, head in enumerate(section.heads):
                paper.text(left(column), head, SMALL, width=width)
            paper.y += SMALL + 8
            for row in section.rows:
                sizes = [t.picture.shape[:2] for t in row.tiles if not isinstance(t.picture, str)]
                height = max((h for h, _ in sizes), default=width)
                for index, label in enumerate(row.labels):
                    colour, drop = MUTED if index else INK, index * (SMALL + 6)
                    paper.text(MARGIN, label, SMALL, colour, drop=drop, width=label_width - 8)
                for column, tile in enumerate(row.tiles):
                    paper.tile(left(column), tile, width, height)
                caption = SMALL + 7 if any(tile.caption for tile in row.tiles) else 0
                paper.y += max(height + caption, len(row.labels) * (SMALL + 6)) + GAP
        paper.y += MARGIN - GAP
        paper.save(path)


def _colour_bar(paper: _Paper, top: int, more: str) -> None:
    length, height, left = 220, 12, MARGIN + 150
    paper.text(MARGIN, "Absolute error", SMALL, MUTED)
    paper.images.append((left, paper.y, colour_map(np.tile(np.linspace(0.0, 1.0, length), (height, 1)))))
    note = "8-bit levels, mean over channels; one scale for all maps"
    paper.text(left + length + 10, note, SMALL, MUTED)
    paper.y += height + 3
    for share, label in ((0.0, "0"), (0.5, f"{top / 2:g}"), (1.0, f"{top}{more}")):
        paper.text(left + share * length, label, SMALL, MUTED)
    paper.y += SMALL + 10


def _characters(width: int, size: int) -> int:
    """Approximate number of characters of a text size that fit into a width, both in pixels."""
    return max(2, int(width / (0.6 * size)))


def colour_map(values: FloatArray) -> ByteArray:
    """Map (H, W) values in [0, 1], clamped, to (H, W, 3) colours of the perceptually uniform map "magma"."""
    from matplotlib import colormaps

    return colormaps["magma"](np.clip(values, 0.0, 1.0), bytes=True)[..., :3]
