"""The trained avatar of "ours": its rendering."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, HeadPose, no_stage
from ..compact.file import COMPACT_FILE, read_compact
from ..shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head, read_subject
from ..shared.avatar_kernel import HarmonicColors, WorldTransform
from ..shared.binding import NORMAL, WorldSplats
from ..shared.rendering import (
    USUAL,
    Cutoffs,
    Drawn,
    PosedSplats,
    StoredSplatAvatar,
    draw_splats,
    posed_splats,
    view_of,
)
from ..shared.subject_mesh import KnownPoses, SubjectMesh, pose_key
from .appearance import driving_coefficients
from .field import (
    Bounds,
    CanonicalFrames,
    LocalSplats,
    apply_offsets,
    changed_colors,
    plane_features,
    position_part,
)
from .inference import DrivenPose, LineOffsets, PlaneColors, WorldPose
from .storage import FIELD_FILE, SPLAT_WIDTHS, Field, read_field


class SeenFrom(NamedTuple):
    """Colours of one pose's splats as a function of where they are seen from."""

    normals: Tensor
    """(N, 3) unit vectors out of the surface, in the world."""
    radiance: Callable[[Tensor], Tensor]
    """Maps a unit vector (3,) from the splats to the camera, in the world, to colours (N, 3) >= 0."""


class OursAvatar(StoredSplatAvatar):
    """A trained head: splats without colour, planes, lines and two small networks.

    What depends on canonical position alone (plane features, places on the lines) is computed once when loaded.
    A folder holds the exact file, the compact one or both, in which case the compact one is read unless the other is
    asked for.

    Attributes
    ----------
    subject, field : whom it shows, and what its file holds.
    mesh : the subject's.
    neutral : the splats before an expression changes them.
    line_offsets : what the lines give; None where there are none.
    colors : what the planes, or spherical harmonics, give.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        mesh: SubjectMesh,
        subject: Subject,
        field: Field,
        device: str,
        cutoffs: Cutoffs = USUAL,
    ):
        tensors = field.tensors
        self.subject, self.field = subject, field
        self._stored, self.mesh, self._device, self._cutoffs = stored, mesh, device, cutoffs
        table = tensors["splats"].split(list(SPLAT_WIDTHS.values()), dim=1)
        columns = {name: column.contiguous() for name, column in zip(SPLAT_WIDTHS, table)}
        self.neutral = LocalSplats(
            columns["means"], columns["log_scales"], columns["quats"], columns["opacities"][:, 0]
        )
        self._binding = columns["binding"][:, 0].to(torch.int64)
        self._canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        positions = self._canonical.positions(self._binding, self.neutral.means)
        self._to_world = WorldTransform(self._binding, self.neutral.log_scales, self.neutral.quats)
        self.colors: PlaneColors | HarmonicColors
        self.line_offsets: LineOffsets | None = None
        if "sh_dc" not in tensors:
            features = plane_features(tensors, Bounds(*tensors["plane_box"]), positions)
            weights = tensors["color_weight_0"], tensors["color_weight_1"]
            self.colors = PlaneColors(*weights, position_part(tensors, features))
        else:
            self.colors = HarmonicColors(tensors["sh_dc"], tensors["sh_rest"])
        if "lines" in tensors:
            self.line_offsets = LineOffsets(tensors, positions)
        self._jaw_bases = tensors["jaw_bases"].cpu().numpy().astype(np.float64)
        self._known = KnownPoses(self._posed, 0)
        self._last: tuple[bytes, WorldPose] | None = None

    @classmethod
    def read(cls, folder: Path, device: str, *, exact: bool = False) -> OursAvatar:
        """Read an avatar from its folder; ``exact`` reads the exact file where there is a compact one as well.

        Raises `InputError` for damaged or foreign files.
        """
        head = read_shared_head(folder)
        compact = folder / COMPACT_FILE
        if compact.exists() and not exact:
            faces, expressions = len(head.faces), head.expression_basis.shape[2]
            subject, field = read_compact(compact, head, faces, expressions, device)
            mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
            return cls([compact], mesh, subject, field, device)
        subject = read_subject(folder / SUBJECT_FILE, head)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        field = read_field(folder / FIELD_FILE, len(mesh.faces), mesh.model.expression_size, device)
        return cls([folder / FIELD_FILE, folder / SUBJECT_FILE], mesh, subject, field, device)

    def prepare(self, poses: Iterable[HeadPose], megabytes: float = 512.0) -> int:
        """Compute meshes, triangle frames, jaw weights and offsets of known poses beforehand, within a bound of memory.

        Frames of these poses are then drawn faster, and equal bit for bit. Nothing is prepared unless asked for, so a
        measured frame time includes them. Returns how many poses fitted; what was prepared before is forgotten.
        """
        self._known = KnownPoses(self._posed, int(megabytes * 2**20))
        return self._known.prepare(poses)

    @torch.no_grad()
    def draw(
        self,
        camera: Camera,
        pose: HeadPose,
        background: Sequence[float],
        end_stage: Callable[[str], None] = no_stage,
    ) -> Drawn:
        """Draw one frame, stage by stage; see `StagedAvatar`. The lines' offsets belong to the first."""
        splats, world, turns = self._placed(pose, end_stage)
        view = view_of(camera, self._device)
        colors = self._colors(splats, world, turns, view.center)
        opacities = torch.sigmoid(splats.logits)
        end_stage("deform")
        return draw_splats(world, opacities, colors, view, background, end_stage, self._cutoffs)

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world; with colours where a camera says from where they are seen."""
        splats, world, turns = self._placed(pose)
        colors = None
        if camera is not None:
            colors = self._colors(splats, world, turns, view_of(camera, self._device).center)
        return posed_splats(world, torch.sigmoid(splats.logits), colors)

    @torch.no_grad()
    def seen_from(self, pose: HeadPose) -> SeenFrom:
        """Colours of a pose by world direction."""
        posed = self._known(pose)
        splats = self._changed(posed)

        @torch.no_grad()
        def radiance(direction: Tensor) -> Tensor:
            along = -self._canonical_direction(posed.turns, direction)
            return changed_colors(self.colors.along(along), splats)

        return SeenFrom(posed.frames.rotation[:, :, NORMAL].index_select(0, self._binding), radiance)

    @torch.no_grad()
    def static_logits(self) -> Tensor:
        """(N,) logits of the opacities when all driving coefficients are 0."""
        if self.line_offsets is None:
            return self.neutral.logits
        still = self.neutral.logits.new_zeros
        expressions = len(self.field.tensors["lines"]) - len(self._jaw_bases)
        offsets = self.line_offsets(still(expressions), still(len(self._jaw_bases)))
        return apply_offsets(self.neutral, offsets, self.field.dynamic).logits

    def _posed(self, pose: HeadPose) -> DrivenPose:
        frames = self.mesh.frames(self.mesh.posed(self.mesh.arguments([pose])))
        offsets = None
        if self.line_offsets is not None:
            expressions = len(self.field.tensors["lines"]) - len(self._jaw_bases)
            coefficients = driving_coefficients(pose, expressions, self._jaw_bases, self._device)
            offsets = self.line_offsets(*coefficients)
        return DrivenPose(frames, self._canonical.turns(frames), offsets)

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None] = no_stage) -> WorldPose:
        """Splats of a pose in the world; those of the last pose are kept, as several cameras often look at one."""
        key = pose_key(pose)
        if self._last is None or self._last[0] != key:
            posed = self._known(pose)
            end_stage("drive")
            splats = self._changed(posed)
            world = self._to_world(posed.frames, splats.means, splats.log_scales, splats.quats)
            self._last = key, WorldPose(splats, world, posed.turns)
        return self._last[1]

    def _changed(self, posed: DrivenPose) -> LocalSplats:
        if posed.offsets is None:
            return self.neutral
        return apply_offsets(self.neutral, posed.offsets, self.field.dynamic)

    def _canonical_direction(self, turns: Tensor, direction: Tensor) -> Tensor:
        """(N, 3) canonical directions of one world direction, common to all splats."""
        turned = torch.nn.functional.normalize(turns @ direction.to(turns), dim=1)
        return turned.index_select(0, self._binding)

    def _colors(self, splats: LocalSplats, world: WorldSplats, turns: Tensor, center: Tensor) -> Tensor:
        return changed_colors(self.colors(world.means, center, turns, self._binding), splats)
