"""The contact sheet of avatars at extremes: a column a view, a row a step along the components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
from PIL import Image

from ...bench.contracts import ByteArray
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import atomic_path
from ...bench.io.frames import read_png
from ..drawing import MUTED, Colour, Pen, wrap
from .trial import RECORD_FILE, SHEET_FILE

EXTRAPOLATED: Colour = (232, 135, 20)
BROKEN: Colour = (205, 20, 45)
GAP, MARGIN, LABELS, LINE = 8, 24, 66, 3
TITLE, TEXT, SMALL = 20, 15, 12
PANEL_WIDTH = 110


def write_extremes_sheet(folder: Path, panel_width: int = PANEL_WIDTH) -> Path:
    """Draw the sheet of a folder that ``headbench extremes`` left; returns the PNG.

    Views beyond the training cameras have an orange frame, frames that break a limit a red one. In every view the
    expression goes along one component, named above its column, from the mean in the first row outwards.
    """
    record = read_json(folder / RECORD_FILE)
    avatars: Sequence[Mapping[str, Any]] = record["avatars"]
    if not avatars:
        raise InputError(folder / RECORD_FILE, "avatars", "at least one", "none")
    columns = max(len(avatar["views"]) for avatar in avatars)
    width = 2 * MARGIN + LABELS + columns * (panel_width + GAP)
    pen = Pen(max(width, 640), MARGIN)
    pen.text(MARGIN, "Novel views and expressions", TITLE)
    pen.advance(TITLE + 10)
    legend = (
        "Turntable between the training cameras; every column goes along one principal component of the training "
        "expressions, in steps of its standard deviation. No ground truth."
    )
    for line in wrap(legend, SMALL, pen.width - 2 * MARGIN):
        pen.text(MARGIN, line, SMALL, MUTED)
        pen.advance(SMALL + 5)
    _key(pen)
    for avatar in avatars:
        _draw_avatar(pen, folder, avatar, panel_width)
    pen.advance(MARGIN - GAP)
    with atomic_path(folder / SHEET_FILE) as temporary:
        Image.fromarray(pen.finish()).save(temporary, optimize=True)
    return folder / SHEET_FILE


def _key(pen: Pen) -> None:
    pen.advance(8)
    left = MARGIN
    for colour, text in ((EXTRAPOLATED, "view beyond the training cameras"), (BROKEN, "a limit is broken")):
        pen.frame(left + LINE, 12, 12, colour, LINE)
        pen.text(left + 28, text, SMALL, MUTED)
        left += 260
    pen.advance(SMALL + 14)


def _draw_avatar(pen: Pen, folder: Path, avatar: Mapping[str, Any], panel_width: int) -> None:
    cell = folder / avatar["subject"] / avatar["method"] / f"seed-{avatar['seed']}"
    views, names = avatar["views"], avatar["expressions"]
    components = max((_component(name) for name in names), default=0)
    broken = {item["key"] for item in avatar["broken"]}
    verdict = f"{avatar['frames_broken']} of {avatar['frames']} frames break a limit"
    pen.advance(8)
    pen.text(
        MARGIN, f"{avatar['method']}, subject {avatar['subject']}, seed {avatar['seed']}: {verdict}", TEXT
    )
    pen.advance(TEXT + 10)
    pen.rule(MARGIN, pen.width - MARGIN)
    pen.advance(8)
    for index, view in enumerate(views):
        left = MARGIN + LABELS + index * (panel_width + GAP)
        component = f", pc{index % components + 1}" if components else ""
        pen.text(left, f"{view['azimuth']:+.0f}°{component}", SMALL, MUTED, limit=panel_width)
    pen.advance(SMALL + 8)
    for step in _steps(names):
        height = 0
        pen.text(MARGIN, f"{step} s.d." if step else "mean", SMALL, MUTED)
        for index, view in enumerate(views):
            name = f"pc{index % components + 1}{step}" if step else "mean"
            left = MARGIN + LABELS + index * (panel_width + GAP)
            path = cell / f"{name}_{view['id']}.png"
            key = f"{avatar['subject']}/{name}/{names.index(name):05d}/{view['id']}"
            if not path.exists():
                pen.grey_box(left, panel_width, panel_width, "not finite", SMALL)
                height = max(height, panel_width)
                continue
            image = fitted(read_png(path), panel_width)
            height = max(height, image.shape[0])
            pen.image(left, image)
            if key in broken:
                pen.frame(left, panel_width, image.shape[0], BROKEN, LINE)
            elif view["extrapolated"]:
                pen.frame(left, panel_width, image.shape[0], EXTRAPOLATED, LINE)
            else:
                pen.frame(left, panel_width, image.shape[0])
        pen.advance(height + GAP)


def _component(name: str) -> int:
    """Number of the component in ``pc3+2``, 0 for the mean."""
    return 0 if name == "mean" else int(name[2:].replace("-", "+").split("+")[0])


def _steps(names: Sequence[str]) -> list[str]:
    """The mean (as ""), then the steps of the first component: small ones first, each with its opposite."""
    steps = [name[3:] for name in names if _component(name) == 1]
    return ["", *sorted(steps, key=lambda step: (abs(float(step)), -float(step)))]


def fitted(image: ByteArray, width: int) -> ByteArray:
    """The image at a panel's width, by area where that is smaller."""
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    larger = width > image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC if larger else cv2.INTER_AREA)  # type: ignore[return-value]
