"""How fast the renderer is: scenes of a head avatar's load, every backend, a portable anchor in the same run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import torch

from ....bench.contracts import Progress
from ....bench.errors import UnavailableError
from ....bench.machine import machine_record
from ....bench.specs import Findings
from ....datasets.head.procedural.model import procedural_head
from ....methods.splats import cpu
from ....methods.splats.rasterize import available_backends
from . import anchor
from .accuracy import compare_with, float64_truth
from .cells import Cell, speed_tables
from .order import Ordering, bound_head, measure_order, order_table
from .passes import draw, leaves, one_torch_thread, passes
from .scenes import Scene, head_shell
from .threads import Scaling, measure_threads, threads_table
from .timing import repeat

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
    with one_torch_thread():
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
