"""How faces move: ranges by sequence, the space of expressions, the scatter of each coefficient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from .canvas import HELD_OUT, INK, MUTED, PAPER, RULE, TRAIN, Canvas, Colour, nice_ticks, shortened
from .statistics import KEPT_VARIANCE, ExpressionSpace, SequenceRow

ROW = 24
SIGMA_BARS = 40
"""Coefficients whose scatter is shown: the leading ones matter."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom; final pixels."""


@dataclass(frozen=True)
class Plot:
    """Axes of a plot: data ranges over a box."""

    canvas: Canvas
    box: Box
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where data fall on the page."""
        left, top, right, bottom = self.box
        return (
            left + (x - self.x[0]) / (self.x[1] - self.x[0]) * (right - left),
            bottom - (y - self.y[0]) / (self.y[1] - self.y[0]) * (bottom - top),
        )

    def axes(self, x_label: str, y_label: str) -> None:
        """Draw light grid lines with numbers, and what the axes are."""
        left, top, right, bottom = self.box
        for tick in nice_ticks(*self.x):
            column, _ = self.at(tick, self.y[0])
            self.canvas.line([(column, top), (column, bottom)], RULE, 0.6)
            self.canvas.text((column, bottom + 6), f"{tick:g}", 12, MUTED, "ma")
        for tick in nice_ticks(*self.y):
            _, row = self.at(self.x[0], tick)
            self.canvas.line([(left, row), (right, row)], RULE, 0.6)
            self.canvas.text((left - 7, row), f"{tick:g}", 12, MUTED, "rm")
        self.canvas.text(((left + right) / 2, bottom + 24), x_label, 13, INK, "ma")
        self.canvas.text((left - 30, top - 10), y_label, 13, INK, "ls")


def draw_sequences(canvas: Canvas, box: Box, rows: Sequence[SequenceRow]) -> None:
    """A table of the sequences, ranges as bars on common scales."""
    left, top, right, bottom = box
    canvas.text((left, top), "motion by sequence", 15)
    jaw_left, reach_left = left + 0.42 * (right - left), left + 0.68 * (right - left)
    bar = 0.19 * (right - left)
    head_right = right
    jaw_scale = max([row.jaw_deg[2] for row in rows] + [1.0])
    reach_scale = max([row.reach_mm[1] for row in rows] + [1.0])
    y = top + 34
    frames_right = jaw_left - 16
    for x, text, anchor in (
        (left, "sequence", "ls"),
        (frames_right, "timesteps", "rs"),
        (jaw_left, f"jaw, 0 to {jaw_scale:.0f}°", "ls"),
        (reach_left, f"expression, 0 to {reach_scale:.0f} mm", "ls"),
        (head_right, "head, most", "rs"),
    ):
        canvas.text((x, y + 12), text, 12, MUTED, anchor)
    canvas.line([(left, y + 18), (right, y + 18)], RULE, 1)
    room = int((bottom - y - 24) // ROW)
    shown = rows if len(rows) <= room else rows[: room - 1]
    for index, row in enumerate(shown):
        middle = y + 24 + ROW * (index + 0.5)
        colour = HELD_OUT if row.held_out else TRAIN
        count = f"{row.timesteps}" + (f" (+{row.excluded} excl.)" if row.excluded else "")
        canvas.text((left, middle), shortened(row.sequence, frames_right - left - 100, 13), 13, colour, "lm")
        canvas.text((frames_right, middle), count, 13, INK, "rm")
        low, typical, high = (value / jaw_scale for value in row.jaw_deg)
        _range_bar(canvas, (jaw_left, middle), bar, low, typical, high, colour)
        typical, high = (value / reach_scale for value in row.reach_mm)
        _range_bar(canvas, (reach_left, middle), bar, 0.0, typical, high, colour)
        canvas.text((head_right, middle), f"{row.head_deg:.0f}° {row.head_mm:.0f} mm", 12, INK, "rm")
    if len(shown) < len(rows):
        middle = y + 24 + ROW * (len(shown) + 0.5)
        canvas.text((left, middle), f"and {len(rows) - len(shown)} more", 13, MUTED, "lm")


def _range_bar(
    canvas: Canvas,
    at: tuple[float, float],
    width: float,
    low: float,
    typical: float,
    high: float,
    colour: Colour,
) -> None:
    """From least to largest, with a mark at the median; all as shares of the width."""
    x, y = at
    canvas.line([(x, y), (x + width, y)], RULE, 1)
    canvas.box(x + low * width, y - 5, x + max(high, low + 0.01) * width, y + 5, _pale(colour))
    canvas.line([(x + typical * width, y - 7), (x + typical * width, y + 7)], colour, 2)


def _pale(colour: Colour) -> Colour:
    """The colour half way to the paper."""
    red, green, blue = ((a + b) // 2 for a, b in zip(colour, PAPER))
    return red, green, blue


def draw_space(canvas: Canvas, box: Box, space: ExpressionSpace) -> None:
    """Faces along the first two principal components."""
    left, top, right, bottom = box
    canvas.text((left, top), "space of expressions", 15)
    scores = np.pad(space.scores_mm, ((0, 0), (0, max(0, 2 - space.scores_mm.shape[1]))))[:, :2]
    margin = 0.08 * np.maximum(np.ptp(scores, axis=0), 0.5)
    low, high = scores.min(axis=0) - margin, scores.max(axis=0) + margin
    plot = Plot(
        canvas,
        (left + 34, top + 52, right, bottom - 44),
        (float(low[0]), float(high[0])),
        (float(low[1]), float(high[1])),
    )
    share = [*space.explained[:2], 0.0, 0.0]
    plot.axes(f"PC 1, mm ({share[0]:.0%} of variance)", f"PC 2, mm ({share[1]:.0%})")
    order = np.argsort(space.held_out, kind="stable")
    radius = 4.0 if len(order) < 300 else 2.2
    for i in order:
        colour = HELD_OUT if space.held_out[i] else TRAIN
        canvas.dot(plot.at(*scores[i]), radius, colour, PAPER)


def draw_scatter(canvas: Canvas, box: Box, expressions: FloatArray, held_out: np.ndarray) -> None:
    """Standard deviation of the leading coefficients, training beside test.

    Parameters
    ----------
    expressions : (T, E).
    held_out : (T,) which timesteps are tested on.
    """
    left, top, right, bottom = box
    canvas.text((left, top), "standard deviation of coefficients", 15)
    count = min(SIGMA_BARS, expressions.shape[1])
    groups = [
        (colour, expressions[chosen][:, :count].std(axis=0))
        for colour, chosen in ((TRAIN, ~held_out), (HELD_OUT, held_out))
        if chosen.any()
    ]
    most = max([float(sigma.max(initial=0.0)) for _, sigma in groups] + [1e-3])
    plot = Plot(
        canvas, (left + 34, top + 52, right, bottom - 44), (0.0, float(max(count, 1))), (0.0, 1.08 * most)
    )
    plot.axes("coefficient", "")
    width = 0.84 / max(1, len(groups))
    for which, (colour, sigma) in enumerate(groups):
        for i, value in enumerate(sigma):
            x, y = plot.at(i + 0.08 + which * width, float(value))
            end, base = plot.at(i + 0.08 + (which + 1) * width, 0.0)
            canvas.box(x, y, end, base, colour)


def space_summary(space: ExpressionSpace) -> str:
    """One sentence on how rich the training faces are and how new the test's."""
    components = "1 component explains" if space.kept == 1 else f"{space.kept} components explain"
    parts = [f"{components} {KEPT_VARIANCE:.0%} of the training faces"]
    if space.novelty_mm:
        new = np.array([*space.novelty_mm.values()])
        parts.append(
            f"test faces lie {np.median(new):.2f} mm (median; most {new.max():.2f}) from the nearest of them"
        )
    return "; ".join(parts)
