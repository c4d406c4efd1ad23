"""The trained avatar of "ours": its rendering."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..bench.contracts import Camera, Frame, HeadPose
from .avatar_files import SUBJECT_FILE, read_shared_head, read_subject
from .binding import WorldSplats, to_world
from .bound_avatar import PosedSplats, posed_splats, render_splats
from .bound_training import view_of
from .dynamics import LocalSplats, apply_offsets, changed_colors
from .feature_lines import blend_lines, line_offsets, line_position
from .ours_appearance import driving_coefficients
from .ours_field import (
    Box,
    CanonicalFrames,
    canonical_directions,
    plane_features,
    position_part,
    shade_directions,
)
from .ours_storage import FIELD_FILE, SPLAT_WIDTHS, Field, read_field
from .sh import sh_degree, sh_to_rgb
from .subject_mesh import SubjectMesh


class OursAvatar:
    """A trained head: splats without colour, planes, lines and two small networks.

    What depends on canonical position alone (plane features, places on the lines) is computed once when loaded.
    """

    def __init__(self, folder: Path, mesh: SubjectMesh, field: Field, device: str):
        tensors = field.tensors
        self._folder, self._mesh, self._tensors, self._device = folder, mesh, tensors, device
        self._dynamic = field.dynamic
        table = tensors["splats"].split(list(SPLAT_WIDTHS.values()), dim=1)
        columns = {name: column.contiguous() for name, column in zip(SPLAT_WIDTHS, table)}
        self._neutral = LocalSplats(
            columns["means"], columns["log_scales"], columns["quats"], columns["opacities"][:, 0]
        )
        self._binding = columns["binding"][:, 0].to(torch.int64)
        self._canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        positions = self._canonical.positions(self._binding, self._neutral.means)
        if "sh_dc" not in tensors:
            features = plane_features(tensors, Box(*tensors["plane_box"]), positions)
            self._from_position = position_part(tensors, features)
        self._jaw_bases = tensors["jaw_bases"].cpu().numpy().astype(np.float64)
        if "lines" in tensors:
            box = Box(*tensors["line_box"])
            self._inside = box.contains(positions).nonzero().squeeze(1)
            unit = box.unit(positions.index_select(0, self._inside))
            self._line_position = line_position(unit, tensors["lines"].shape[2])

    @classmethod
    def read(cls, folder: Path, device: str) -> OursAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        head = read_shared_head(folder)
        subject = read_subject(folder / SUBJECT_FILE, head)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        field = read_field(folder / FIELD_FILE, len(mesh.faces), mesh.model.expression_size, device)
        return cls(folder, mesh, field, device)

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model."""
        splats, world, turns = self._world(pose)
        view = view_of(camera, self._device)
        colors = self._colors(splats, world, turns, view.center)
        return render_splats(world, torch.sigmoid(splats.logits), colors, view, background)

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world; with colours where a camera says from where they are seen."""
        splats, world, turns = self._world(pose)
        colors = None
        if camera is not None:
            colors = self._colors(splats, world, turns, view_of(camera, self._device).center)
        return posed_splats(world, torch.sigmoid(splats.logits), colors)

    def files(self) -> Sequence[Path]:
        """The field with its splats, and the subject."""
        return [self._folder / FIELD_FILE, self._folder / SUBJECT_FILE]

    def _world(self, pose: HeadPose) -> tuple[LocalSplats, WorldSplats, Tensor]:
        frames = self._mesh.frames(self._mesh.posed(self._mesh.arguments([pose])))
        splats = self._changed(pose)
        world = to_world(frames, self._binding, splats.means, splats.log_scales, splats.quats)
        return splats, world, self._canonical.turns(frames)

    def _colors(self, splats: LocalSplats, world: WorldSplats, turns: Tensor, center: Tensor) -> Tensor:
        directions = canonical_directions(turns, self._binding, world.means, center)
        if "sh_dc" in self._tensors:
            dc, rest = self._tensors["sh_dc"], self._tensors["sh_rest"]
            colors = sh_to_rgb(dc, rest, -directions, sh_degree(rest))
        else:
            colors = shade_directions(self._tensors, self._from_position, directions)
        return changed_colors(colors, splats)

    def _changed(self, pose: HeadPose) -> LocalSplats:
        if "lines" not in self._tensors:
            return self._neutral
        lines = self._tensors["lines"]
        expressions = len(lines) - len(self._jaw_bases)
        blended = blend_lines(lines, *driving_coefficients(pose, expressions, self._jaw_bases, self._device))
        inside = line_offsets(self._tensors, blended, self._line_position)
        offsets = inside.new_zeros(len(self._binding), inside.shape[1]).index_copy(0, self._inside, inside)
        return apply_offsets(self._neutral, offsets, self._dynamic)
