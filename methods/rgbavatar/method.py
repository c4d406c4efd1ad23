"""RGBAvatar: splats on a tracked mesh with a few learnt blendshapes.

Li et al., "RGBAvatar: Reduced Gaussian Blendshapes for Online Modeling of Head Avatars", CVPR 2025, arXiv 2503.12886.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadPose
from ..avatars.compact.reduced import read_reduced
from ..shared.avatar_files import AVATAR_FILE, Subject, finish_fit, read_stored
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.networks import tracked_inputs
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar
from ..shared.subject_mesh import SubjectMesh
from .config import RGBAvatarConfig
from .model import (
    StoredShapes,
    Surface,
    blend_weights,
    blended,
    read_avatar,
    seen_colors,
    write_avatar,
)
from .spec import RGBAVATAR as SPEC
from .training import RGBAvatarTraining

HARMONICS = 15
"""Coefficients above degree 0 that an export has; they are zero."""


class RGBAvatarAvatar(StoredSplatAvatar):
    """A trained head. Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage.

    The folder also has the shared head model.
    """

    def __init__(
        self, files: Sequence[Path], mesh: SubjectMesh, subject: Subject, stored: StoredShapes, device: str
    ):
        super().__init__(files, LastPose(self._posed), device)
        self.mesh, self.subject, self.stored = mesh, subject, stored
        self._surface = Surface(mesh, stored.points)

    @classmethod
    def read(cls, folder: Path, device: str) -> RGBAvatarAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        readers = partial(read_avatar, device=device), partial(read_reduced, device=device)
        files, head, subject, stored = read_stored(folder, AVATAR_FILE, *readers)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        return cls(files, mesh, subject, stored, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose, equal in all directions; see `HarmonicAvatar`."""
        colors = self._blended(self.mesh.arguments([pose]))["colors"].cpu().numpy()
        return colors, np.zeros((*colors.shape, HARMONICS), np.float32)

    @torch.no_grad()
    def weights(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(T, K) weights of the blendshapes for T poses, given as `SubjectMesh.arguments` gives them."""
        return blend_weights(self.stored.tensors, tracked_inputs(arguments, self.stored.inputs))

    def _blended(self, arguments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        (splats,) = blended(self.stored.tensors, self.weights(arguments))
        return splats

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        arguments = self.mesh.arguments([pose])
        surface = self._surface.posed(arguments)
        end_stage("drive")
        splats = self._blended(arguments)
        world, colors = self._surface.place(surface, splats), seen_colors(splats["colors"])
        return PlacedSplats(world, splats["opacities"].sigmoid(), lambda center: colors)


class RGBAvatar(TrainedMethod[RGBAvatarConfig, RGBAvatarAvatar]):
    """The method: see the module."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = RGBAvatarConfig, RGBAvatarAvatar

    def _train(self, fit: Fit, config: RGBAvatarConfig) -> None:
        clip = fit.clip
        training = RGBAvatarTraining(clip, config, fit.device, fit.seed)
        outcome = training.run(fit)
        stored = training.result()
        write_avatar(fit.out / AVATAR_FILE, stored)
        finish_fit(fit, outcome, Subject.of(clip), clip.head, splats=len(stored.points.triangles))
