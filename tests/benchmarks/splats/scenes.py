"""Synthetic splats that load the renderer as a trained head avatar does."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ....methods.splats.rasterize import rasterize
from ....methods.splats.request import Rendering


class Scene(NamedTuple):
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


def head_shell(count: int, width: int, height: int, *, channels: int = 3, seed: int = 0) -> Scene:
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
    quats = _multiply(tilt, spin) * (0.5 + torch.rand(count, 1, generator=rng))

    opacities = torch.sigmoid(0.4 + 1.8 * torch.randn(count, generator=rng))
    colors = torch.rand(count, channels, generator=rng)
    distance = 1.0
    focal = 0.62 * height * distance / (2 * float(half_axes[1]))
    K = torch.tensor([[focal, 0, 0.5 * width + 1.3], [0, focal, 0.5 * height - 2.1], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    background = torch.linspace(0.2, 0.9, channels)
    return Scene(means, quats, scales, opacities, colors, viewmat, K, width, height, background)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions (N, 4), wxyz."""
    aw, ax, ay, az = a.unbind(1)
    bw, bx, by, bz = b.unbind(1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=1,
    )


def cloud(
    count: int,
    width: int,
    height: int,
    *,
    channels: int = 3,
    seed: int = 0,
    size: float = 0.03,
    opacity: float = 0.0,
) -> Scene:
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
    # A camera a little turned and moved; its rotation is exact to float64, whatever the dtype asked for.
    skew = 0.2 * torch.randn(3, 3, generator=rng, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(skew - skew.T)
    viewmat[:3, 3] = 0.1 * torch.randn(3, generator=rng, dtype=torch.float64)
    focal = 1.1 * max(width, height)
    K = torch.tensor([[focal, 0, 0.31 * width], [0, 0.9 * focal, 0.72 * height], [0, 0, 1]])
    background = torch.rand(channels, generator=rng)
    return Scene(means, quats, scales, opacities, colors, viewmat.float(), K, width, height, background)


DIFFERENTIABLE = (
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmat",
    "K",
    "background",
    "means2d_offset",
    "means2d_abs",
)


class Outcome(NamedTuple):
    """A rendering and the gradients of all inputs, by name."""

    rendering: Rendering
    gradients: dict[str, Tensor]


def render_with_gradients(
    scene: Scene, dtype: torch.dtype, *, weights: Tensor | None = None, seed: int = 0, **options: Any
) -> Outcome:
    """Render in ``dtype`` and differentiate a random linear function of image and alpha.

    ``weights`` (H, W) scale it per pixel.
    """
    zeros = torch.zeros(*scene.viewmat.shape[:-2], len(scene.means), 2)
    values = {**scene._asdict(), "means2d_offset": zeros, "means2d_abs": zeros}
    leaves = {name: values[name].detach().to(dtype).clone().requires_grad_() for name in DIFFERENTIABLE}
    result = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"],
        leaves["opacities"],
        leaves["colors"],
        leaves["viewmat"],
        leaves["K"],
        scene.width,
        scene.height,
        background=leaves["background"],
        means2d_offset=leaves["means2d_offset"],
        means2d_abs=leaves["means2d_abs"],
        **options,
    )
    rng = torch.Generator().manual_seed(seed)
    on_image = torch.randn(result.image.shape, generator=rng).to(dtype)
    on_alpha = torch.randn(result.alpha.shape, generator=rng).to(dtype)
    if weights is not None:
        on_image, on_alpha = on_image * weights[..., None], on_alpha * weights
    gradients = torch.autograd.grad((result.image, result.alpha), list(leaves.values()), (on_image, on_alpha))
    detached = replace(result, image=result.image.detach(), alpha=result.alpha.detach())
    return Outcome(detached, dict(zip(leaves, gradients, strict=True)))


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Norm of the difference over the norm of the truth; the difference alone where the truth is zero."""
    difference, norm = float((value.double() - truth.double()).norm()), float(truth.double().norm())
    return difference / norm if norm else difference


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


PIXEL_ERROR = 1e-5
"""A pixel within this of the truth in every channel counts as equal to it."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of one backend against float64, all pixels and all splats counted."""

    image_mean: float
    """Mean absolute error of the image."""
    image_max: float
    pixels_equal: float
    """Share of pixels within `PIXEL_ERROR`."""
    gradients: dict[str, float]
    """Norm of the error over the norm of the truth, by input."""


def float64_truth(scene: Scene) -> Outcome:
    """Draw and differentiate with the reference in float64: about 25 s and 1.7 GB for 60 000 splats at 550x802."""
    return render_with_gradients(scene, torch.float64, backend="reference")


def compare_with(truth: Outcome, scene: Scene, backend: str) -> Accuracy:
    """Measure a backend in float32 on one thread against the `float64_truth` of the same scene."""
    result = render_with_gradients(scene, torch.float32, backend=backend, threads=1)
    error = (result.rendering.image.double() - truth.rendering.image).abs()
    return Accuracy(
        image_mean=float(error.mean()),
        image_max=float(error.max()),
        pixels_equal=float((error.amax(-1) <= PIXEL_ERROR).double().mean()),
        gradients={
            name: relative_error(result.gradients[name], gradient)
            for name, gradient in truth.gradients.items()
        },
    )
