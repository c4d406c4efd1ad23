"""Training on the images of a clip: images, cameras, optimiser, learning rates, the run."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from ...bench.contracts import Clip, FrameKey
from .config import SplatSettings
from .loop import Fit, TrainingImages, TrainingSummary, train
from .optimisation import Optimiser, OptimiserState
from .rendering import view_of
from .schedule import Sampler, Timeline

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
