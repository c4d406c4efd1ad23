"""``headbench doctor bench splats``: time of the renderer's two passes, and speedup by settings that reduce accuracy."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ...bench.contracts import Progress
from ...bench.doctor import Row, findings, take_turns
from ...bench.specs import CommandResult
from ..shared.threads import torch_threads
from ..splats import available_backends, cpu, rasterize
from ..splats.request import Rendering
from .scenes import SplatScene, head_shell

SIZES = ((128, 184), (275, 401), (550, 802))
COUNTS = (5_000, 20_000, 60_000)
GRID = tuple((count, *size) for size in SIZES for count in COUNTS)
QUICK_GRID = tuple((count, *size) for count, size in zip(COUNTS, SIZES))
ROUNDS, QUICK_ROUNDS = 9, 3
FLOPS = {"draw": (26, 2), "draw backward": (40, 4)}
"""Floating-point operations of a stage for a pair of splat and pixel, and for each channel of it, by count in the kernel's
source: a multiply-add is two, a comparison or selection none."""
EXACT: tuple[str, str] = ("exact", "-")


class Passes:
    """Both passes over a scene as a training step calls them, from leaves to their gradients."""

    def __init__(self, scene: SplatScene, backend: str, threads: int, **options: Any):
        self._scene, self._options = scene, {"backend": backend, "threads": threads, **options}
        self._leaves = [value.clone().requires_grad_() for value in scene[:5]]
        self._upstream = torch.randn(scene.height, scene.width, scene.colors.shape[1])
        self.forward = float("inf")
        self.stages: dict[str, float] = {}

    def draw(self) -> Rendering:
        """The forward pass."""
        inputs: Any = (*self._leaves, *self._scene[5:9])
        return rasterize(*inputs, background=self._scene.background, **self._options)

    def __call__(self) -> None:
        """Run both passes; keep the minimum seconds of the forward pass and of the kernel's stages."""
        for leaf in self._leaves:
            leaf.grad = None
        start = time.thread_time()
        image = self.draw().image
        self.forward = min(self.forward, time.thread_time() - start)
        node = image.grad_fn
        image.backward(self._upstream)
        if hasattr(node, "frame"):
            for name, seconds in cpu.stage_seconds(node).items():
                self.stages[name] = min(self.stages.get(name, seconds), seconds)


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Time every size on every instruction set; with ``quick`` three sizes, in few runs."""
    backends = [name for name in available_backends() if name.startswith("cpu-")] or ["reference"]
    peaks = {name: cpu.peak_flops(name) for name in backends if name != "reference"}
    grid = QUICK_GRID if quick else GRID
    rows = []
    with torch_threads(1):
        for number, size in enumerate(grid):
            progress(number, len(grid), f"{size[0]} splats")
            scene = head_shell(*size)
            rows += [
                measure_backend(scene, name, peaks.get(name), QUICK_ROUNDS if quick else ROUNDS)
                for name in backends
            ]
    rates = ", ".join(f"{name} {1e-9 * peak:.0f}" for name, peak in peaks.items())
    note = (
        "Processor ms of one thread, the least of runs; by stage of the kernel to the right. Pairs are of a splat and a "
        "pixel it\ncontributes to, of both passes. % of peak: arithmetic of the drawing stages over the multiply-adds that "
        f"one thread does here\n(Gflop/s: {rates or 'not measured'}). Speed-up: by a second thread, of medians by the clock."
    )
    return findings({"Both passes of the renderer": rows}, note)


def measure_backend(scene: SplatScene, backend: str, peak: float | None, rounds: int) -> Row:
    """Time one scene; ``peak`` is the backend's multiply-add rate, where it has a kernel."""
    one, two = (Passes(scene, backend, threads) for threads in (1, 2))
    least = min(take_turns({1: one}, rounds, time.thread_time)[1])
    row = {
        "splats": len(scene.means),
        "image": f"{scene.width}x{scene.height}",
        "backend": backend,
        "forward": 1e3 * one.forward,
        "both": 1e3 * least,
    }
    if peak is None:
        return row
    tested, drawn = cpu.work(one.draw().image.grad_fn)
    wall = take_turns({1: one, 2: two}, rounds)
    row["Mpairs/s"] = 1e-6 * drawn / least
    row |= {stage: 1e3 * seconds for stage, seconds in one.stages.items()}
    channels = scene.colors.shape[1]
    for stage, (pair, channel) in FLOPS.items():
        share = tested * (pair + channels * channel) / one.stages[stage] / peak
        row[f"% of peak, {stage}"] = 100 * share
    median = {threads: sorted(seconds)[rounds // 2] for threads, seconds in wall.items()}
    return {**row, "speed-up": median[1] / median[2]}


TRADEOFF_SIZE, QUICK_TRADEOFF_SIZE = (60_000, 550, 802), (5_000, 128, 184)


def tradeoffs(quick: bool, progress: Progress) -> CommandResult:
    """Errors and times of settings that draw less, relative to exact rendering of a head."""
    scene = head_shell(*(QUICK_TRADEOFF_SIZE if quick else TRADEOFF_SIZE))
    backend = available_backends()[0]
    with torch_threads(1):
        runs = {
            name: Passes(changed, backend, 1, **options)
            for name, changed, options in settings(scene, contributions(scene, backend))
        }
        progress(0, 1, f"{len(runs)} settings in turn")
        seconds = take_turns(runs, QUICK_ROUNDS if quick else ROUNDS, time.thread_time)
        images = {name: run.draw().image.detach().double() for name, run in runs.items()}
    rows = []
    for (knob, value), run in runs.items():
        error = (images[knob, value] - images[EXACT]).abs()
        squared, both = float(error.square().mean()), min(seconds[knob, value])
        rows.append(
            {
                "knob": knob,
                "setting": value,
                "splats": len(run.draw().radii),
                "mean error": float(error.mean()),
                "largest": float(error.max()),
                "PSNR": -10 * math.log10(squared) if squared else None,
                "forward": 1e3 * run.forward,
                "both": 1e3 * both,
                "x exact": min(seconds[EXACT]) / both,
            }
        )
    note = (
        f"{scene.width}x{scene.height}, backend {backend}; processor ms of one thread, the least of runs that take turns. "
        "Errors are\nagainst the exact setting; contributions are those in the very view that is timed."
    )
    return findings({"What giving up accuracy buys": rows}, note)


def settings(
    scene: SplatScene, weight: Tensor
) -> Iterator[tuple[tuple[str, str], SplatScene, dict[str, Any]]]:
    """Name and value of each setting, splats to draw, and options of `rasterize`; the exact ones first."""
    yield EXACT, scene, {}
    for alpha in (2, 4, 8):
        yield ("least alpha", f"{alpha}/255"), scene, {"alpha_min": alpha / 255}
    for transmittance in (1e-3, 1e-2, 5e-2):
        options = {"transmittance_min": transmittance}
        yield ("least transmittance", f"{transmittance:g}"), scene, options
    for part in (90, 75, 50, 25):
        kept = weight.argsort(descending=True, stable=True)[: round(part / 100 * len(weight))]
        yield ("keep by contribution", f"{part} %"), _subset(scene, kept.sort().values), {}
    for limit in (0.02, 0.05, 0.1, 0.2):
        yield ("drop below opacity", f"{limit:g}"), _subset(scene, scene.opacities >= limit), {}
    yield ("half-precision colours", "float16"), scene._replace(colors=scene.colors.half().float()), {}


def contributions(scene: SplatScene, backend: str) -> Tensor:
    """Sum of each splat's weights over the pixels (N,): the gradient of its colour for an image gradient of ones."""
    colors = torch.ones(len(scene.means), 1, requires_grad=True)
    image = rasterize(*scene[:4], colors, *scene[5:9], background=torch.zeros(1), backend=backend).image
    (gradient,) = torch.autograd.grad(image.sum(), colors)
    return gradient[:, 0]


def _subset(scene: SplatScene, kept: Tensor) -> SplatScene:
    return scene._replace(**{field: getattr(scene, field)[kept] for field in SplatScene._fields[:5]})
