"""Turns matplotlib figures into pixels without a window, and writes characters that fonts lack as code points."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

from ..contracts import ByteArray

LONGEST = 2**16 - 1
"""Maximum side of a figure in matplotlib, pixels; larger figures get a lower resolution."""


def drawable(text: str, font: FontProperties | None = None) -> str:
    """The text, with code points such as U+5F20 for characters that a font lacks; by default matplotlib's."""
    drawn = _characters(findfont(font or FontProperties()))
    written = "".join(c if ord(c) in drawn or c == "\n" else f"U+{ord(c):04X}" for c in text)
    return re.sub(r"(U\+[0-9A-F]{4,6})(?=U\+)", r"\1 ", written)


@cache
def _characters(file: str) -> frozenset[int]:
    return frozenset(get_font(file).get_charmap())


class Canvas(FigureCanvasAgg):
    """Draws a figure; other software draws boxes for characters that the font lacks, and prints warnings."""

    def get_renderer(self) -> Any:
        """The renderer of matplotlib, for drawable text; the same one until the size changes."""
        renderer = super().get_renderer()
        renderer.__class__ = _Renderer
        return renderer


class _Renderer(RendererAgg):
    def draw_text(
        self, gc: Any, x: float, y: float, s: str, prop: FontProperties, *more: Any, **named: Any
    ) -> None:
        super().draw_text(gc, x, y, drawable(s, prop), prop, *more, **named)

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: Any) -> Any:
        return super().get_text_width_height_descent(drawable(s, prop), prop, ismath)


def pixels(figure: Figure) -> ByteArray:
    """(H, W, 3) 8-bit sRGB."""
    figure.set_dpi(min(figure.dpi, LONGEST / max(figure.get_size_inches())))
    canvas = Canvas(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
