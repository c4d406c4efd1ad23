"""The trained avatar of GaussianBlendshapes: its rendering."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from ...bench.contracts import FloatArray, HeadPose, no_stage
from ..avatars.compact.layouts import blended, read_coded
from ..avatars.harmonics import turn_harmonics
from ..ops.harmonics import sh_degree
from ..shared.avatar_files import AVATAR_FILE, Subject, read_stored
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar
from .blendshapes import PointMotions, PosedAttributes, Rig, apply_pose
from .storage import Stored, stored_of


class GBSAvatar(StoredSplatAvatar):
    """A trained head: neutral splats, differences for expressions, and the joints that move them.

    Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage. The folder also
    has the shared head model with teeth. Values derived from the mesh are computed when the avatar is loaded.
    """

    def __init__(self, files: Sequence[Path], subject: Subject, rig: Rig, stored: Stored, device: str):
        super().__init__(files, self._placed, device)
        self._rig, self.subject, self.stored = rig, subject, stored
        self._last = LastPose(self._posed)

    @classmethod
    def read(cls, folder: Path, device: str) -> GBSAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or incompatible files."""
        content_of, coded = partial(stored_of, device=device), partial(read_coded, layout=blended)
        files, head, subject, stored = read_stored(folder, AVATAR_FILE, content_of, coded)
        rig = Rig(head, subject.shape, subject.static_offset, stored.points, stored.expressions, device)
        return cls(files, subject, rig, stored, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the splats' axes, which turn with the surface."""
        posed = self._last(pose, no_stage)
        return turn_harmonics(posed.sh_dc, posed.sh_rest, posed.rotation)

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PosedAttributes:
        arguments, stored = self._rig.arguments([pose]), self.stored
        motions = PointMotions.of(self._rig.motions(arguments))
        end_stage("drive")
        differences = stored.entries.sum(stored.differences, self._rig.coefficients(arguments))
        return apply_pose(stored.neutral, differences, motions)

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        posed = self._last(pose, end_stage)
        degree = sh_degree(self.stored.neutral["sh_rest"])
        return PlacedSplats(posed.world, posed.opacities, lambda center: posed.colors(center, degree))
