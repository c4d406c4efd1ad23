"""The contact sheet: frames of each task in rows; truth, and each method's render and error map, in columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import InputError
from ..bench.io.files import atomic_path
from .drawing import INK, MUTED, Pen, colour_map, wrap

Picture = ByteArray | Callable[[], ByteArray]
NICE_SCALES = (2, 5, 10, 20, 50, 100, 255)
GAP, GROUP_GAP, MARGIN, LABELS = 6, 8, 24, 150
TITLE, TEXT, SMALL = 20, 15, 13
SMALLEST_WIDTH = 760  # room for the colour bar and its legend


@dataclass(frozen=True)
class Missing:
    """A render that is not there, and why."""

    reason: str


@dataclass(frozen=True)
class SheetRow:
    """One frame.

    Attributes
    ----------
    section : heading under which it stands (the task); rows of one section are neighbours.
    labels : short lines beside it (sequence, timestep, camera).
    truth : (H, W, 3) 8-bit image, or a function that reads it.
    renders : by method, of the truth's size.
    captions : by method, a short text under the render (its PSNR).
    """

    section: str
    labels: Sequence[str]
    truth: Picture
    renders: Mapping[str, Picture | Missing]
    captions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Placement:
    """Where a panel lies on the sheet, pixels; ``column`` is "truth", or "render METHOD", or "error METHOD"."""

    row: int
    column: str
    left: int
    top: int
    width: int
    height: int


def contact_sheet(
    rows: Sequence[SheetRow],
    methods: Sequence[str],
    out: Path,
    *,
    title: str = "",
    subtitle: str = "",
    panel_width: int = 240,
    scaled_by: Sequence[str] | None = None,
) -> list[Placement]:
    """Draw the sheet and write it as a PNG, atomically.

    Error maps show the absolute difference, averaged over the channels, in 8-bit levels, on one scale for the
    whole sheet: a round number at or above the 99th percentile of the errors. Larger errors take the top colour.

    Parameters
    ----------
    rows : the frames; at least one.
    methods : columns, in order.
    out : the PNG.
    title, subtitle : above everything.
    panel_width : pixels; wider images are reduced to it (by area), narrower ones enlarged by a whole factor, each
        pixel a square, as far as they fit.
    scaled_by : methods whose errors set the scale (default: all), so that a floor does not darken the rest.

    Returns
    -------
    Where each image lies, for those who want to find it again.
    """
    if not rows:
        raise InputError("contact sheet", "rows", "at least one frame", "none")
    strips = [_Strip.make(row, methods, panel_width) for row in rows]
    deciding = [e for s in strips for m, e in s.errors.items() if scaled_by is None or m in scaled_by]
    deciding = deciding or [e for s in strips for e in s.errors.values()]
    scale = _nice_scale(deciding)
    width = max(strip.truth.shape[1] for strip in strips)
    sheet_width = max(_left(2 * len(methods), width) + width + MARGIN, SMALLEST_WIDTH)

    pen = Pen(sheet_width, MARGIN)
    if title:
        pen.text(MARGIN, title, TITLE)
        pen.advance(TITLE + 10)
    for line in wrap(subtitle, SMALL, sheet_width - 2 * MARGIN):
        pen.text(MARGIN, line, SMALL, MUTED)
        pen.advance(SMALL + 5)
    _draw_colour_bar(pen, scale)
    _draw_heads(pen, methods, width)

    placements: list[Placement] = []
    for index, (row, strip) in enumerate(zip(rows, strips)):
        if index == 0 or row.section != rows[index - 1].section:
            pen.advance(10)
            pen.text(MARGIN, row.section, TEXT + 1)
            pen.advance(TEXT + 10)
            pen.rule(MARGIN, sheet_width - MARGIN)
            pen.advance(8)
        placements += _draw_strip(pen, index, row, strip, methods, width, scale)
    pen.advance(MARGIN - 2 * GAP)
    with atomic_path(out) as temporary:
        Image.fromarray(pen.finish()).save(temporary, optimize=True)
    return placements


@dataclass(frozen=True)
class _Strip:
    """A row's pictures at the size they are shown; the error maps in levels."""

    truth: ByteArray
    renders: Mapping[str, ByteArray | Missing]
    errors: Mapping[str, FloatArray]

    @classmethod
    def make(cls, row: SheetRow, methods: Sequence[str], panel_width: int) -> _Strip:
        truth = _read(row.truth)
        enlarged = panel_width // truth.shape[1]
        factor = enlarged if enlarged else panel_width / truth.shape[1]
        size = (max(1, round(truth.shape[1] * factor)), max(1, round(truth.shape[0] * factor)))
        renders: dict[str, ByteArray | Missing] = {}
        errors: dict[str, FloatArray] = {}
        for method in methods:
            source = row.renders.get(method, Missing("not rendered"))
            if isinstance(source, Missing):
                renders[method] = source
                continue
            render = _read(source)
            if render.shape != truth.shape:
                raise InputError(
                    "contact sheet", f"render of {method}", f"shape {truth.shape}", str(render.shape)
                )
            renders[method] = _resize(render, size)
            # Reduced after the difference: reducing before it would average errors of opposite sign away.
            error = np.abs(render.astype(np.float32) - truth).mean(axis=2)
            errors[method] = _resize(error, size)
        return cls(_resize(truth, size), renders, errors)


def _read(picture: Picture) -> ByteArray:
    return picture() if callable(picture) else picture


def _resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if size == (image.shape[1], image.shape[0]):
        return image
    larger = size[0] > image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if larger else cv2.INTER_AREA))


def _nice_scale(errors: Sequence[FloatArray]) -> int:
    if not errors:
        return NICE_SCALES[-1]
    top = float(np.percentile(np.concatenate([error.ravel() for error in errors]), 99))
    return next(scale for scale in NICE_SCALES if scale >= top)


def _left(column: int, width: int) -> int:
    """Left edge of a column: 0 is the truth, then a render and an error map for each method, kept together."""
    return MARGIN + LABELS + column * (width + GAP) + (column + 1) // 2 * GROUP_GAP


def _draw_colour_bar(pen: Pen, scale: int) -> None:
    pen.advance(8)
    length, height, left = 220, 12, MARGIN + LABELS
    ramp = np.repeat(np.linspace(0.0, 1.0, length)[None], height, axis=0)
    pen.text(MARGIN, "Absolute error", SMALL, MUTED)
    pen.image(left, colour_map(ramp))
    pen.text(left + length + 10, "8-bit levels, mean over channels; one scale for all maps", SMALL, MUTED)
    pen.advance(height + 3)
    for value, share, anchor in ((0, 0.0, "left"), (scale / 2, 0.5, "centre"), (scale, 1.0, "right")):
        more = " or more" if share == 1.0 and scale < NICE_SCALES[-1] else ""
        pen.text(left + int(share * length), f"{value:g}{more}", SMALL, MUTED, anchor)
    pen.advance(SMALL + 10)


def _draw_heads(pen: Pen, methods: Sequence[str], width: int) -> None:
    pen.text(_left(0, width), "Ground truth", TEXT, limit=width)
    for index, method in enumerate(methods):
        pen.text(_left(1 + 2 * index, width), method, TEXT, limit=width)
        pen.text(_left(2 + 2 * index, width), "error", TEXT, MUTED, limit=width)
    pen.advance(TEXT + 4)


def _draw_strip(
    pen: Pen, index: int, row: SheetRow, strip: _Strip, methods: Sequence[str], width: int, scale: int
) -> list[Placement]:
    height, own_width = strip.truth.shape[:2]
    for line, label in enumerate(row.labels):
        pen.text(
            MARGIN, label, SMALL, INK if line == 0 else MUTED, drop=line * (SMALL + 6), limit=LABELS - 10
        )

    def place(column: int, name: str, image: ByteArray) -> Placement:
        left = _left(column, width)
        pen.image(left, image)
        pen.frame(left, own_width, height)
        return Placement(index, name, left, pen.y, own_width, height)

    placed = [place(0, "truth", strip.truth)]
    for number, method in enumerate(methods):
        render = strip.renders[method]
        if isinstance(render, Missing):
            for column, reason in ((1 + 2 * number, render.reason), (2 + 2 * number, "no error map")):
                pen.grey_box(_left(column, width), own_width, height, reason, SMALL)
            continue
        placed.append(place(1 + 2 * number, f"render {method}", render))
        placed.append(place(2 + 2 * number, f"error {method}", colour_map(strip.errors[method] / scale)))
    for number, method in enumerate(methods):
        caption = row.captions.get(method, "")
        pen.text(_left(1 + 2 * number, width), caption, SMALL, MUTED, drop=height + 3, limit=width)
    label_height = len(row.labels) * (SMALL + 6)
    pen.advance(max(height + (SMALL + 7 if row.captions else 0), label_height) + GAP)
    return placed
