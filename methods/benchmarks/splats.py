"""``headbench doctor bench splats``: time of the renderer's two passes, and speedup by settings that reduce accuracy."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...bench.contracts import Progress
from ...bench.doctor import Row, findings, take_turns
from ...bench.specs import CommandResult
from ..ops.splats import left_products
from ..shared.threads import torch_threads
from ..splats import available_backends, cpu, rasterize
from ..splats.request import Rendering


class SplatScene(NamedTuple):
    """The first nine arguments of `rasterize`, in order, and its background."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    background: Tensor


def head_shell(count: int, width: int, height: int, *, channels: int = 3, seed: int = 0) -> SplatScene:
    """Splats on an ellipsoid of a head's proportions, filling 62 % of the image height.

    Tangential sizes are log-normal about three quarters of the splats' spacing, a fifth of that thick; two fifths of
    the splats at the back and the top are stretched fourfold, as hair is. Many are nearly opaque, many faint.
    """
    rng = torch.Generator().manual_seed(seed)
    half_axes = torch.tensor([0.75, 1.0, 0.85]) * 0.12  # metres; y is up in the head, down in the image
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    means = direction * half_axes
    normals = torch.nn.functional.normalize(direction / half_axes, dim=1)

    area = 4 * math.pi * float(half_axes.prod() ** (2 / 3))
    spacing = math.sqrt(area / max(count, 1))
    size = 0.75 * spacing * torch.exp(0.55 * torch.randn(count, generator=rng))
    stretch = torch.exp(0.45 * torch.randn(count, generator=rng))
    hair = ((direction[:, 2] > 0.2) | (direction[:, 1] < -0.5)) & (torch.rand(count, generator=rng) < 0.4)
    stretch = torch.where(hair, 4 * stretch, stretch)
    scales = torch.stack([size * stretch.sqrt(), size / stretch.sqrt(), 0.2 * size], dim=1)

    # The third axis along the normal, the first turned at random about it; lengths of quaternions are arbitrary.
    tilt = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], torch.zeros(count)], dim=1)
    half_turn = math.pi * torch.rand(count, generator=rng)
    spin = torch.stack([half_turn.cos(), *[torch.zeros(count)] * 2, half_turn.sin()], dim=1)
    quats = (left_products(tilt) @ spin[:, :, None])[:, :, 0] * (0.5 + torch.rand(count, 1, generator=rng))

    opacities = torch.sigmoid(0.4 + 1.8 * torch.randn(count, generator=rng))
    colors = torch.rand(count, channels, generator=rng)
    distance = 1.0
    focal = 0.62 * height * distance / (2 * float(half_axes[1]))
    K = torch.tensor([[focal, 0, 0.5 * width + 1.3], [0, focal, 0.5 * height - 2.1], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    background = torch.linspace(0.2, 0.9, channels)
    return SplatScene(means, quats, scales, opacities, colors, viewmat, K, width, height, background)


def cloud(
    count: int,
    width: int,
    height: int,
    *,
    channels: int = 3,
    seed: int = 0,
    size: float = 0.03,
    opacity: float = 0.0,
) -> SplatScene:
    """Splats of all shapes about the frustum of a camera with its principal point off centre.

    Some lie behind the camera and some far outside the image. ``size`` is the median scale in metres, ``opacity`` the
    median opacity as a logit.
    """
    rng = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=rng) * torch.tensor([0.5, 0.6, 0.9]) + torch.tensor(
        [0.0, 0.0, 1.6]
    )
    scales = size * torch.exp(torch.randn(count, 3, generator=rng))
    quats = torch.randn(count, 4, generator=rng)
    opacities = torch.sigmoid(opacity + 2 * torch.randn(count, generator=rng))
    colors = torch.randn(count, channels, generator=rng)
    # A slightly rotated and moved camera; its rotation is exact to float64 for any requested dtype.
    skew = 0.2 * torch.randn(3, 3, generator=rng, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(skew - skew.T)
    viewmat[:3, 3] = 0.1 * torch.randn(3, generator=rng, dtype=torch.float64)
    focal = 1.1 * max(width, height)
    K = torch.tensor([[focal, 0, 0.31 * width], [0, 0.9 * focal, 0.72 * height], [0, 0, 1]])
    background = torch.rand(channels, generator=rng)
    return SplatScene(means, quats, scales, opacities, colors, viewmat.float(), K, width, height, background)


DIFFERENTIABLE = (
    *("means", "quats", "scales", "opacities", "colors", "viewmat", "K"),
    *("background", "means2d_offset"),
)


class DrawnScene(NamedTuple):
    """A rendering and the gradients of all inputs, by name."""

    rendering: Rendering
    gradients: dict[str, Tensor]


def render_with_gradients(
    scene: SplatScene, dtype: torch.dtype, *, weights: Tensor | None = None, seed: int = 0, **options: Any
) -> DrawnScene:
    """Render in ``dtype`` and differentiate a random linear function of image and alpha.

    ``weights`` (H, W) scale it per pixel.
    """
    zeros = torch.zeros(len(scene.means), 2)
    values = {**scene._asdict(), "means2d_offset": zeros}
    leaves = {name: values[name].detach().to(dtype).clone().requires_grad_() for name in DIFFERENTIABLE}
    result = rasterize(**leaves, width=scene.width, height=scene.height, **options)
    rng = torch.Generator().manual_seed(seed)
    on_image = torch.randn(result.image.shape, generator=rng).to(dtype)
    on_alpha = torch.randn(result.alpha.shape, generator=rng).to(dtype)
    if weights is not None:
        on_image, on_alpha = on_image * weights[..., None], on_alpha * weights
    gradients = torch.autograd.grad((result.image, result.alpha), list(leaves.values()), (on_image, on_alpha))
    detached = replace(result, image=result.image.detach(), alpha=result.alpha.detach())
    return DrawnScene(detached, dict(zip(leaves, gradients, strict=True)))


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Norm of the difference over the norm of the truth; the difference alone where the truth is zero."""
    difference, norm = float((value.double() - truth.double()).norm()), float(truth.double().norm())
    return difference / norm if norm else difference


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
