"""FlashAvatar: splats on a tracked mesh, changed by a network of the tracked parameters.

Xiang et al., "FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding", CVPR 2024, arXiv 2312.02214.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadPose
from ..avatars.compact.offsets import read_offsets
from ..avatars.harmonics import turn_harmonics
from ..shared.avatar_files import AVATAR_FILE, Subject, finish_fit, read_stored
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.networks import tracked_inputs
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar
from ..shared.subject_mesh import SubjectMesh
from .config import FlashAvatarConfig
from .model import (
    INPUTS,
    HeadSurface,
    TrainedSplats,
    changed,
    colors_seen,
    layer_of_points,
    network_outputs,
    positional_encoding,
    read_avatar,
    write_avatar,
)
from .spec import FLASHAVATAR as SPEC
from .training import FlashAvatarTraining


class FlashAvatarAvatar(StoredSplatAvatar):
    """A trained head. Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage.

    The folder also has the shared head model.
    """

    def __init__(
        self, files: Sequence[Path], mesh: SubjectMesh, subject: Subject, trained: TrainedSplats, device: str
    ):
        super().__init__(files, LastPose(self._posed), device)
        self.mesh, self.subject, self.trained = mesh, subject, trained
        self._surface = HeadSurface(mesh, trained.points)
        encoded = positional_encoding(self._surface.rest, trained.config.frequencies)
        self._of_points = layer_of_points(trained.tensors, encoded)
        self._opacities = trained.tensors["opacities"].sigmoid()

    @classmethod
    def read(cls, folder: Path, device: str) -> FlashAvatarAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        readers = partial(read_avatar, device=device), partial(read_offsets, device=device)
        files, head, subject, trained = read_stored(folder, AVATAR_FILE, *readers)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        return cls(files, mesh, subject, trained, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the axes of the head."""
        rotation = self._surface.posed(self.mesh.arguments([pose])).rotation
        return turn_harmonics(self.trained.tensors["sh_dc"], self.trained.tensors["sh_rest"], rotation)

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        tensors, config = self.trained.tensors, self.trained.config
        arguments = self.mesh.arguments([pose])
        frames = self._surface.posed(arguments)
        end_stage("drive")
        outputs = network_outputs(tensors, self._of_points, tracked_inputs(arguments, INPUTS)[0], config)
        world = self._surface.place(frames, changed(tensors, outputs, config))

        def colors(center: Tensor) -> Tensor:
            return colors_seen(tensors, world, frames, center, config.sh_degree)

        return PlacedSplats(world, self._opacities, colors)


class FlashAvatar(TrainedMethod[FlashAvatarConfig, FlashAvatarAvatar]):
    """The method: see the module."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = FlashAvatarConfig, FlashAvatarAvatar

    def _train(self, fit: Fit, config: FlashAvatarConfig) -> None:
        clip = fit.clip
        training = FlashAvatarTraining(clip, config, fit.device, fit.seed)
        outcome = training.run(fit)
        trained = training.result()
        write_avatar(fit.out / AVATAR_FILE, trained)
        finish_fit(fit, outcome, Subject.of(clip), clip.head, splats=len(trained.points.triangles))
