"""Compact tensorial Gaussian avatars: static colour from planes, dynamic opacity from feature lines.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations", CVPR 2025,
arXiv 2504.14967. What the paper does not change is as in GaussianAvatars (`bound_training`).
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ...bench.contracts import Budget, Clip, Progress
from ...datasets.head.arrays import faces_in_region
from ...datasets.steps.clusters import cluster_expressions
from ...datasets.steps.jaw_bases import leaks
from ..compact.file import COMPACT_FILE, write_compact
from ..compact.precision import Precision
from ..compact.simplify import simplify, training_poses
from ..shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    is_finished,
    run_digest,
    save_shared_head,
    write_record,
    write_subject,
)
from ..shared.loop import CHECKPOINT, check_budget, check_training_split
from ..shared.schedule import Sampler, ShuffledEpochs, Weighted, balanced_weights
from ..shared.splat_training import BoundTraining, run_bound_training
from ..shared.subject_mesh import SubjectMesh
from .appearance import OursAppearance, shell_start
from .avatar import OursAvatar
from .capacity import plan_capacity
from .config import OursConfig
from .storage import FIELD_FILE, write_field

log = logging.getLogger(__name__)


class Ours:
    """The method: see the module."""

    name, version = "ours", "2"

    def __init__(self, config: OursConfig | None = None):
        self.config = config or OursConfig()

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> OursAvatar:
        """Train on the training split and write the avatar under ``out``; continues a killed run."""
        check_budget(budget)
        check_training_split(clip)
        config = self.config
        if config.sampling.balanced or (
            config.lines.enabled and (config.penalty.weight or config.lines.bounds == "face")
        ):
            faces_in_region(
                clip.head, "face"
            )  # raises before the long work where the head has no face region
        subject = Subject.of(clip)
        mesh = SubjectMesh(clip.head, subject.shape, subject.static_offset, device)
        plan = None
        if config.capacity.mode == "auto":
            plan = plan_capacity(clip, mesh, config)
            config = plan.apply(config)
        # The sizes, and not the measurements behind them, whose last digits depend on the number of threads.
        planned = self.config if plan is None else (self.config, config)
        run = run_digest(self.name, self.version, planned, clip, budget, seed)
        if is_finished(out, run):
            return self.load(out, device=device)
        if plan is not None:
            log.info("%s", "; ".join(plan.lines_of_text()))
            progress(0, budget.iterations or 1, plan.lines_of_text()[0])
        within = None if plan is None else plan.box(device)
        appearance = OursAppearance(mesh, clip, config, device, seed, lines_within=within)
        training, outcome = run_bound_training(
            clip,
            config.splats,
            appearance,
            self._sampler(clip, seed),
            len(mesh.faces),
            start=shell_start(mesh, clip, config, device),
            budget=budget,
            folder=out,
            run=run,
            device=device,
            seed=seed,
            progress=progress,
        )
        self._write(out, training, appearance)
        write_subject(out / SUBJECT_FILE, subject)
        save_shared_head(out, clip.head)
        if config.storage == "compact":
            self._write_compact(out, clip, device)
        write_record(
            out,
            run,
            outcome,
            splats=len(training.binding),
            jaw_bases=len(appearance.jaw_bases),
            leaks=leaks(config.lines.jaw_bases_variant) if len(appearance.jaw_bases) else (),
            capacity=None if plan is None else plan.record(),
        )
        (out / CHECKPOINT).unlink(missing_ok=True)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> OursAvatar:
        """Read an avatar that `fit` wrote."""
        return OursAvatar.read(path, device)

    def _sampler(self, clip: Clip, seed: int) -> Sampler:
        keys = clip.splits["train"]
        if not self.config.sampling.balanced:
            return ShuffledEpochs(len(keys), seed)
        clusters = cluster_expressions(
            clip,
            self.config.sampling.expression_clusters,
            seed=seed,
            variant=self.config.sampling.clusters_variant,
        )
        timesteps = np.array([key.timestep for key in keys])
        return Weighted(balanced_weights(timesteps, clusters.by_timestep), seed)

    def _write_compact(self, out: Path, clip: Clip, device: str) -> None:
        exact, precision = OursAvatar.read(out, device, exact=True), Precision()
        field = simplify(exact, training_poses(clip), precision)
        write_compact(out / COMPACT_FILE, field, exact.subject, clip.head, precision)

    def _write(self, out: Path, training: BoundTraining, appearance: OursAppearance) -> None:
        optimiser = training.optimiser
        write_field(
            out / FIELD_FILE,
            {name: optimiser[name] for name in training.splat_names},
            training.binding,
            {name: optimiser[name] for name in appearance.parameters()},
            appearance.plane_box,
            appearance.line_box,
            appearance.jaw_bases,
            self.config.lines.dynamic,
        )
