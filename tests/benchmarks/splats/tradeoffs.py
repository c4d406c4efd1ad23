"""What giving up accuracy buys: each knob as a curve of error against time, beside the exact setting.

Two knobs are options of `rasterize`: from which alpha on splats are drawn, and at which transmittance a pixel is done. The
others change the splats that the kernel is given. What a splat contributes is measured in the very view that is timed; over
many views fewer splats can be spared. A cheaper exponential is no knob: one of degree 3 instead of 5 made frames less than
2 % faster, within the noise, and the mean error 200 times as large.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ....bench.contracts import Progress
from ....bench.specs import Findings
from ....methods.splats.rasterize import available_backends
from ..timing import milliseconds, table, take_turns, torch_threads
from .scenes import Scene, draw, head_shell, leaves, passes

SCENE = (60_000, 550, 802)
QUICK_SCENE = (5_000, 128, 184)
KEPT = (0.9, 0.75, 0.5, 0.25)
OPACITIES = (0.02, 0.05, 0.1, 0.2)
ALPHAS = (2 / 255, 4 / 255, 8 / 255)
TRANSMITTANCES = (1e-3, 1e-2, 5e-2)


@dataclass(frozen=True, eq=False)
class Setting:
    """One setting of one knob: the splats to draw and the options of `rasterize`."""

    knob: str
    name: str
    scene: Scene
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Point:
    """One setting of one knob. Seconds are the least of interleaved runs on one thread."""

    knob: str
    setting: str
    splats: int
    mean_error: float
    """Mean absolute error of the image against the exact setting's."""
    max_error: float
    psnr: float | None
    """Of the same, dB, for a peak of 1; None where the images are equal."""
    forward: float
    both: float


def measure(quick: bool, progress: Progress) -> Findings:
    """Measure every knob on a head's load (60 000 splats at 550x802; fewer and smaller with ``quick``)."""
    scene = head_shell(*(QUICK_SCENE if quick else SCENE))
    budget, least_runs = (0.2, 3) if quick else (1.5, 9)
    backend = available_backends()[0]
    with torch_threads(1):
        turned = list(settings(scene, backend))
        progress(0, 1, f"{len(turned)} settings in turn")
        forward, both = _time(turned, backend, budget * len(turned), least_runs)
        exact = _image(turned[0], backend)
        points = [_point(turned[k], exact, backend, forward[k], both[k]) for k in range(len(turned))]
        progress(1, 1)
    rows = [
        (
            *(p.knob, p.setting, str(p.splats), f"{p.mean_error:.1e}", f"{p.max_error:.1e}"),
            "-" if p.psnr is None else f"{p.psnr:.1f}",
            *(milliseconds(p.forward), milliseconds(p.both), f"{points[0].both / p.both:.2f}"),
        )
        for p in points
    ]
    header = (
        *("knob", "setting", "splats", "mean error", "largest", "PSNR"),
        *("forward ms", "with backward ms", "x exact"),
    )
    text = (
        f"{scene.width}x{scene.height}, backend {backend}, one thread, processor time. Errors are against the exact "
        f"setting.\n\n{table(header, rows)}"
    )
    return Findings(text, {"backend": backend, "points": [asdict(point) for point in points]})


def settings(scene: Scene, backend: str) -> Iterator[Setting]:
    """Every knob's settings: the exact one first."""
    yield Setting("exact", "-", scene)
    for alpha in ALPHAS:
        yield Setting("least alpha", f"{255 * alpha:.0f}/255", scene, {"alpha_min": alpha})
    for transmittance in TRANSMITTANCES:
        yield Setting(
            "least transmittance", f"{transmittance:g}", scene, {"transmittance_min": transmittance}
        )
    weight = contributions(scene, backend)
    for part in KEPT:
        kept = weight.argsort(descending=True, stable=True)[: round(part * len(weight))].sort().values
        yield Setting("keep by contribution", f"{100 * part:.0f} %", _subset(scene, kept))
    for limit in OPACITIES:
        opaque = (scene.opacities >= limit).nonzero().flatten()
        yield Setting("drop below opacity", f"{limit:g}", _subset(scene, opaque))
    half = scene._replace(colors=scene.colors.half().float())
    yield Setting("half-precision colours", "float16", half)


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


def _time(
    turned: list[Setting], backend: str, budget: float, least_runs: int
) -> tuple[list[float], list[float]]:
    """Least seconds of the forward pass and of both passes, by setting; the settings take turns."""
    forward = [float("inf")] * len(turned)
    runs = [passes(one.scene, backend, threads=1, **one.options) for one in turned]

    def frame(k: int) -> float:
        first, whole, _ = runs[k](time.thread_time)
        forward[k] = min(forward[k], first)
        return whole

    both = take_turns({k: partial(frame, k) for k in range(len(runs))}, budget=budget, least_runs=least_runs)
    return forward, [min(both[k]) for k in range(len(runs))]


def _image(one: Setting, backend: str) -> Tensor:
    image = draw(one.scene, leaves(one.scene), backend=backend, threads=1, **one.options).image
    return image.detach().double()


def _point(one: Setting, exact: Tensor, backend: str, forward: float, both: float) -> Point:
    error = (_image(one, backend) - exact).abs()
    squared = float(error.square().mean())
    psnr = -10 * math.log10(squared) if squared else None
    return Point(
        *(one.knob, one.name, len(one.scene.means), float(error.mean()), float(error.max()), psnr),
        *(forward, both),
    )
