"""The trained avatar of GaussianBlendshapes: its rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ...bench.contracts import Changes, FloatArray, HeadPose, no_stage
from ..avatars.compact.layouts import blended, read_coded
from ..avatars.harmonics import turn_harmonics
from ..ops.harmonics import C0, sh_degree
from ..shared.avatar_files import AVATAR_FILE, Subject, read_stored
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar, changes_of
from .blendshapes import PointMotions, PosedAttributes, Rig, apply_pose, difference_widths
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

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the learnt differences."""
        widths = difference_widths(0)
        columns = self._differences(self._rig.arguments([pose]))[:, : sum(widths.values())]
        learnt = dict(zip(widths, columns.split([*widths.values()], dim=1)))
        opacity = torch.sigmoid(self.stored.neutral["opacities"] + learnt["opacities"][:, 0])
        return changes_of(
            {"position": 1000 * learnt["means"], "opacity": opacity, "color": C0 * learnt["sh_dc"]}
        )

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PosedAttributes:
        arguments = self._rig.arguments([pose])
        motions = PointMotions.of(self._rig.motions(arguments))
        end_stage("drive")
        return apply_pose(self.stored.neutral, self._differences(arguments), motions)

    def _differences(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(N, C) learnt differences of a pose."""
        return self.stored.entries.sum(self.stored.differences, self._rig.coefficients(arguments))

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        posed = self._last(pose, end_stage)
        degree = sh_degree(self.stored.neutral["sh_rest"])
        return PlacedSplats(posed.world, posed.opacities, lambda center: posed.colors(center, degree))
