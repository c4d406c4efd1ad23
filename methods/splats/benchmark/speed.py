"""How fast the renderer is: scenes of a head avatar's load, every backend, a portable anchor in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from ....bench.contracts import Findings, Progress
from ....bench.errors import UnavailableError
from ....bench.machine import machine_record
from .. import cpu
from ..rasterize import available_backends, rasterize
from ..request import Rendering
from . import anchor
from .cells import Cell, Scaling, speed_tables
from .scenes import Scene, head_shell
from .timing import repeat

DIAGONAL = ((5_000, 128, 184), (20_000, 275, 401), (60_000, 550, 802))
GRID = tuple((count, width, height) for _, width, height in DIAGONAL for count, _, _ in DIAGONAL)
ANCHOR = "numba anchor"

# Floating-point operations by count in the kernel's source, for one tested pair of splat and pixel with C channels:
# a multiply-add is two, a comparison or selection none.
FORWARD_FLOPS = (26, 2)  # + per channel
BACKWARD_FLOPS = (40, 4)


def measure(quick: bool, progress: Progress) -> Findings:
    """Run the speed bench: the whole grid of sizes, or with ``quick`` its diagonal with few runs."""
    scenes, budget, least_runs = (DIAGONAL, 0.3, 3) if quick else (GRID, 1.5, 7)
    kernels = [name for name in available_backends() if name.startswith("cpu-")]
    try:
        anchor_passes, missing = anchor.load(), ""
    except UnavailableError as error:
        anchor_passes, missing = None, str(error)
    peaks = {name: cpu.peak_flops(name) for name in kernels}
    steps = len(scenes) * (len(kernels) + (anchor_passes is not None)) + len(DIAGONAL)
    cells: list[Cell] = []
    scaling: list[Scaling] = []
    with one_torch_thread():
        for count, width, height in scenes:
            scene = head_shell(count, width, height)
            row: list[Cell] = []
            for name in kernels:
                progress(len(cells) + len(row), steps, f"{count} splats, {name}")
                row.append(measure_kernel(scene, name, peaks[name], budget=budget, least_runs=least_runs))
            if anchor_passes is not None:
                row.append(_measure_anchor(scene, anchor_passes, row, budget=budget))
                row = [_with_ratio(cell, row[-1]) for cell in row]
            cells += row
            progress(len(cells), steps)
        for count, width, height in DIAGONAL if kernels else ():
            scaling.append(measure_threads(head_shell(count, width, height), budget=2 * budget))
            progress(len(cells) + len(scaling), steps)
    data = {
        "machine": machine_record(),
        "peak_flops": peaks,
        "anchor_missing": missing,
        "cells": [asdict(cell) for cell in cells],
        "threads": [asdict(one) for one in scaling],
    }
    return Findings(speed_tables(cells, peaks, scaling, missing), data)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread, so that its own work counts to the thread that is timed."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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


def passes(
    scene: Scene, backend: str, threads: int, **options: Any
) -> Callable[..., tuple[float, float, Any]]:
    """Build a function that renders and differentiates, and gives both times and the forward pass's autograd node."""
    inputs = leaves(scene)
    upstream = torch.randn(scene.height, scene.width, scene.colors.shape[1])

    def run(clock: Callable[[], float]) -> tuple[float, float, Any]:
        for leaf in inputs:
            leaf.grad = None
        start = clock()
        image = draw(scene, inputs, backend=backend, threads=threads, **options).image
        forward = clock() - start
        node = image.grad_fn
        image.backward(upstream)
        return forward, clock() - start, node

    return run


def leaves(scene: Scene) -> list[Tensor]:
    """Copies of what describes the splats, to be differentiated by."""
    return [value.clone().requires_grad_() for value in scene[:5]]


def draw(scene: Scene, inputs: Sequence[Tensor], **options: Any) -> Rendering:
    """Render ``inputs`` (means, quaternions, scales, opacities, colours) with the scene's camera."""
    means, quats, scales, opacities, colors = inputs
    camera = (scene.viewmat, scene.K, scene.width, scene.height)
    return rasterize(means, quats, scales, opacities, colors, *camera, background=scene.background, **options)


def measure_threads(scene: Scene, *, budget: float) -> Scaling:
    """Wall time of both passes with one and with two threads, taken in turn so that both see the same machine."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    runs = {threads: passes(scene, "cpu", threads) for threads in seconds}
    start = time.monotonic()
    while len(seconds[1]) < 5 or time.monotonic() - start < budget:
        for threads, run in runs.items():
            seconds[threads].append(run(time.perf_counter)[1])
    return Scaling(len(scene.means), scene.width, scene.height, min(seconds[1]), min(seconds[2]))


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
