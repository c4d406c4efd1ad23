"""The two passes over a scene, as a training step calls the renderer: from leaves to their gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from ....methods.splats.rasterize import rasterize
from ....methods.splats.request import Rendering
from .scenes import Scene


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread, so that its own work counts to the thread that is timed."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
