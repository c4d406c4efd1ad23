"""What giving up accuracy buys: each knob as a curve of error against time, beside the exact setting.

The kernel itself has no inexact mode: the knobs here change the splats it is given, and anyone can turn them. What a splat
contributes is measured in the very view that is timed; over many views fewer splats can be spared.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from ....bench.contracts import Findings, Progress
from ..rasterize import available_backends
from .layout import milliseconds, table
from .passes import draw, leaves, one_torch_thread, passes
from .scenes import Scene, head_shell
from .timing import repeat

SCENE = (60_000, 550, 802)
QUICK_SCENE = (5_000, 128, 184)
KEPT = (0.9, 0.75, 0.5, 0.25)
OPACITIES = (0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Point:
    """One setting of one knob. Seconds are the least of interleaved runs on one thread."""

    knob: str
    setting: str
    splats: int
    mean_error: float
    """Mean absolute error of the image against the exact setting's."""
    psnr: float
    """Of the same, dB, for a peak of 1."""
    forward: float
    both: float


def measure(quick: bool, progress: Progress) -> Findings:
    """Measure every knob on a head's load (60 000 splats at 550x802; fewer and smaller with ``quick``)."""
    scene = head_shell(*(QUICK_SCENE if quick else SCENE))
    budget, least_runs = (0.2, 3) if quick else (1.5, 9)
    backend = available_backends()[0]
    points: list[Point] = []
    with one_torch_thread():
        exact = draw(scene, leaves(scene), backend=backend, threads=1).image.detach()
        knobs = list(settings(scene, backend))
        for knob, setting, changed in knobs:
            progress(len(points), len(knobs), f"{knob} {setting}")
            points.append(_measure(knob, setting, changed, exact, backend, budget, least_runs))
    rows = [
        (
            *(p.knob, p.setting, str(p.splats), f"{p.mean_error:.1e}"),
            "-" if p.psnr == float("inf") else f"{p.psnr:.1f}",
            *(milliseconds(p.forward), milliseconds(p.both), f"{points[0].both / p.both:.2f}"),
        )
        for p in points
    ]
    header = ("knob", "setting", "splats", "mean error", "PSNR", "forward ms", "with backward ms", "x exact")
    text = (
        f"{scene.width}x{scene.height}, backend {backend}, one thread, processor time. Errors are against the exact "
        f"setting.\n\n{table(header, rows)}"
    )
    return Findings(text, {"backend": backend, "points": [asdict(point) for point in points]})


def settings(scene: Scene, backend: str) -> Iterator[tuple[str, str, Scene]]:
    """Every knob's settings as scenes: the exact one first."""
    yield "exact", "-", scene
    weight = contributions(scene, backend)
    for part in KEPT:
        kept = weight.argsort(descending=True, stable=True)[: round(part * len(weight))].sort().values
        yield "keep by contribution", f"{100 * part:.0f} %", _subset(scene, kept)
    for limit in OPACITIES:
        yield (
            "drop below opacity",
            f"{limit:g}",
            _subset(scene, (scene.opacities >= limit).nonzero().flatten()),
        )
    yield "half-precision colours", "float16", scene._replace(colors=scene.colors.half().float())


def contributions(scene: Scene, backend: str) -> Tensor:
    """Sum of each splat's weights over the pixels (N,): the gradient of its colour for an image gradient of ones."""
    inputs = leaves(scene._replace(colors=torch.ones(len(scene.means), 1), background=torch.zeros(1)))
    one = scene._replace(background=torch.zeros(1))
    draw(one, inputs, backend=backend).image.sum().backward()
    gradient = inputs[4].grad
    assert gradient is not None
    return gradient[:, 0]


def _subset(scene: Scene, kept: Tensor) -> Scene:
    return scene._replace(**{field: getattr(scene, field)[kept] for field in Scene._fields[:5]})


def _measure(
    knob: str, setting: str, scene: Scene, exact: Tensor, backend: str, budget: float, least_runs: int
) -> Point:
    run = passes(scene, backend, threads=1)

    def frame(clock: Callable[[], float]) -> tuple[float, float]:
        forward, both, _ = run(clock)
        return forward, both

    forward, both = repeat(frame, budget=budget, least_runs=least_runs, clock=time.thread_time)
    error = draw(scene, leaves(scene), backend=backend, threads=1).image.detach() - exact
    squared = float(error.square().mean())
    psnr = -10 * float(torch.log10(torch.tensor(squared))) if squared else float("inf")
    return Point(
        *(knob, setting, len(scene.means), float(error.abs().mean()), psnr), forward.least, both.least
    )
