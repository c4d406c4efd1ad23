"""Scatter plots of quality over costs, the Pareto front as a line."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw

from ...bench.io.files import atomic_path
from ..drawing import INK, MUTED, PAPER, RULE, Colour, font, text_width

COLOURS: tuple[Colour, ...] = (  # Okabe and Ito's, told apart with any colour vision
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
)
WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 620, 460, 80, 70, 70, 30
DOT, TEXT, SMALL, FAINT, FINE = 6, 16, 13, 11, 2

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Panel:
    """One plot. ``costs`` (None: not measured), ``qualities``, ``series``, ``variants`` go together.

    ``front`` indexes the front of all points, ``own_fronts`` that of each series. A variant's name stands beside its point on the front; "" for a trained avatar, drawn as a square.
    """

    label: str
    costs: Sequence[float | None]
    qualities: Sequence[float]
    front: Sequence[int]
    series: Sequence[str]
    variants: Sequence[str]
    own_fronts: Mapping[str, Sequence[int]]


def write_plot(path: Path, panels: Sequence[Panel], quality: str, note: str) -> None:
    """Draw the panels side by side and write a PNG, atomically. Costs are on a logarithmic axis.

    Steps join the front of each series: what is the best to be had of it at a cost. Points that no point of any
    series beats are filled.
    """
    image = Image.new("RGB", (FINE * WIDTH * len(panels), FINE * (HEIGHT + 30)), PAPER)
    draw = ImageDraw.Draw(image)
    names = list(dict.fromkeys(name for panel in panels for name in panel.series))
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    for number, panel in enumerate(panels):
        _draw(draw, panel, number * WIDTH, quality, colours)
    derived = any(variant for panel in panels for variant in panel.variants)
    shapes = " Squares: trained; circles: derived from them without training." if derived else ""
    text = f"Lines: Pareto front of each method; filled: of all.{shapes} Measured on {note}."
    _text(draw, LEFT, HEIGHT + 4, text, SMALL, MUTED)
    with atomic_path(path) as temporary:
        image.save(temporary, optimize=True)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) within [low, high]."""
    step = 10.0 ** math.floor(math.log10((high - low) / count))
    step *= next(f for f in (1, 2, 5, 10) if (high - low) / (f * step) <= count)
    return [round(i * step, 12) for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten within [low, high]."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [f * 10.0**p for p in powers for f in (1, 2, 5) if low <= f * 10.0**p <= high]


def _draw(
    draw: ImageDraw.ImageDraw, panel: Panel, left: int, quality: str, colours: dict[str, Colour]
) -> None:
    x0, x1, y0, y1 = left + LEFT, left + WIDTH - RIGHT, HEIGHT - BOTTOM, TOP
    _text(draw, x0, 16, quality, TEXT, INK)
    known = [(i, cost) for i, cost in enumerate(panel.costs) if cost is not None]
    if not known:
        _text(draw, x0, TOP, "not measured in these runs", SMALL, MUTED)
        return
    low, high = min(c for _, c in known) / 1.6, max(c for _, c in known) * 1.6
    worst, best = (f(panel.qualities[i] for i, _ in known) for f in (min, max))
    margin = 0.12 * (best - worst) or 0.05 * abs(best) or 1.0
    worst, best = worst - margin, best + margin

    def place(cost: float, value: float) -> tuple[float, float]:
        return (
            x0 + (math.log(cost / low) / math.log(high / low)) * (x1 - x0),
            y0 - (value - worst) / (best - worst) * (y0 - y1),
        )

    for value in ticks(worst, best):
        _, y = place(low, value)
        _line(draw, [(x0, y), (x1, y)], RULE, 1)
        _text(draw, x0 - 8 - text_width(f"{value:g}", SMALL), y - SMALL / 2 - 2, f"{value:g}", SMALL, MUTED)
    for cost in log_ticks(low, high):
        x, _ = place(cost, worst)
        _line(draw, [(x, y0), (x, y0 + 5)], INK, 1)
        _text(draw, x - text_width(f"{cost:g}", SMALL) / 2, y0 + 9, f"{cost:g}", SMALL, MUTED)
    _line(draw, [(x0, y0), (x1, y0)], INK, 1)
    _text(draw, (x0 + x1 - text_width(panel.label, SMALL)) / 2, y0 + 32, panel.label, SMALL, INK)
    for name, own_front in panel.own_fronts.items():
        corners = [place(panel.costs[i] or low, panel.qualities[i]) for i in own_front]
        for (ax, ay), (bx, by) in itertools.pairwise(corners):
            _line(draw, [(ax, ay), (bx, ay), (bx, by)], colours[name], 1)
    placed = {index: place(cost, panel.qualities[index]) for index, cost in known}
    for index, (x, y) in placed.items():
        colour = colours[panel.series[index]]
        shape = draw.ellipse if panel.variants[index] else draw.rectangle
        mark = tuple(FINE * v for v in (x - DOT, y - DOT, x + DOT, y + DOT))
        shape(mark, fill=colour if index in panel.front else PAPER, outline=colour, width=2 * FINE)
    taken = [(x - DOT, y - DOT, x + DOT, y + DOT) for x, y in placed.values()]
    # Names of the front of all come first, those of the methods' own where there is room.
    for index in dict.fromkeys([*panel.front, *itertools.chain(*panel.own_fronts.values())]):
        if panel.variants[index] and (box := free(*placed[index], panel.variants[index], taken, (x0, x1))):
            taken.append(box)
            _text(draw, box[0], box[1], panel.variants[index], FAINT, MUTED)
    x = float(x0)
    for name in dict.fromkeys(panel.series):
        draw.ellipse(tuple(FINE * v for v in (x, 44, x + 10, 54)), fill=colours[name])
        _text(draw, x + 16, 41, name, SMALL, INK)
        x += 36 + text_width(name, SMALL)


def free(x: float, y: float, text: str, taken: Sequence[Box], sides: tuple[float, float]) -> Box | None:
    """Where beside a point a text fits between the sides without touching what is taken, or None."""
    width, gap = text_width(text, FAINT), DOT + 3
    for left, top in (
        (x + gap, y + 2),
        (x - gap - width, y - FAINT - 4),
        (x + gap, y - FAINT - 4),
        (x - gap - width, y + 2),
    ):
        box = (left, top, left + width, top + FAINT + 2)
        clear = all(box[2] < t[0] or t[2] < box[0] or box[3] < t[1] or t[3] < box[1] for t in taken)
        if clear and sides[0] <= box[0] and box[2] <= sides[1] + RIGHT:
            return box
    return None


def _line(
    draw: ImageDraw.ImageDraw, points: Sequence[tuple[float, float]], colour: Colour, width: int
) -> None:
    draw.line([(FINE * x, FINE * y) for x, y in points], fill=colour, width=FINE * width)


def _text(draw: ImageDraw.ImageDraw, x: float, y: float, text: str, size: int, colour: Colour) -> None:
    draw.text((FINE * x, FINE * y), text, fill=colour, font=font(FINE * size), anchor="la")
