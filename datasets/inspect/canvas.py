"""A canvas that draws larger and shrinks at the end, so that lines and text are smooth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ...bench.contracts import ByteArray

Colour = tuple[int, int, int]
Point = tuple[float, float]

PAPER: Colour = (255, 255, 255)
INK: Colour = (34, 34, 34)
MUTED: Colour = (115, 115, 115)
RULE: Colour = (214, 214, 214)
TRAIN: Colour = (0, 114, 178)
HELD_OUT: Colour = (213, 94, 0)
"""Two colours that most colour-blind people tell apart (Okabe and Ito's)."""

FINE = 2


class Canvas:
    """White paper of a given size in final pixels; everything is drawn `FINE` times as large.

    Coordinates are final pixels and may be fractions.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._sheet = Image.new("RGB", (FINE * width, FINE * height), PAPER)
        self._draw = ImageDraw.Draw(self._sheet)

    def text(self, at: Point, text: str, size: int = 14, colour: Colour = INK, anchor: str = "la") -> None:
        """Write one line. ``anchor`` is Pillow's: l, m, r for left, middle, right; a, m, s for top, middle,
        baseline."""
        self._draw.text(_fine(at), text, fill=colour, font=_font(FINE * size), anchor=anchor)

    def line(self, points: Iterable[Point], colour: Colour = INK, width: float = 1.0) -> None:
        """Draw a chain of segments."""
        self._draw.line([_fine(p) for p in points], fill=colour, width=round(FINE * width), joint="curve")

    def polygon(self, points: Iterable[Point], fill: Colour | None, edge: Colour | None = None) -> None:
        """Draw a filled polygon."""
        self._draw.polygon([_fine(p) for p in points], fill=fill, outline=edge, width=FINE)

    def box(
        self,
        left: float,
        top: float,
        right: float,
        bottom: float,
        fill: Colour | None,
        edge: Colour | None = None,
    ) -> None:
        """Draw a rectangle; nothing where it has no area."""
        if right > left and bottom > top:
            self._draw.rectangle((*_fine((left, top)), *_fine((right, bottom))), fill=fill, outline=edge)

    def dot(self, at: Point, radius: float, fill: Colour, edge: Colour | None = None) -> None:
        """Draw a disc."""
        x, y = _fine(at)
        r = FINE * radius
        self._draw.ellipse((x - r, y - r, x + r, y + r), fill=fill, outline=edge)

    def image(self, left: float, top: float, image: ByteArray) -> None:
        """Put an (H, W, 3) image that is `FINE` times as large as it is to appear."""
        x, y = _fine((left, top))
        self._sheet.paste(Image.fromarray(np.ascontiguousarray(image)), (round(x), round(y)))

    def finish(self) -> ByteArray:
        """(height, width, 3) 8-bit."""
        small = self._sheet.resize((self.width, self.height), Image.Resampling.LANCZOS)
        return np.asarray(small)


def text_width(text: str, size: int = 14) -> float:
    """Width of a line, final pixels."""
    return _font(FINE * size).getlength(text) / FINE


def shortened(text: str, limit: float, size: int = 14) -> str:
    """The text, cut with an ellipsis so that it is at most ``limit`` final pixels wide."""
    if text_width(text, size) <= limit:
        return text
    while text and text_width(text + "…", size) > limit:
        text = text[:-1]
    return text + "…"


def nice_ticks(low: float, high: float, count: int = 5) -> Sequence[float]:
    """Round numbers from ``low`` to ``high``, about ``count`` of them, at steps of 1, 2 or 5 times ten to some
    power."""
    span = max(high - low, 1e-12)
    power = 10.0 ** np.floor(np.log10(span / count))
    step = min((f * power for f in (1, 2, 5, 10)), key=lambda s: abs(span / s - count))
    first = np.ceil(low / step - 1e-9)
    return [float((first + i) * step) for i in range(int((high / step - first) + 1e-9) + 1)]


def _fine(at: Point) -> Point:
    return at[0] * FINE, at[1] * FINE


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, so that a picture looks the same on every machine."""
    return ImageFont.load_default(size)
