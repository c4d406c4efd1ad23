"""Stored curves as Markdown for a page: quality by training cost, and the best methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...bench.progress import counted
from ..runs import RunData
from ..writers import pipe_table
from .curve import CurveData, leaders_text, read_curve
from .points import HELD_OUT, column

UNITS = {"seconds": " s", "pictures": ""}
"""Varied quantities of stored curves, and the unit of their columns."""


def curve_block(runs: Sequence[Path], over: str) -> str:
    """Quality of all methods, and the best ones: Markdown."""
    curve = read_curve([RunData.read(run) for run in runs], over)
    return f"{_table(curve)}\n\n{leaders_text(curve)}"


def _table(curve: CurveData) -> str:
    """PSNR of both kinds of held-out frames by method and quantity, and the size of the avatar."""
    (psnr,) = (spec for spec in curve.metrics if spec.name == "psnr")
    amounts = sorted({_amount(curve.over, point.place) for point in curve.means})
    lines = [
        ["", *(f"{amount:g}{UNITS[curve.over]}" for amount in amounts), "MB"],
        ["---"] * (2 + len(amounts)),
    ]
    for method in dict.fromkeys(point.method for point in curve.means):
        own = {_amount(curve.over, p.place): p for p in curve.means if p.method == method}
        cells = []
        for amount in amounts:
            values = [own[amount].values[column(psnr, task)] for task in curve.tasks] if amount in own else []
            cells.append(" / ".join("–" if v is None else f"{v:.{psnr.digits}f}" for v in values) or "–")
        sizes = [size for point in own.values() if (size := point.values["storage"]) is not None]
        ends = dict.fromkeys(f"{size:.1f}" for size in (min(sizes), max(sizes))) if sizes else ["–"]
        lines.append([f"`{method}`", *cells, " to ".join(ends)])
    kinds = " / ".join(HELD_OUT[task] for task in curve.tasks)
    subjects = f"{counted(len(curve.subjects), 'subject')} ({', '.join(curve.subjects)})"
    return f"PSNR in dB, held-out {kinds}, means over {subjects}:\n\n{pipe_table(lines)}"


def _amount(over: str, place: Sequence[float]) -> float:
    """Seconds or number of images, from the place of a point; see `CurvePoint`."""
    return place[1 if over == "seconds" else 2]
