"""GaussianBlendshapes: a head as linear blendshapes of splats, skinned like FLAME.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024, arXiv 2404.19398.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...bench.contracts import Clip
from ..shared.avatar_files import AVATAR_FILE, Subject, clip_mesh, finish_fit
from ..shared.capacity import CapacityPlan, CapacityPlanner
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.schedule import ShuffledEpochs
from .avatar import GBSAvatar
from .config import GBSConfig
from .mouth import padded_offset, with_mouth
from .spec import GBS as SPEC
from .storage import write_avatar
from .training import GBSTraining


class GBS(TrainedMethod[GBSConfig, GBSAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GBSConfig, GBSAvatar

    def _planned(self, clip: Clip, config: GBSConfig, device: str) -> CapacityPlan:
        planner = CapacityPlanner(clip, clip_mesh(clip, device), config.capacity)
        planner.expressions("expressions", config.expressions)
        planner.splats("splats.max_splats", config.splats.max_splats, config.samples)
        return planner.plan()

    def _train(self, fit: Fit, config: GBSConfig) -> None:
        clip, seed = fit.clip, fit.seed
        head = with_mouth(clip.head, config)
        offset = padded_offset(np.asarray(clip.static_offset, np.float32), len(head.template))
        subject = Subject(clip.subject, head.version, np.asarray(clip.shape, np.float32), offset)
        sampler = ShuffledEpochs(len(clip.splits["train"]), seed)
        training = GBSTraining(clip, config, subject, head, sampler, fit.device, seed)
        outcome = training.run(fit)
        self._write(fit.out / AVATAR_FILE, training)
        counts = {"splats": len(training.binding), "differences": len(training.entries.owners)}
        finish_fit(fit, outcome, subject, head, **counts, teeth="teeth" in head.regions)

    def _write(self, path: Path, training: GBSTraining) -> None:
        binding = training.binding.cpu().numpy()
        points = training.points.rows(binding)
        neutral = {name: training.optimiser[name].detach() for name in training.splat_names}
        differences = training.merged_differences()
        write_avatar(path, neutral, points, training.rig.expressions, training.entries, differences)
