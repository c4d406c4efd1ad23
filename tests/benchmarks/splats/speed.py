"""What the speed bench measured, and how it is shown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import torch

from ....bench.contracts import Progress
from ....bench.errors import UnavailableError
from ....bench.machine import machine_record
from ....bench.specs import Findings
from ....datasets.head.procedural.model import procedural_head
from ....methods.splats import cpu
from ....methods.splats.rasterize import available_backends
from ..timing import Times, milliseconds, repeat, table, torch_threads
from . import anchor
from .order import Ordering, bound_head, measure_order, order_table
from .scenes import Accuracy, Scene, compare_with, draw, float64_truth, head_shell, leaves, passes
from .threads import Scaling, measure_threads, threads_table

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


DIAGONAL = ((5_000, 128, 184), (20_000, 275, 401), (60_000, 550, 802))
GRID = tuple((count, width, height) for _, width, height in DIAGONAL for count, _, _ in DIAGONAL)
ANCHOR = "numba anchor"

# Floating-point operations by count in the kernel's source, for one tested pair of splat and pixel with C channels:
# a multiply-add is two, a comparison or selection none.
FORWARD_FLOPS = (26, 2)  # + per channel
BACKWARD_FLOPS = (40, 4)


def measure(quick: bool, progress: Progress) -> Findings:
    """Run the speed bench: the whole grid of sizes, or with ``quick`` its diagonal with few runs.

    Errors are measured on the diagonal, with ``quick`` without its largest scene, which takes float64 half a minute.
    """
    scenes, budget, least_runs = (DIAGONAL, 0.3, 3) if quick else (GRID, 1.5, 7)
    kernels = [name for name in available_backends() if name.startswith("cpu-")]
    try:
        anchor_passes, missing = anchor.load(), ""
    except UnavailableError as error:
        anchor_passes, missing = None, str(error)
    checked = DIAGONAL[:-1] if quick else DIAGONAL
    peaks = {name: cpu.peak_flops(name) for name in kernels}
    steps = len(scenes) * (len(kernels) + (anchor_passes is not None)) + (2 * len(DIAGONAL) if kernels else 0)
    cells: list[Cell] = []
    with torch_threads(1):
        for count, width, height in scenes:
            scene = head_shell(count, width, height)
            row: list[Cell] = []
            for name in kernels:
                progress(len(cells) + len(row), steps, f"{count} splats, {name}")
                row.append(measure_kernel(scene, name, peaks[name], budget=budget, least_runs=least_runs))
            if kernels and (count, width, height) in checked:
                progress(len(cells) + len(row), steps, f"{count} splats, float64")
                truth = float64_truth(scene)
                row = [replace(cell, accuracy=compare_with(truth, scene, cell.backend)) for cell in row]
            if anchor_passes is not None:
                row.append(_measure_anchor(scene, anchor_passes, row, budget=budget))
                row = [_with_ratio(cell, row[-1]) for cell in row]
            cells += row
            progress(len(cells), steps)
        sizes = DIAGONAL if kernels else ()
        scaling: list[Scaling] = []
        orderings: list[Ordering] = []
        for count, width, height in sizes:
            progress(len(cells) + len(scaling), steps, f"{count} splats, threads")
            scene = head_shell(count, width, height)
            scaling.append(measure_threads(scene, budget=2 * budget, least_runs=least_runs))
        head = procedural_head()
        for count, width, height in sizes:
            progress(len(cells) + len(scaling) + len(orderings), steps, f"{count} splats, order")
            bound = bound_head(head, count, width, height)
            orderings.append(measure_order(bound, budget=budget, least_runs=least_runs))
        progress(steps, steps)
    data = {
        "machine": machine_record(),
        "peak_flops": peaks,
        "anchor_missing": missing,
        "cells": [asdict(cell) for cell in cells],
        "threads": [asdict(one) for one in scaling],
        "order": [asdict(one) for one in orderings],
    }
    parts = [speed_tables(cells, peaks, missing)]
    if kernels:
        parts += [threads_table(scaling), order_table(orderings)]
    return Findings("\n\n".join(parts), data)


def measure_kernel(scene: Scene, backend: str, peak: float, *, budget: float, least_runs: int) -> Cell:
    """Time one scene on one thread, as a training step calls the renderer: from leaves to their gradients."""
    stages: dict[str, float] = {}
    run = passes(scene, backend, threads=1)

    def frame(clock: Callable[[], float]) -> tuple[float, float]:
        forward, both, node = run(clock)
        for name, seconds in cpu.stage_seconds(node).items():
            stages[name] = min(stages.get(name, seconds), seconds)
        return forward, both

    forward, both = repeat(frame, budget=budget, least_runs=least_runs)
    tested, drawn = cpu.work(draw(scene, leaves(scene), backend=backend, threads=1).image.grad_fn)
    channels = scene.colors.shape[1]

    def share(flops: tuple[int, int], stage: str) -> float:
        return tested * (flops[0] + flops[1] * channels) / stages[stage] / peak

    return Cell(
        *(len(scene.means), scene.width, scene.height, backend, forward, both, tested, drawn, stages),
        (share(FORWARD_FLOPS, "draw"), share(BACKWARD_FLOPS, "draw backward")),
    )


def _measure_anchor(scene: Scene, passes: anchor.Anchor, row: list[Cell], *, budget: float) -> Cell:
    upstream = torch.randn(scene.height, scene.width, scene.colors.shape[1]).numpy()

    def frame(clock: Callable[[], float]) -> tuple[float, float]:
        start = clock()
        drawn = passes.forward(scene)
        forward = clock() - start
        passes.backward(scene, drawn, upstream)
        return forward, clock() - start

    forward, both = repeat(frame, budget=budget, least_runs=2)
    drawn = row[0].drawn if row else None
    return Cell(len(scene.means), scene.width, scene.height, ANCHOR, forward, both, drawn=drawn)


def _with_ratio(cell: Cell, anchor_cell: Cell) -> Cell:
    return replace(cell, ratio_to_anchor=anchor_cell.both.least / cell.both.least)
