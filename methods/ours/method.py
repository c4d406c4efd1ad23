"""Compact tensorial Gaussian avatars: static colour from planes, dynamic opacity from feature lines.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations", CVPR 2025,
arXiv 2504.14967. Everything else is as in GaussianAvatars (`shared.splat_training`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...bench.contracts import Clip
from ...datasets.head.arrays import faces_in_region
from ...datasets.steps.clusters import cluster_expressions, leaks
from ..shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    clip_mesh,
    finish_fit,
    save_shared_head,
    write_subject,
)
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.schedule import Sampler, ShuffledEpochs, Weighted, balanced_weights
from ..shared.splat_training import BoundTraining
from .appearance import OursAppearance, outer_layers_start
from .avatar import OursAvatar
from .capacity import OursPlan, plan_capacity
from .config import OursConfig
from .spec import OURS, OURS_PLUS
from .storage import FIELD_FILE, write_field


class Ours(TrainedMethod[OursConfig, OursAvatar]):
    """See the module docstring."""

    name, version = OURS.name, OURS.version
    config_class, avatar_class = OursConfig, OursAvatar
    _plan: OursPlan | None = None

    def _resolved(self, clip: Clip, device: str) -> tuple[OursConfig, Any]:
        config, lines = self.config, self.config.lines
        if config.sampling.balanced or (lines.enabled and (config.penalty.weight or lines.bounds == "face")):
            faces_in_region(clip.head, "face")  # raises before long work if the region is missing
        return super()._resolved(clip, device)

    def _planned(self, clip: Clip, config: OursConfig, device: str) -> OursPlan:
        return plan_capacity(clip, clip_mesh(clip, device), config)

    def _train(self, fit: Fit, config: OursConfig) -> None:
        clip, out, device, plan = fit.clip, fit.out, fit.device, self._plan
        mesh = clip_mesh(clip, device)
        within = None if plan is None else plan.box(device)
        appearance = OursAppearance(mesh, clip, config, device, fit.seed, lines_within=within)
        sampler, start = self._sampler(clip, fit.seed), outer_layers_start(mesh, clip, config, device)
        count = len(mesh.faces)
        training = BoundTraining(
            clip, config.splats, appearance, sampler, count, device, fit.seed, start=start
        )
        outcome = training.run(fit)
        optimiser = training.optimiser
        write_field(
            out / FIELD_FILE,
            {name: optimiser[name] for name in training.splat_names},
            training.binding,
            appearance.stored(optimiser),
            *(appearance.plane_box, appearance.line_box, appearance.jaw_bases, config.lines.dynamic),
        )
        subject = Subject.of(clip)
        write_subject(out / SUBJECT_FILE, subject)
        save_shared_head(out, clip.head)
        finish_fit(
            fit,
            outcome,
            subject,
            clip.head,
            splats=len(training.binding),
            jaw_bases=len(appearance.jaw_bases),
            leaks=leaks(config.lines.jaw_bases_variant) if len(appearance.jaw_bases) else (),
        )

    def _sampler(self, clip: Clip, seed: int) -> Sampler:
        keys, sampling = clip.splits["train"], self.config.sampling
        if not sampling.balanced:
            return ShuffledEpochs(len(keys), seed)
        count, variant = sampling.expression_clusters, sampling.clusters_variant
        clusters = cluster_expressions(clip, count, seed=seed, variant=variant)
        timesteps = np.array([key.timestep for key in keys])
        return Weighted(balanced_weights(timesteps, clusters.by_timestep), seed)


class OursPlus(Ours):
    """The method with the additions of `spec.ADDITIONS`, which its presets have."""

    name, version = OURS_PLUS.name, OURS_PLUS.version
