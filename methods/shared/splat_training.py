"""Training of splats on the images of a clip, for any placement and colour model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey
from ..ops.photometric import photometric_loss
from ..ops.splats import TriangleFrames, WorldSplats, splat_penalties, unturned
from ..splats.request import Rendering
from .config import DensifiedTraining, SplatSettings, SplatTraining
from .loop import COST_GROWTH, Fit, TrainingImages, TrainingSummary, train
from .optimisation import Densifier, Optimiser, OptimiserState, logit
from .rendering import View, rasterize_view, scene_center, scene_extent, view_of
from .schedule import DensifySchedule, Sampler, Timeline, log_linear

Initial = Mapping[str, tuple[Tensor, float]]
"""Initial tensors and learning rates by name."""


class ImageTrainer(OptimiserState):
    """A `Trainable` except for its loss. A derived class calls `_optimise` in its initialiser.

    - ``masks``: whether images have a fourth channel, the foreground coverage, if the clip has masks.
    - ``keys``, ``cameras``: the training frames, in the order of the sampler's indices, and their cameras by name.
    """

    cost_growth: float = 1.0
    """Cost of a late step relative to an early one, to convert a time budget into iterations."""

    def __init__(
        self, clip: Clip, settings: SplatSettings, sampler: Sampler, device: str, *, masks: bool = False
    ):
        self._settings, self._sampler, self._device = settings, sampler, device
        self.keys: Sequence[FrameKey] = clip.splits["train"]
        self._masked = masks and clip.mask(self.keys[0]) is not None
        self._images = TrainingImages(clip, self.keys, sampler, device, masks=self._masked)
        self.cameras = {key.camera: clip.cameras[key.camera] for key in self.keys}
        self._views = {name: view_of(camera, device) for name, camera in self.cameras.items()}
        self._background = torch.tensor(np.asarray(clip.background), dtype=torch.float32, device=device)

    def _optimise(self, initial: Initial, epsilons: Mapping[str, float] = {}) -> None:
        """Set the initial tensors, on the device of the training; ``epsilons`` as for `Optimiser`."""
        self.optimiser = Optimiser(
            {name: nn.Parameter(value.to(self._device)) for name, (value, _) in initial.items()},
            {name: rate for name, (_, rate) in initial.items()},
            epsilons=epsilons,
        )
        self._rates = {name: rate for name, (_, rate) in initial.items()}

    def tensors(self) -> dict[str, Tensor]:
        """The current tensors by name."""
        return {name: self.optimiser[name] for name in self._rates}

    def _decay_rates(self, iteration: int, apart: Collection[str] = ()) -> None:
        """Set learning rates: the initial ones, falling to ``final_rate`` of them, log-linear over the last half of the run.

        Those of the tensors in ``apart`` are not changed.
        """
        final = self._settings.final_rate
        if final == 1:
            return
        decay = self._timeline.decay(iteration, final)
        for name, rate in self._rates.items():
            if name not in apart:
                self.optimiser.set_learning_rate(name, decay * rate)

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""
        self._timeline = timeline

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of one image."""
        raise NotImplementedError

    def after_backward(self, iteration: int) -> None:
        """Set the learning rates; called between gradients and step."""
        self._decay_rates(iteration)

    def note(self) -> str:
        """Short description of the state of training."""
        return ""

    def run(self, fit: Fit) -> TrainingSummary:
        """Train to the end of the budget; see `train`."""
        try:
            return train(
                *(self, self._sampler, fit),
                published_length=self._settings.schedule_length,
                checkpoint_every_s=self._settings.checkpoint_every_s,
                cost_growth=self.cost_growth,
            )
        finally:
            self.close()

    def close(self) -> None:
        """Stop background work."""
        self._images.close()


def initial_shapes(sizes: FloatArray, settings: SplatSettings) -> dict[str, tuple[Tensor, float]]:
    """Round splats of (N,) sizes in metres at the start: logarithms of sizes, rotations, logits of opacities, with their rates."""
    log_scales = torch.from_numpy(np.log(sizes)).float()[:, None].repeat(1, 3)
    opacities = torch.full((len(sizes),), logit(settings.initial_opacity))
    return {
        "log_scales": (log_scales, settings.scale_lr),
        "quats": (unturned(len(sizes)), settings.rotation_lr),
        "opacities": (opacities, settings.opacity_lr),
    }


class SplatTrainer(ImageTrainer):
    """A `Trainable` except for its loss: images, optimiser, density and learning rates of splats.

    A derived class calls `_start` at the end of its initialiser and `_render` in its ``loss``.
    """

    cost_growth = COST_GROWTH
    _settings: DensifiedTraining

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
        """Set the initial tensors.

        - ``splats``, ``shared``: per-splat tensors, including "means", and all others.
        - ``binding``, ``face_count``, ``extent``, ``seed``, ``density``: as for `Densifier`.
        """
        initial = {**splats, **shared}
        self.splat_names, self.extent = tuple(splats), extent
        self._optimise(initial)
        self._densifier = Densifier(
            self._settings, self.optimiser, self.splat_names, binding, face_count, extent, seed, **density
        )

    @property
    def binding(self) -> Tensor:
        """(N,) int64 index to which each splat is bound."""
        return self._densifier.binding

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""
        super().begin(timeline)
        white = bool((self._background == 1).all())
        self._schedule = DensifySchedule.of(self._settings, timeline, white=white)

    def after_backward(self, iteration: int) -> None:
        """Apply densification and resets of this iteration, and the learning rates."""
        settings, schedule = self._settings, self._schedule
        offset, visible, camera, face_sizes = self._seen
        if schedule.gathers(iteration) and offset.grad is not None:
            self._densifier.observe(offset.grad, visible, camera.width, camera.height)
            if schedule.is_round(iteration):
                self._densifier.run(iteration, schedule, face_sizes)
        if schedule.is_reset(iteration):
            self._densifier.reset_opacity()
        progress = self._position_progress(iteration)
        rate = log_linear(settings.position_lr, settings.position_lr_final, progress)
        self.optimiser.set_learning_rate("means", rate * self.extent)
        self._decay_rates(iteration, apart=("means",))

    def state(self) -> dict[str, Any]:
        """Parameters, moments, binding and densification statistics."""
        return {**super().state(), "densifier": self._densifier.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        super().load_state(state)
        self._densifier.load_state(state["densifier"])

    def note(self) -> str:
        """Number of splats."""
        return f"{len(self.binding)} splats"

    def _position_progress(self, iteration: int) -> float:
        """Progress of the learning-rate schedule of positions; above 1 the final rate is kept."""
        return self._timeline.fraction(iteration)

    def _render(
        self, world: WorldSplats, opacities: Tensor, colors: Tensor, view: View, face_sizes: Tensor
    ) -> tuple[Rendering, Tensor]:
        """Rasterize and store data for densification; also returns (N,) whether a splat is visible.

        ``face_sizes``: (F,) metres per unit of the local scales, by triangle.
        """
        offset = opacities.new_zeros(len(opacities), 2).requires_grad_()
        rendering = rasterize_view(world, opacities, colors, view, self._background, means2d_offset=offset)
        visible = rendering.radii > 0  # of any opacity, as published
        self._seen: tuple[Tensor, Tensor, Camera, Tensor] = (offset, visible, view.camera, face_sizes)
        return rendering, visible


class ShadedSplats(NamedTuple):
    """Splats at one timestep seen from one camera."""

    world: WorldSplats
    colors: Tensor  # (N, 3) >= 0
    opacities: Tensor  # (N,) in (0, 1)
    penalty: Tensor | None  # scalar added to the loss


class Appearance(Protocol):
    """Method-specific part of a mesh-bound method: tracking, colour and opacity.

    All tensors are in the optimiser: per-splat tensors (`splat_parameters`) and others (`parameters`).
    """

    def splat_parameters(self, count: int) -> dict[str, tuple[Tensor, float]]:
        """Initial per-splat tensors besides the geometry, with learning rates; name -> ((N, ...), rate)."""

    def parameters(self) -> dict[str, tuple[Tensor, float]]:
        """Initial tensors that all splats share, with learning rates."""

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""

    def frames(self, timestep: int, optimiser: Optimiser) -> TriangleFrames:
        """Triangle frames of a training timestep."""

    def place(
        self,
        frames: TriangleFrames,
        binding: Tensor,
        view: View,
        timestep: int,
        optimiser: Optimiser,
        iteration: int,
    ) -> ShadedSplats:
        """Splats in the world with their colours and opacities for this camera."""


class Start(NamedTuple):
    """Initial splats with the size of their triangle."""

    binding: Tensor
    """(N,) int64, the triangle of each splat; every triangle occurs at least once."""
    means: Tensor
    """(N, 3) in the triangles' frames, units of the triangle's size."""
    opacities: Tensor
    """(N,) in (0, 1)."""


def one_per_triangle(face_count: int, opacity: float, device: str) -> Start:
    """The published start: a splat at the centroid of each triangle."""
    means = torch.zeros(face_count, 3, device=device)
    opacities = torch.full((face_count,), opacity, device=device)
    return Start(torch.arange(face_count, device=device), means, opacities)


class BoundTraining(SplatTrainer):
    """A `Trainable`: splats on the triangles of a mesh, trained on the images of a clip.

    ``start`` contains each of the ``face_count`` triangles at least once; None uses `one_per_triangle`.
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
        extent = scene_extent(self.cameras, scene_center(clip.poses[key.timestep] for key in self.keys))
        start = start or one_per_triangle(face_count, settings.initial_opacity, device)
        splats = {
            "means": (start.means, settings.position_lr * extent),
            "log_scales": (torch.zeros_like(start.means), settings.scale_lr),
            "quats": (unturned(len(start.means)).to(start.means), settings.rotation_lr),
            "opacities": (torch.logit(start.opacities), settings.opacity_lr),
            **appearance.splat_parameters(len(start.binding)),
        }
        self._start(splats, appearance.parameters(), start.binding, face_count, extent, seed)

    def begin(self, timeline: Timeline) -> None:
        """Fit schedules to the length of the run."""
        super().begin(timeline)
        self._appearance.begin(timeline)

    def loss(self, iteration: int, index: int) -> Tensor:
        """Photometric loss of one image and the penalties of section 3.4 of GaussianAvatars."""
        key, settings, optimiser = self.keys[index], self._settings, self.optimiser
        view = self._views[key.camera]
        truth = self._images.get(iteration, index)
        frames = self._appearance.frames(key.timestep, optimiser)
        placed = self._appearance.place(frames, self.binding, view, key.timestep, optimiser, iteration)
        rendering, visible = self._render(
            placed.world, placed.opacities, placed.colors, view, frames.size.detach()
        )
        means, log_scales = optimiser["means"], optimiser["log_scales"]
        loss = photometric_loss(rendering.image, truth, settings.ssim_weight)
        thresholds = settings.position_threshold, settings.scale_threshold
        weights = settings.position_weight, settings.scale_weight
        loss = loss + splat_penalties(means, log_scales, visible, thresholds, weights)
        return loss if placed.penalty is None else loss + placed.penalty
