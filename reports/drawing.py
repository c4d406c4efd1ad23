"""Text, rules and colour maps on a sheet that grows downwards."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..bench.contracts import ByteArray, FloatArray

Colour = tuple[int, int, int]
PAPER: Colour = (255, 255, 255)
INK: Colour = (30, 30, 30)
MUTED: Colour = (110, 110, 110)
RULE: Colour = (205, 205, 205)
BOX: Colour = (225, 225, 225)
ELLIPSIS = "..."


class Pen:
    """Draws at the current height of a white sheet of fixed width.

    Parameters
    ----------
    width : of the sheet, pixels.
    top : height to begin at.
    """

    def __init__(self, width: int, top: int) -> None:
        self.width, self.y = width, top
        self._sheet = Image.new("RGB", (width, 1024), PAPER)
        self._draw = ImageDraw.Draw(self._sheet)

    def advance(self, pixels: int) -> None:
        """Move down."""
        self.y += pixels

    def text(
        self,
        left: int,
        text: str,
        size: int,
        colour: Colour = INK,
        anchor: str = "left",
        *,
        drop: int = 0,
        limit: int | None = None,
    ) -> None:
        """Write one line, its top ``drop`` pixels below the current height, shortened to ``limit`` pixels."""
        text = text if limit is None else shorten(text, size, limit)
        self._reserve(drop + 2 * size)
        shift = {"left": 0.0, "centre": 0.5, "right": 1.0}[anchor] * text_width(text, size)
        self._draw.text((round(left - shift), self.y + drop), text, fill=colour, font=font(size), anchor="la")

    def image(self, left: int, image: ByteArray) -> None:
        """Put an (H, W, 3) image with its top at the current height."""
        self._reserve(image.shape[0] + 1)
        self._sheet.paste(Image.fromarray(np.ascontiguousarray(image)), (left, self.y))

    def rule(self, left: int, right: int) -> None:
        """Draw a horizontal hairline."""
        self._reserve(1)
        self._draw.line((left, self.y, right, self.y), fill=RULE)

    def frame(self, left: int, width: int, height: int, colour: Colour = RULE, thickness: int = 1) -> None:
        """Draw a line around an image, outside its pixels: white images need an edge on white paper."""
        self._reserve(height + thickness)
        t = thickness
        box = (left - t, self.y - t, left + width - 1 + t, self.y + height - 1 + t)
        self._draw.rectangle(box, outline=colour, width=thickness)

    def grey_box(self, left: int, width: int, height: int, text: str, size: int) -> None:
        """Draw a grey box with wrapped text in its middle, as much of it as fits."""
        self._reserve(height + 1)
        self._draw.rectangle((left, self.y, left + width - 1, self.y + height - 1), fill=BOX)
        step = size + 4
        lines = wrap(text, size, width - 16)
        room = max(1, (height - 8) // step)
        if len(lines) > room:
            lines = [*lines[: room - 1], shorten(lines[room - 1] + ELLIPSIS, size, width - 16)]
        top = (height - step * len(lines)) // 2
        for index, line in enumerate(lines):
            self.text(left + width // 2, line, size, MUTED, "centre", drop=top + index * step)

    def finish(self) -> ByteArray:
        """Return the sheet down to the current height, (H, W, 3)."""
        self._reserve(0)
        return np.asarray(self._sheet)[: self.y].copy()

    def _reserve(self, pixels: int) -> None:
        """Lengthen the sheet if the next ``pixels`` rows are not on it."""
        if self.y + pixels <= self._sheet.height:
            return
        longer = Image.new("RGB", (self.width, max(2 * self._sheet.height, self.y + pixels)), PAPER)
        longer.paste(self._sheet, (0, 0))
        self._sheet, self._draw = longer, ImageDraw.Draw(longer)


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, so that a sheet looks the same on every machine."""
    return ImageFont.load_default(size)


def text_width(text: str, size: int) -> float:
    """Width of one line, pixels."""
    return font(size).getlength(text)


def shorten(text: str, size: int, limit: int) -> str:
    """Cut a line so that it is at most ``limit`` pixels wide, an ellipsis showing the cut."""
    if text_width(text, size) <= limit:
        return text
    while text and text_width(text + ELLIPSIS, size) > limit:
        text = text[:-1]
    return text.rstrip(". ") + ELLIPSIS


def wrap(text: str, size: int, limit: int) -> list[str]:
    """Break a text into lines of at most ``limit`` pixels, between words; a longer word is shortened."""
    lines: list[str] = []
    for word in text.split():
        candidate = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(candidate, size) <= limit:
            lines[-1] = candidate
        else:
            lines.append(shorten(word, size, limit))
    return lines


def colour_map(values: FloatArray) -> ByteArray:
    """Map (H, W) values in [0, 1], clamped, to (H, W, 3) colours of the perceptually uniform map "magma"."""
    levels = np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_MAGMA), cv2.COLOR_BGR2RGB))
