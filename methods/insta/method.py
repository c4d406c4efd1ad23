"""INSTA: Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023, arXiv 2211.12499."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import Budget, Clip, Progress
from ..shared.avatar_files import Subject, finish_fit, is_finished, run_digest
from ..shared.loop import check_budget, check_training_split, train
from ..shared.schedule import ShuffledEpochs
from ..shared.subject_mesh import SubjectMesh
from .avatar import FIELD_FILE, SETTINGS_FILE, InstaAvatar, write_field, write_settings
from .config import InstaConfig
from .marching import canonical_surface
from .training import InstaTraining


class Insta:
    """The method: see the module."""

    name, version = "insta", "2"

    def __init__(self, config: InstaConfig | None = None):
        self.config = config or InstaConfig()

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> InstaAvatar:
        """Train on the training split and write the avatar under ``out``; continues a killed run."""
        check_budget(budget)
        check_training_split(clip)
        run = run_digest(self.name, self.version, self.config, clip, budget, seed)
        if is_finished(out, run):
            return self.load(out, device=device)
        subject = Subject.of(clip)
        mesh = SubjectMesh(clip.head, subject.shape, subject.static_offset, "cpu")
        surface = canonical_surface(clip.head, mesh, self.config)
        training = InstaTraining(clip, mesh, surface, self.config, device, seed)
        outcome = train(
            training,
            ShuffledEpochs(len(training.keys), seed),
            published_length=self.config.schedule_length,
            budget=budget,
            folder=out,
            run=run,
            device=device,
            progress=progress,
            checkpoint_every_s=self.config.checkpoint_every_s,
        )
        write_field(out / FIELD_FILE, training.parameters(), training.space.occupied)
        write_settings(out / SETTINGS_FILE, self.config)
        occupied = int(training.space.occupied.sum())
        finish_fit(out, run, outcome, subject, clip.head, occupied_cells=occupied)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> InstaAvatar:
        """Read an avatar that `fit` wrote."""
        return InstaAvatar.read(path, device)
