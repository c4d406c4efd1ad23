"""What every training of splats on the images of a clip has in common, whatever places and colours them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ...bench.contracts import Budget, Camera, Clip, FrameKey, Progress
from ..splats import rasterize
from ..splats.request import Rendering
from .binding import WorldSplats
from .config import DensifiedTraining
from .training.densify import Densifier
from .training.images import TrainingImages
from .training.loop import Outcome, train
from .training.optimiser import Optimiser
from .training.sampling import Sampler
from .training.schedule import DensifySchedule, Timeline, log_linear
from .views import View, view_of

Initial = Mapping[str, tuple[Tensor, float]]
"""Initial tensors with their learning rates, by name."""


class SplatTrainer:
    """A `Trainable` but for its loss: images, cameras, optimiser, density and learning rates.

    A derived class calls `_start` at the end of its initialiser and `_render` in its ``loss``.
    """

    def __init__(
        self, clip: Clip, settings: DensifiedTraining, sampler: Sampler, device: str, *, mattes: bool = False
    ):
        self._settings = settings
        self.keys: Sequence[FrameKey] = clip.splits["train"]
        self._images = TrainingImages(clip, self.keys, sampler, device, mattes=mattes)
        self.cameras = {key.camera: clip.cameras[key.camera] for key in self.keys}
        self._views = {name: view_of(camera, device) for name, camera in self.cameras.items()}
        self._background = torch.as_tensor(np.asarray(clip.background), dtype=torch.float32, device=device)

    def _start(
        self,
        splats: Initial,
        shared: Initial,
        binding: Tensor,
        face_count: int,
        extent: float,
        seed: int,
        **density: Any,
    ) -> None:
        """Take over initial tensors.

        Parameters
        ----------
        splats, shared : per-splat tensors, "means" among them, and all others.
        binding, face_count, extent, seed, density : as those of `Densifier`.
        """
        initial = {**splats, **shared}
        self.splat_names, self.extent = tuple(splats), extent
        self._optimiser = Optimiser(
            {name: nn.Parameter(value) for name, (value, _) in initial.items()},
            {name: rate for name, (_, rate) in initial.items()},
        )
        self._rates = {name: rate for name, (_, rate) in initial.items() if name != "means"}
        self._densifier = Densifier(
            self._settings, self._optimiser, self.splat_names, binding, face_count, extent, seed, **density
        )

    @property
    def optimiser(self) -> Optimiser:
        """Adam over everything trained."""
        return self._optimiser

    @property
    def binding(self) -> Tensor:
        """(N,) int64, what each splat is bound to."""
        return self._densifier.binding

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""
        self._timeline = timeline
        white = bool((self._background == 1).all())
        self._schedule = DensifySchedule.of(self._settings, timeline, white=white)

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of one image."""
        raise NotImplementedError

    def after_backward(self, iteration: int) -> None:
        """Densification and resets of this iteration, and the learning rates."""
        settings, schedule = self._settings, self._schedule
        offset, visible, camera, face_sizes = self._seen
        if schedule.gathers(iteration) and offset.grad is not None:
            self._densifier.observe(offset.grad, visible, camera.width, camera.height)
            if schedule.is_round(iteration):
                self._densifier.run(iteration, schedule, face_sizes)
        if schedule.is_reset(iteration):
            self._densifier.reset_opacity()
        rate = log_linear(
            settings.position_lr, settings.position_lr_final, self._position_progress(iteration)
        )
        self._optimiser.set_learning_rate("means", rate * self.extent)
        if settings.final_rate < 1:
            decay = log_linear(1.0, settings.final_rate, max(0.0, 2 * self._timeline.fraction(iteration) - 1))
            for name, initial in self._rates.items():
                self._optimiser.set_learning_rate(name, decay * initial)

    def state(self) -> dict[str, Any]:
        """Parameters, moments, binding and densification statistics."""
        return {"optimiser": self._optimiser.state(), "densifier": self._densifier.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` gave."""
        self._optimiser.load_state(state["optimiser"])
        self._densifier.load_state(state["densifier"])

    def note(self) -> str:
        """Number of splats."""
        return f"{len(self.binding)} splats"

    def close(self) -> None:
        """Stop background work."""
        self._images.close()

    def _position_progress(self, iteration: int) -> float:
        """How far the learning rate of positions is on its way to the final one; above 1 it stays there."""
        return self._timeline.fraction(iteration)

    def _render(
        self, world: WorldSplats, opacities: Tensor, colors: Tensor, view: View, face_sizes: Tensor
    ) -> tuple[Rendering, Tensor]:
        """Rasterise and remember what densification needs; also (N,) which splats are seen.

        Parameters
        ----------
        face_sizes : (F,) metres per unit of the local scales, by triangle.
        """
        offset = opacities.new_zeros(len(opacities), 2).requires_grad_()
        rendering = rasterize(
            *(world.means, world.quats, world.scales, opacities, colors),
            *(view.world_to_camera, view.K, view.camera.width, view.camera.height),
            background=self._background,
            means2d_offset=offset,
            check_values=False,
        )
        visible = rendering.radii > 0  # whatever their opacity, as published
        self._seen: tuple[Tensor, Tensor, Camera, Tensor] = (offset, visible, view.camera, face_sizes)
        return rendering, visible


def run_trainer(
    trainer: SplatTrainer,
    settings: DensifiedTraining,
    sampler: Sampler,
    *,
    budget: Budget,
    folder: Path,
    run: str,
    device: str,
    progress: Progress,
) -> Outcome:
    """Train to the end of the budget and stop the background work; arguments as those of `training.loop.train`."""
    try:
        return train(
            trainer,
            sampler,
            published_length=settings.schedule_length,
            budget=budget,
            folder=folder,
            run=run,
            device=device,
            progress=progress,
            checkpoint_every_s=settings.checkpoint_every_s,
        )
    finally:
        trainer.close()
