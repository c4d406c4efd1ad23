"""INSTA: Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023, arXiv 2211.12499."""

from __future__ import annotations

from dataclasses import asdict

from ...bench.errors import InputError
from ...bench.io.files import write_json
from ..shared.avatar_files import Subject, finish_fit
from ..shared.loop import Fit, train
from ..shared.method import TrainedMethod
from ..shared.schedule import ShuffledEpochs
from ..shared.subject_mesh import SubjectMesh
from .avatar import FIELD_FILE, SETTINGS_FILE, InstaAvatar, write_field
from .config import InstaConfig
from .marching import canonical_surface
from .spec import INSTA as SPEC
from .training import InstaTraining


class Insta(TrainedMethod[InstaConfig, InstaAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = InstaConfig, InstaAvatar
    draws_splats = False

    def _use(self, device: str) -> None:
        """Raise `InputError` for any device but the CPU; docs/explanation/methods/insta.md says why."""
        if not SPEC.computes_on(device):
            remedy = "Train and render it with device=cpu."
            raise InputError(f"method {self.name}", "device", " or ".join(SPEC.devices), repr(device), remedy)

    def _train(self, fit: Fit, config: InstaConfig) -> None:
        clip, subject = fit.clip, Subject.of(fit.clip)
        mesh = SubjectMesh(clip.head, subject.shape, subject.static_offset, "cpu")
        surface = canonical_surface(clip.head, mesh, config)
        training = InstaTraining(clip, mesh, surface, config, fit.device, fit.seed)
        outcome = train(
            training,
            ShuffledEpochs(len(training.keys), fit.seed),
            fit,
            published_length=config.schedule_length,
            checkpoint_every_s=config.checkpoint_every_s,
        )
        write_field(fit.out / FIELD_FILE, training.parameters(), training.space.occupied)
        write_json(fit.out / SETTINGS_FILE, asdict(config))
        occupied = int(training.space.occupied.sum())
        finish_fit(fit, outcome, subject, clip.head, occupied_cells=occupied)
