"""The contact sheet of cross-reenactment: the source's frame above, the avatars it drives below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from PIL import Image

from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import atomic_path
from ...bench.io.frames import read_png
from ..drawing import MUTED, Pen
from .extremes_sheet import BROKEN, GAP, LINE, MARGIN, SMALL, TEXT, TITLE, fitted
from .trial import RECORD_FILE, SHEET_FILE

LABELS, PANEL_WIDTH, COLUMNS = 120, 150, 8


def write_reenact_sheet(folder: Path, panel_width: int = PANEL_WIDTH, columns: int = COLUMNS) -> Path:
    """Draw the sheet of a folder that ``headbench reenact`` left; returns the PNG.

    Up to ``columns`` timesteps of each pair of target and source, evenly spaced. A frame that breaks a limit has a
    red frame.
    """
    avatars: Sequence[Mapping[str, Any]] = read_json(folder / RECORD_FILE)["avatars"]
    if not avatars:
        raise InputError(folder / RECORD_FILE, "avatars", "at least one", "none")
    pen = Pen(2 * MARGIN + LABELS + columns * (panel_width + GAP), MARGIN)
    pen.text(MARGIN, "Cross-reenactment", TITLE)
    pen.advance(TITLE + 10)
    legend = "Expressions of the source in the first row, avatars of another subject below; no ground truth."
    pen.text(MARGIN, legend, SMALL, MUTED)
    pen.advance(SMALL + 8)
    pen.frame(MARGIN + LINE, 12, 12, BROKEN, LINE)
    pen.text(MARGIN + 28, "a limit is broken", SMALL, MUTED)
    pen.advance(SMALL + 14)

    def pair(avatar: Mapping[str, Any]) -> tuple[str, str]:
        return avatar["subject"], avatar["source"]

    for (target, source), group in groupby(sorted(avatars, key=pair), key=pair):
        _draw_pair(pen, folder, f"Subject {target} driven by {source}", list(group), panel_width, columns)
    pen.advance(MARGIN - GAP)
    with atomic_path(folder / SHEET_FILE) as temporary:
        Image.fromarray(pen.finish()).save(temporary, optimize=True)
    return folder / SHEET_FILE


def _draw_pair(
    pen: Pen,
    folder: Path,
    title: str,
    avatars: Sequence[Mapping[str, Any]],
    panel_width: int,
    columns: int,
) -> None:
    pen.advance(8)
    pen.text(MARGIN, title, TEXT)
    pen.advance(TEXT + 10)
    pen.rule(MARGIN, pen.width - MARGIN)
    pen.advance(8)
    frames = avatars[0]["shown"]
    count = min(columns, len(frames))
    chosen = [(2 * i + 1) * len(frames) // (2 * count) for i in range(count)]
    for column, index in enumerate(chosen):
        _, _, sequence, timestep, _ = frames[index]["key"].split("/")
        left = MARGIN + LABELS + column * (panel_width + GAP)
        pen.text(left, f"{sequence} {int(timestep)}", SMALL, MUTED, limit=panel_width)
    pen.advance(SMALL + 8)
    _draw_row(pen, folder, "source", [frames[i]["source"] for i in chosen], [False] * count, panel_width)
    for avatar in avatars:
        broken = {item["key"] for item in avatar["broken"]}
        shown = [avatar["shown"][i] for i in chosen]
        label = f"{avatar['method']}, seed {avatar['seed']}"
        paths, marked = [s["driven"] for s in shown], [s["key"] in broken for s in shown]
        _draw_row(pen, folder, label, paths, marked, panel_width)


def _draw_row(
    pen: Pen, folder: Path, label: str, paths: Sequence[str], marked: Sequence[bool], panel_width: int
) -> None:
    pen.text(MARGIN, label, SMALL, MUTED, limit=LABELS - 8)
    height = 0
    for column, (name, broken) in enumerate(zip(paths, marked)):
        left = MARGIN + LABELS + column * (panel_width + GAP)
        if not (folder / name).exists():
            pen.grey_box(left, panel_width, panel_width, "not finite", SMALL)
            height = max(height, panel_width)
            continue
        image = fitted(read_png(folder / name), panel_width)
        height = max(height, image.shape[0])
        pen.image(left, image)
        if broken:
            pen.frame(left, panel_width, image.shape[0], BROKEN, LINE)
        else:
            pen.frame(left, panel_width, image.shape[0])
    pen.advance(height + GAP)
