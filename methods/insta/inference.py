"""Rays without gradients, by the kernel. `rendering.render_rays` is the definition."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import kernel
from .field import Field, Parameters
from .marching import Space
from .rendering import Marching, Scene, render_rays


class Seen(NamedTuple):
    """What rays see, as float32 numpy arrays."""

    color: np.ndarray  # (R, 3) not yet composited on anything
    transmittance: np.ndarray  # (R,)
    samples: int


class Inference:
    """A trained field in a space, ready to be looked at.

    Parameters
    ----------
    mouth : (F,) bool, as in `render_rays`.
    backend : "reference" is `render_rays`; "auto" takes the kernel for parameters in float32 on the CPU. An instruction
        set of the kernel's ``instruction_sets()`` stands for the kernel in that one.
    """

    def __init__(
        self,
        field: Field,
        parameters: Parameters,
        space: Space,
        mouth: Tensor,
        marching: Marching,
        backend: str = "auto",
    ):
        self.field, self.parameters, self.space = field, parameters, space
        self.mouth, self.marching = mouth, marching
        self._isa = "" if backend == "auto" else backend
        table = parameters["table"]
        module = None if backend == "reference" else kernel.load()
        fits = module is not None and table.device.type == "cpu" and table.dtype == torch.float32
        self._trained: Any = self._prepared(module) if fits else None

    @torch.no_grad()
    def render(self, scene: Scene) -> Seen:
        """What the rays of one pose see."""
        module = scene.surface.surface.module
        if self._trained is None or module is None:
            rendered = render_rays(
                self.field, self.parameters, [scene], self.space, self.mouth, self.marching
            )
            return Seen(rendered.color.cpu().numpy(), rendered.transmittance.cpu().numpy(), rendered.samples)
        rays = scene.rays
        color = np.empty((len(rays.origins), 3), np.float32)
        transmittance = np.empty(len(color), np.float32)
        samples = module.render(
            *(scene.surface.guide(self.space), self._trained, self._starts(scene.condition)),
            *(self.mouth.numpy().view(np.uint8), rays.origins, rays.directions, rays.jitter),
            *(self.marching.step, self.marching.round_samples, self.marching.stop_transmittance),
            *(color, transmittance, self._isa, scene.surface.surface.threads()),
        )
        return Seen(color, transmittance, samples)

    def _prepared(self, module: Any) -> Any:
        architecture, box, prior = self.field.architecture, self.field.box, self.field.prior
        arrays = {
            name: np.ascontiguousarray(value.detach().numpy()) for name, value in self.parameters.items()
        }
        networks = [
            [arrays[f"{name}_{number}"] for number in range(len(shapes))]
            for name, shapes in (
                ("density", architecture.density_shapes),
                ("color", architecture.color_shapes),
            )
        ]
        levels = [tuple(level) for level in architecture.levels]
        low = box.low.numpy().astype(np.float32)
        return module.Trained(levels, arrays["table"], low, box.side, *prior, *networks)

    def _starts(self, condition: Tensor) -> np.ndarray:
        """(2, units) that the conditions add to the first layer: outside the mouth, where all are one, and at it."""
        weight = self.parameters["density_0"].detach().numpy()
        width = self.field.architecture.conditions
        conditions = np.stack([np.ones(width, np.float32), condition[:width].numpy().astype(np.float32)])
        by_conditions = weight[:, weight.shape[1] - width :]
        return np.ascontiguousarray(conditions @ by_conditions.T)
