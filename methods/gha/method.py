"""Gaussian Head Avatar: Gaussians moved and coloured by networks, drawn as features, brought to full size.

Xu et al., "Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians", CVPR 2024.

Two phases. A mesh head (signed distance in a tetrahedral grid, controllers for motion and colour) gives neutral points
with features; Gaussians start there, keep the controllers, and get a super-resolution network. The budget is parted
between them as published.

What is our own: the tracked head model stands for the published face model (`driving`), the mesh is drawn with discs
(`mesh_head.vertex_discs`), 1 - SSIM stands for LPIPS (`GHAConfig.structure_weight`), pixels that nothing is drawn near
are background. Short presets scale with the capture (`presets`), without resizing it, and let the head model teach the
deformation (`tracked_motion`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from ...bench.contracts import Budget, Clip, Progress
from ..shared.avatar_files import TRACKED, RefinedTracking, Subject, finish_fit, is_finished, run_digest
from ..shared.loop import Outcome, check_budget, check_training_split, train
from ..shared.schedule import ShuffledEpochs
from .avatar import AVATAR_FILE, DRIVING_FILE, GHAAvatar, write_avatar
from .config import GHAConfig
from .driving import TrainingScene, training_scene
from .gaussian_head import GaussianHead
from .gaussian_training import GaussianTraining
from .mesh_head import MeshHead
from .mesh_training import mesh_phase, remove_mesh_phase


class GHA:
    """The method: see the module.

    Parameters
    ----------
    clock : seconds, from any start; what budgets in seconds are measured by.
    """

    name, version = "gha", "3"

    def __init__(self, config: GHAConfig | None = None, clock: Callable[[], float] = time.monotonic):
        self.config, self._clock = config or GHAConfig(), clock

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> GHAAvatar:
        """Train on the training split and write the avatar under ``out``; continues a killed run."""
        check_budget(budget)
        check_training_split(clip)
        config = self.config
        run = run_digest(self.name, self.version, config, clip, budget, seed)
        if is_finished(out, run):
            return self.load(out, device=device)
        scene = training_scene(clip, config, device, seed)
        size = len(scene.signals[0].expression)
        mesh_head, head = MeshHead.of(config, size), GaussianHead.of(config, size)
        first, second = parted(budget, config.mesh_fraction)
        before = _PhaseProgress(progress, 0, second.iterations or 0)
        mesh = mesh_phase(scene, mesh_head, first, out, run, before, self._clock)
        sampler = ShuffledEpochs(len(scene.keys), seed)
        began = self._clock()
        training = GaussianTraining(scene, head, mesh_head, mesh.tensors, sampler)
        try:
            outcome = train(
                training,
                sampler,
                published_length=round(config.schedule_length * (1 - config.mesh_fraction)),
                budget=within(second, budget, mesh.seconds),
                folder=out,
                run=run,
                device=device,
                progress=_PhaseProgress(progress, mesh.iterations, 0),
                checkpoint_every_s=config.checkpoint_every_s,
                clock=self._clock,
                began=began,
            )
        finally:
            training.close()
        tensors = training.tensors()
        write_avatar(out / AVATAR_FILE, config, {**tensors, **scene.frame()})
        corrected(scene, training.optimiser["corrections"].detach()).save(out / DRIVING_FILE)
        whole = Outcome(
            mesh.iterations + outcome.iterations,
            mesh.iterations + outcome.planned,
            mesh.seconds + outcome.seconds,
        )
        counts = {"splats": len(tensors["points"]), "mesh_iterations": mesh.iterations}
        finish_fit(out, run, whole, Subject.of(clip), clip.head, **counts)
        remove_mesh_phase(out)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> GHAAvatar:
        """Read an avatar that `fit` wrote."""
        return GHAAvatar.read(path, device)


class _PhaseProgress:
    """Progress of one phase within that of the whole."""

    def __init__(self, progress: Progress, before: int, after: int):
        self._progress, self._before, self._after = progress, before, after

    def __call__(self, done: int, total: int, note: str = "") -> None:
        self._progress(self._before + done, self._before + total + self._after, note)


def parted(budget: Budget, fraction: float) -> tuple[Budget, Budget]:
    """The budgets of the mesh phase and the Gaussian phase, of one iteration at least."""
    first, second = {}, {}
    if budget.iterations is not None:
        first["iterations"] = max(1, round(fraction * budget.iterations))
        second["iterations"] = max(1, budget.iterations - first["iterations"])
    seconds = budget.seconds
    if seconds is None:
        return Budget(**first), Budget(**second)
    return Budget(**first, seconds=fraction * seconds), Budget(**second, seconds=(1 - fraction) * seconds)


def within(part: Budget, whole: Budget, spent: float) -> Budget:
    """The budget of a part, cut to what the ``spent`` seconds leave of the whole; a millisecond if they leave none."""
    if part.seconds is None or whole.seconds is None:
        return part
    return replace(part, seconds=min(part.seconds, max(whole.seconds - spent, 1e-3)))


def corrected(scene: TrainingScene, corrections: Tensor) -> RefinedTracking:
    """The tracking of the training timesteps with (T, 6) learnt corrections of rotation and translation."""
    before = {name: scene.tracked[name].cpu().numpy() for name in TRACKED}
    turn, shift = corrections.cpu().split(3, dim=1)
    after = dict(before)
    after["rotation"] = (scene.tracked["rotation"].cpu() + turn).numpy()
    after["translation"] = (scene.tracked["translation"].cpu() + shift).numpy()
    return RefinedTracking(scene.clip.subject, np.array(scene.timesteps), before, after)
