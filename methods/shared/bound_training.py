"""Training of splats bound to a mesh, shared by the methods that differ in colour, opacity and tracking."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ...bench.contracts import Budget, Clip, Progress
from .binding import Frames, WorldSplats
from .config import SplatTraining
from .splat_trainer import SplatTrainer, run_trainer
from .training.loop import Outcome
from .training.losses import photometric_loss, position_penalty, scale_penalty
from .training.optimiser import Optimiser
from .training.sampling import Sampler
from .training.schedule import Timeline
from .views import View, scene_extent

GEOMETRY = ("means", "log_scales", "quats", "opacities")


class Placed(NamedTuple):
    """Splats as one camera sees them at one timestep."""

    world: WorldSplats
    colors: Tensor  # (N, 3) >= 0
    opacities: Tensor  # (N,) in (0, 1)
    penalty: Tensor | None  # scalar added to the loss


class Appearance(Protocol):
    """The part of a mesh-bound method that is its own: tracking, colour and opacity.

    Per-splat tensors live in the optimiser (`splat_parameters`), everything else too (`parameters`).
    """

    def splat_parameters(self, count: int) -> dict[str, tuple[Tensor, float]]:
        """Initial per-splat tensors besides the geometry, with learning rates; name -> ((N, ...), rate)."""

    def parameters(self) -> dict[str, tuple[Tensor, float]]:
        """Initial tensors that all splats share, with learning rates."""

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""

    def frames(self, timestep: int, optimiser: Optimiser) -> Frames:
        """Triangle frames of a training timestep."""

    def place(
        self,
        frames: Frames,
        binding: Tensor,
        view: View,
        timestep: int,
        optimiser: Optimiser,
        iteration: int,
    ) -> Placed:
        """Splats in the world with their colours and opacities as this camera sees them."""


class Start(NamedTuple):
    """Where training begins: splats of their triangle's size.

    Attributes
    ----------
    binding : (N,) int64, the triangle of each; every triangle once at least.
    means : (N, 3) in the triangles' frames, units of the triangle's size.
    opacities : (N,) in (0, 1).
    """

    binding: Tensor
    means: Tensor
    opacities: Tensor


def one_per_triangle(face_count: int, opacity: float, device: str) -> Start:
    """The published start: a splat at the centroid of each triangle."""
    means = torch.zeros(face_count, 3, device=device)
    opacities = torch.full((face_count,), opacity, device=device)
    return Start(torch.arange(face_count, device=device), means, opacities)


class BoundTraining(SplatTrainer):
    """A `Trainable`: splats on the triangles of a mesh, seen in the training images of a clip.

    ``start`` holds each of the ``face_count`` triangles at least once; None: `one_per_triangle`.
    """

    _settings: SplatTraining

    def __init__(
        self,
        clip: Clip,
        settings: SplatTraining,
        appearance: Appearance,
        sampler: Sampler,
        face_count: int,
        device: str,
        seed: int,
        *,
        start: Start | None = None,
    ):
        super().__init__(clip, settings, sampler, device)
        self._appearance = appearance
        extent = scene_extent(self.cameras)
        start = start or one_per_triangle(face_count, settings.initial_opacity, device)
        splats = {
            **_initial_geometry(start, settings, extent),
            **appearance.splat_parameters(len(start.binding)),
        }
        self._start(splats, appearance.parameters(), start.binding, face_count, extent, seed)

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""
        super().begin(timeline)
        self._appearance.begin(timeline)

    def loss(self, iteration: int, index: int) -> Tensor:
        """Photometric loss of one image and the regularisers of section 3.4 of GaussianAvatars."""
        key, settings, optimiser = self.keys[index], self._settings, self._optimiser
        view = self._views[key.camera]
        truth = self._images.get(iteration, index)
        frames = self._appearance.frames(key.timestep, optimiser)
        placed = self._appearance.place(frames, self.binding, view, key.timestep, optimiser, iteration)
        rendering, visible = self._render(
            placed.world, placed.opacities, placed.colors, view, frames.size.detach()
        )
        means, log_scales = optimiser["means"], optimiser["log_scales"]
        loss = photometric_loss(rendering.image, truth, settings.ssim_weight)
        loss = loss + settings.position_weight * position_penalty(means, visible, settings.position_threshold)
        loss = loss + settings.scale_weight * scale_penalty(log_scales, visible, settings.scale_threshold)
        return loss if placed.penalty is None else loss + placed.penalty


def run_bound_training(
    clip: Clip,
    settings: SplatTraining,
    appearance: Appearance,
    sampler: Sampler,
    face_count: int,
    *,
    start: Start | None = None,
    budget: Budget,
    folder: Path,
    run: str,
    device: str,
    seed: int,
    progress: Progress,
) -> tuple[BoundTraining, Outcome]:
    """Train splats bound to a mesh of ``face_count`` triangles; arguments as those of `training.loop.train`."""
    training = BoundTraining(clip, settings, appearance, sampler, face_count, device, seed, start=start)
    outcome = run_trainer(
        training,
        settings,
        sampler,
        budget=budget,
        folder=folder,
        run=run,
        device=device,
        progress=progress,
    )
    return training, outcome


def _initial_geometry(
    start: Start, settings: SplatTraining, extent: float
) -> dict[str, tuple[Tensor, float]]:
    quats = start.means.new_zeros(len(start.means), 4)
    quats[:, 0] = 1
    return {
        "means": (start.means, settings.position_lr * extent),
        "log_scales": (torch.zeros_like(start.means), settings.scale_lr),
        "quats": (quats, settings.rotation_lr),
        "opacities": (torch.logit(start.opacities), settings.opacity_lr),
    }
