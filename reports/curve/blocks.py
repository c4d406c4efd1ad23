"""Stored curves as Markdown for a page: quality by training cost, the best methods, and recommendations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...bench.progress import counted
from ..recommend import RecommendSettings, recommend
from ..runs import RunData
from ..writers import pipe_table
from .curve import CurveData, leaders_text, read_curve
from .points import HELD_OUT, column

UNITS = {"seconds": " s", "pictures": ""}
"""Varied quantities of stored curves, and the unit of their columns."""
TASK = "self_reenactment"
"""Held-out frames that recommendations are for."""


def curve_block(runs: Sequence[Path], over: str) -> str:
    """Quality of all methods, the best ones and, for seconds, the recommended ones: Markdown."""
    curve = read_curve([RunData.read(run) for run in runs], over)
    parts = [_table(curve), leaders_text(curve)]
    if over == "seconds":
        limits = sorted({point.budget.seconds or 0.0 for point in curve.points})
        parts += _recommended(runs, limits)
    return "\n\n".join(parts)


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


def _recommended(runs: Sequence[Path], limits: Sequence[float]) -> list[str]:
    """Text of `headbench recommend` for limits of seconds, without tables and repeated sentences."""
    found = [
        recommend(RecommendSettings(tuple(map(str, runs)), seconds=limit, task=TASK)).data for limit in limits
    ]
    common = [text for text in found[0]["conclusions"] if all(text in each["conclusions"] for each in found)]
    lines = []
    for limit, each in zip(limits, found):
        named = str(each["recommended"]).removesuffix(f"+seconds-{limit:g}").replace("+", "` with `")
        own = " ".join(text for text in each["conclusions"] if text not in common)
        lines.append(f"- Up to {limit:g} s: `{named}`. {own}".strip())
    return ["Recommended by `headbench recommend` for held-out timesteps:", "\n".join(lines), *common]
