"""GaussianBlendshapes: a head as linear blendshapes of splats, skinned like FLAME.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024, arXiv 2404.19398.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...bench.contracts import Budget, Clip, Progress
from ..shared.avatar_files import Subject, finish_fit, is_finished, run_digest
from ..shared.loop import check_budget, check_training_split
from ..shared.schedule import ShuffledEpochs
from ..shared.splat_training import run_trainer
from .avatar import AVATAR_FILE, GBSAvatar, write_avatar
from .config import GBSConfig
from .points import SurfacePoints, padded_offset, with_mouth
from .training import GBSTraining


class GBS:
    """The method: see the module."""

    name, version = "gbs", "3"

    def __init__(self, config: GBSConfig | None = None):
        self.config = config or GBSConfig()

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> GBSAvatar:
        """Train on the training split and write the avatar under ``out``; continues a killed run."""
        check_budget(budget)
        check_training_split(clip)
        run = run_digest(self.name, self.version, self.config, clip, budget, seed)
        if is_finished(out, run):
            return self.load(out, device=device)
        head = with_mouth(clip.head, self.config.departures)
        offset = padded_offset(np.asarray(clip.static_offset, np.float32), len(head.template))
        subject = Subject(clip.subject, head.version, np.asarray(clip.shape, np.float32), offset)
        sampler = ShuffledEpochs(len(clip.splits["train"]), seed)
        training = GBSTraining(clip, self.config, subject, head, sampler, device, seed)
        outcome = run_trainer(
            training,
            self.config.splats,
            sampler,
            budget=budget,
            folder=out,
            run=run,
            device=device,
            progress=progress,
        )
        self._write(out / AVATAR_FILE, training)
        counts = {"splats": len(training.binding), "differences": len(training.entries.owners)}
        finish_fit(out, run, outcome, subject, head, **counts, teeth="teeth" in head.regions)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> GBSAvatar:
        """Read an avatar that `fit` wrote."""
        return GBSAvatar.read(path, device)

    def _write(self, path: Path, training: GBSTraining) -> None:
        binding = training.binding.cpu().numpy()
        points = SurfacePoints(*(values[binding] for values in training.points))
        neutral = {name: training.optimiser[name].detach() for name in training.splat_names}
        differences = training.merged_differences()
        write_avatar(path, neutral, points, training.rig.expressions, training.entries, differences)
