"""Gaussian Head Avatar: Gaussians moved and coloured by networks, drawn as features, enlarged by super-resolution.

Xu et al., "Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians", CVPR 2024.

There are two phases. A mesh head (signed distance in a tetrahedral grid, networks for motion and colour) gives neutral
points with features. Gaussians start from these, keep the networks, and get a super-resolution network. The budget is
divided between the phases as published.

Differences from the paper: the tracked head model replaces the published face model (`driving`), the mesh is drawn
with discs (`mesh_head.vertex_discs`), 1 - SSIM replaces LPIPS (`GHAConfig.structure_weight`), and pixels far from
drawn ones are background. Short presets scale with the capture (`presets`), without resizing it, and fit the
deformation to the head model's (`tracked_motion`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from ...bench.contracts import Budget, Progress
from ..shared.avatar_files import AVATAR_FILE, TRACKED, RefinedTracking, Subject, finish_fit
from ..shared.loop import Fit, TrainingSummary, train
from ..shared.method import TrainedMethod
from ..shared.schedule import ShuffledEpochs
from ..shared.threads import torch_on_one_thread
from ..splats.cpu import instruction_sets
from .avatar import DRIVING_FILE, GHAAvatar, write_avatar
from .config import GHAConfig
from .driving import TrainingScene, training_scene
from .gaussian_head import GaussianHead
from .gaussian_training import GaussianTraining
from .mesh_head import MeshHead
from .mesh_training import mesh_phase, remove_mesh_phase
from .spec import GHA as SPEC


class GHA(TrainedMethod[GHAConfig, GHAAvatar]):
    """See the module docstring.

    ``clock``: clock in seconds with any origin, for budgets in seconds.
    """

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GHAConfig, GHAAvatar

    def __init__(self, config: GHAConfig | None = None, clock: Callable[[], float] = time.monotonic):
        super().__init__(config)
        self._clock = clock

    def _train(self, fit: Fit, config: GHAConfig) -> None:
        with torch_on_one_thread(bool(instruction_sets())):
            self._train_phases(fit, config)

    def _train_phases(self, fit: Fit, config: GHAConfig) -> None:
        clip, out = fit.clip, fit.out
        scene = training_scene(clip, config, fit.device, fit.seed)
        size = len(scene.signals[0].expression)
        mesh_head, head = MeshHead.of(config, size), GaussianHead.of(config, size)
        first, second = parted(fit.budget, config.mesh_fraction)
        progress = _phase_progress(fit.progress, 0, second.iterations or 0)
        mesh = mesh_phase(scene, mesh_head, replace(fit, budget=first, progress=progress))
        sampler = ShuffledEpochs(len(scene.keys), fit.seed)
        began = fit.clock()
        training = GaussianTraining(scene, head, mesh_head, mesh.tensors, sampler)
        budget = within(second, fit.budget, mesh.seconds)
        progress = _phase_progress(fit.progress, mesh.iterations, 0)
        try:
            summary = train(
                training,
                sampler,
                replace(fit, began=began, budget=budget, progress=progress),
                published_length=round(config.schedule_length * (1 - config.mesh_fraction)),
                checkpoint_every_s=config.checkpoint_every_s,
            )
        finally:
            training.close()
        tensors = training.tensors()
        write_avatar(out / AVATAR_FILE, config, {**tensors, **scene.frame()})
        corrected(scene, training.optimiser["corrections"].detach()).save(out / DRIVING_FILE)
        whole = TrainingSummary(
            mesh.iterations + summary.iterations,
            mesh.iterations + summary.planned,
            mesh.seconds + summary.seconds,
            [(mesh.iterations + at, value) for at, value in summary.losses],
        )
        counts = {"splats": len(tensors["points"]), "mesh_iterations": mesh.iterations}
        finish_fit(fit, whole, Subject.of(clip), clip.head, **counts)

    def _remove_training_files(self, out: Path) -> None:
        super()._remove_training_files(out)
        remove_mesh_phase(out)


def _phase_progress(progress: Progress, before: int, after: int) -> Progress:
    """Progress of one phase as part of the total progress."""

    def report(done: int, total: int, note: str = "") -> None:
        progress(before + done, before + total + after, note)

    return report


def parted(budget: Budget, fraction: float) -> tuple[Budget, Budget]:
    """The budgets of the mesh phase and the Gaussian phase, at least one iteration each."""
    first, second = {}, {}
    if budget.iterations is not None:
        first["iterations"] = max(1, round(fraction * budget.iterations))
        second["iterations"] = max(1, budget.iterations - first["iterations"])
    seconds = budget.seconds
    if seconds is None:
        return Budget(**first), Budget(**second)
    return Budget(**first, seconds=fraction * seconds), Budget(**second, seconds=(1 - fraction) * seconds)


def within(part: Budget, whole: Budget, spent: float) -> Budget:
    """The budget of a phase, limited to the remaining seconds of the total after ``spent``; at least a millisecond."""
    if part.seconds is None or whole.seconds is None:
        return part
    return replace(part, seconds=min(part.seconds, max(whole.seconds - spent, 1e-3)))


def corrected(scene: TrainingScene, corrections: Tensor) -> RefinedTracking:
    """The tracking of the training timesteps with (T, 6) learned corrections of rotation and translation."""
    before = {name: scene.tracked[name].cpu().numpy() for name in TRACKED}
    turn, shift = corrections.cpu().split(3, dim=1)
    after = dict(before)
    after["rotation"] = (scene.tracked["rotation"].cpu() + turn).numpy()
    after["translation"] = (scene.tracked["translation"].cpu() + shift).numpy()
    return RefinedTracking(scene.clip.subject, np.array(scene.timesteps), before, after)
