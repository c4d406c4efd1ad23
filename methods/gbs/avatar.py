"""The trained avatar of GaussianBlendshapes: its rendering."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ...bench.contracts import Camera, Frame, HeadPose, no_stage
from ..shared.avatar_files import HEAD_FILE, SUBJECT_FILE, Subject, read_shared_head, read_subject
from ..shared.networks import sh_degree
from ..shared.rendering import Drawn, PosedSplats, draw_splats, posed_splats, read_back, view_of
from ..shared.subject_mesh import pose_key
from .blend import Placed, place
from .rig import Carried, Rig
from .storage import AVATAR_FILE, Stored, read_avatar


class GBSAvatar:
    """A trained head: neutral splats, differences for expressions, and the joints that carry them.

    Files: ``avatar.safetensors`` and ``subject.npz`` count as storage; beside them lies the shared head model, with
    teeth. What the mesh says of the splats is computed from these when loaded.

    Attributes
    ----------
    stored : what the avatar's file holds.
    """

    def __init__(self, folder: Path, rig: Rig, stored: Stored, device: str):
        self._folder, self._rig, self.stored, self._device = folder, rig, stored, device
        self._degree = sh_degree(stored.neutral["sh_rest"])
        self._last: tuple[bytes, Placed] | None = None

    @classmethod
    def read(cls, folder: Path, device: str) -> GBSAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        head = read_shared_head(folder)
        subject: Subject = read_subject(folder / SUBJECT_FILE, head)
        stored = read_avatar(folder / AVATAR_FILE, len(head.faces), head.expression_basis.shape[2], device)
        rig = Rig(head, subject.shape, subject.static_offset, stored.points, stored.expressions, device)
        return cls(folder, rig, stored, device)

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model."""
        return self.read_back(self.draw(camera, pose, background))

    @torch.no_grad()
    def draw(
        self,
        camera: Camera,
        pose: HeadPose,
        background: Sequence[float],
        done: Callable[[str], None] = no_stage,
    ) -> Drawn:
        """Draw one frame, stage by stage; see `StagedAvatar`."""
        placed, view = self._placed(pose, done), view_of(camera, self._device)
        colors = placed.colors(view.center, self._degree)
        done("deform")
        return draw_splats(placed.world, placed.opacities, colors, view, background, done)

    def read_back(self, drawn: Drawn) -> Frame:
        """A drawn frame in host memory."""
        return read_back(drawn)

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world; with colours where a camera says from where they are seen."""
        placed = self._placed(pose)
        colors = None
        if camera is not None:
            colors = placed.colors(view_of(camera, self._device).center, self._degree)
        return posed_splats(placed.world, placed.opacities, colors)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[Tensor, Tensor, Tensor]:
        """(N, 3) and (N, 3, K - 1) harmonics in a pose, along the splats' axes, and the (N, 3, 3) turn of these."""
        placed = self._placed(pose)
        return placed.sh_dc.cpu(), placed.sh_rest.cpu(), placed.rotation.cpu()

    def files(self) -> Sequence[Path]:
        """The splats and the subject."""
        return [self._folder / AVATAR_FILE, self._folder / SUBJECT_FILE]

    def shared_files(self) -> Sequence[Path]:
        """The head model, with teeth."""
        return [self._folder / HEAD_FILE]

    def _placed(self, pose: HeadPose, done: Callable[[str], None] = no_stage) -> Placed:
        """Splats of a pose; the last pose's are kept, since frames of several cameras follow one another."""
        arguments, key = self._rig.arguments([pose]), pose_key(pose)
        if self._last is not None and self._last[0] == key:
            done("drive")
            return self._last[1]
        carried = Carried.of(self._rig.carry(arguments))
        done("drive")
        stored = self.stored
        differences = stored.entries.sum(stored.differences, self._rig.coefficients(arguments))
        placed = place(stored.neutral, differences, carried)
        self._last = key, placed
        return placed
