"""What the speed bench measured, and how it is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .accuracy import Accuracy
from .layout import milliseconds, table
from .timing import Times

STAGES = ("project", "sort", "find pairs", "draw", "draw backward", "project backward")


@dataclass(frozen=True)
class Cell:
    """One scene drawn by one backend on one thread. Pairs are of a splat and a pixel, of one frame."""

    splats: int
    width: int
    height: int
    backend: str
    forward: Times
    both: Times
    tested: int | None = None
    """Pairs whose alpha was computed."""
    drawn: int | None = None
    """Pairs that contributed."""
    stages: dict[str, float] | None = None
    """Seconds by stage, the least over the runs."""
    peak_share: tuple[float, float] | None = None
    """Arithmetic of the drawing stages, forward and backward, over the measured multiply-add rate."""
    ratio_to_anchor: float | None = None
    """The anchor's least time for both passes over this one's."""
    accuracy: Accuracy | None = None
    """Errors against the reference in float64, where they were measured."""


def speed_tables(cells: Sequence[Cell], peaks: dict[str, float], missing: str) -> str:
    """Lay out the results; ``missing`` says why there is no anchor, ``peaks`` are flops a second by backend."""
    parts = [
        "Processor time of one thread in ms: least and median of the runs; spread is between the quartiles. A pair is "
        "a splat\nand a pixel it contributes to; the ratio is to the anchor's time for both passes. Errors are against "
        "float64: the\nimage's mean, the share of pixels off by more than 1e-5, and the worst gradient's, relative.\n\n"
        + _times(cells)
    ]
    if missing:
        parts.append(f"No anchor. {missing}")
    kernels = [cell for cell in cells if cell.stages]
    if kernels:
        rates = ", ".join(f"{name} {1e-9 * peak:.0f}" for name, peak in peaks.items())
        parts.append(
            "Stages of the kernel, ms, least of the runs. The last columns are the arithmetic of the drawing stages (by "
            f"count in\nthe source) over the multiply-add rate measured in this run ({rates} GFlop/s).\n\n"
            + _stages(kernels)
        )
    return "\n\n".join(parts)


def _times(cells: Sequence[Cell]) -> str:
    header = (
        *("splats", "image", "backend", "forward", "median", "spread", "with backward", "median", "spread"),
        *("Mpairs/s forward", "both", "x anchor", "image error", "pixels off", "gradient error"),
    )
    return table(header, [_times_row(cell) for cell in cells])


def _times_row(cell: Cell) -> tuple[str, ...]:
    both = (cell.forward, cell.both)
    return (
        *_scene(cell),
        cell.backend,
        *(milliseconds(s) for times in both for s in (times.least, times.median, times.iqr)),
        *("-" if cell.drawn is None else f"{1e-6 * cell.drawn / times.least:.0f}" for times in both),
        "-" if cell.ratio_to_anchor is None else f"{cell.ratio_to_anchor:.1f}",
        *_errors(cell.accuracy),
    )


def _errors(accuracy: Accuracy | None) -> tuple[str, str, str]:
    if accuracy is None:
        return "-", "-", "-"
    worst = max(accuracy.gradients.values())
    return f"{accuracy.image_mean:.1e}", f"{100 * (1 - accuracy.pixels_equal):.4f} %", f"{worst:.1e}"


def _stages(cells: Sequence[Cell]) -> str:
    rows = []
    for cell in cells:
        times = [f"{1e3 * (cell.stages or {})[name]:.2f}" for name in STAGES]
        shares = [f"{100 * share:.0f} %" for share in cell.peak_share or ()]
        rows.append((*_scene(cell), cell.backend, *times, *shares))
    return table(("splats", "image", "backend", *STAGES, "of peak: draw", "draw backward"), rows)


def _scene(of: Cell) -> tuple[str, str]:
    return str(of.splats), f"{of.width}x{of.height}"
