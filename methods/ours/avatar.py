"""The trained avatar of "ours": its rendering, with offsets of the feature lines prepared for fast frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadPose
from ...bench.native.dispatch import to_device
from ..avatars.compact.field import field as field_layout
from ..avatars.compact.layouts import read_coded
from ..ops.harmonics import harmonic_shader
from ..ops.mesh import TriangleFrames
from ..ops.planes import (
    AXES,
    ENCODING_SIZE,
    Bounds,
    LinePosition,
    Shader,
    line_position,
    offset_writer,
    shader,
)
from ..ops.splats import activate, to_world
from ..shared.avatar_files import Subject, read_stored
from ..shared.rendering import USUAL, Cutoffs, LastPose, PlacedSplats, StoredSplatAvatar
from ..shared.subject_mesh import SubjectMesh
from .appearance import driving_coefficients
from .field import (
    FIRST_LAYER,
    LAST_LAYER,
    CanonicalFrames,
    LocalSplats,
    apply_offsets,
    blend_lines,
    changed_colors,
    line_table,
    normalised_weight,
    offset_layers,
    plane_features,
    position_part,
)
from .storage import FIELD_FILE, RESIDUAL, StoredField, field_of, splat_columns


class DrivenPose(NamedTuple):
    """What a pose determines, for any camera."""

    frames: TriangleFrames
    turns: Tensor
    """(F, 3, 3) world directions to canonical ones."""
    offsets: Tensor | None
    """(N, D) of the lines; None without lines."""


class LineOffsets:
    """Offsets of the splats inside the lines' box; others have none.

    Parameters
    ----------
    positions : Tensor
        (N, 3) canonical positions.
    """

    def __init__(self, tensors: Mapping[str, Tensor], positions: Tensor):
        self._lines, self._count = tensors["lines"], len(positions)
        self._jaw_bases = len(tensors["jaw_bases"])
        box = Bounds(*tensors["line_box"])
        inside = box.contains(positions).nonzero().squeeze(1)
        unit = box.unit(positions.index_select(0, inside))
        position = line_position(unit, self._lines.shape[2])
        # Neighbours on the lines are stored together because they read the same rows and activate the same units.
        order = _lexicographic(position.rows[:, :AXES], self._lines.shape[2])
        self.inside = inside[order]
        self._first, layers = normalised_weight(tensors, 0), offset_layers(tensors)
        self._outputs = len(layers.bias_2)
        self._write = offset_writer(layers, LinePosition(*(part[order] for part in position)))

    def __call__(self, coefficients: Tensor) -> Tensor:
        """(N, D) offsets of all splats for the (E + J,) coefficients of a frame, jaw weights last."""
        table = self.table(coefficients)
        out = table.new_empty if len(self.inside) == self._count else table.new_zeros
        offsets = out(self._count, self._outputs)
        self._write(offsets, self.inside, table)
        return offsets

    def table(self, coefficients: Tensor) -> Tensor:
        """(3 L, H) first layer without its bias, at the samples of a frame's blended lines."""
        expression, jaw = coefficients.split([len(coefficients) - self._jaw_bases, self._jaw_bases])
        return line_table(blend_lines(self._lines, expression, jaw), self._first)


def _lexicographic(rows: Tensor, resolution: int) -> Tensor:
    """(N,) order of (N, 3) rows by the last column, then the middle one, then the first."""
    x, y, z = rows.unbind(1)
    return torch.argsort((z * AXES * resolution + y) * AXES * resolution + x, stable=True)


class OursAvatar(StoredSplatAvatar):
    """A trained head: splats without colour, planes, lines and two small networks.

    Values that depend only on the canonical position (plane features, positions on the lines) are computed once when
    the avatar is loaded. A folder has the files of a training, or the coded file in place of them.

    Attributes
    ----------
    subject, field : Subject, StoredField
        The subject, and the content of its file.
    neutral : LocalSplats
        The splats before an expression changes them.
    line_offsets : LineOffsets | None
        Offsets given by the lines; None without lines.
    colors : Shader
        View-dependent colour of the planes, or of spherical harmonics, see `Shader`.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        mesh: SubjectMesh,
        subject: Subject,
        field: StoredField,
        device: str,
        cutoffs: Cutoffs = USUAL,
    ):
        tensors = field.tensors
        self.subject, self.field = subject, field
        self.mesh = mesh
        columns = {name: part.contiguous() for name, part in splat_columns(tensors["splats"]).items()}
        geometry = columns["means"], columns["log_scales"], columns["quats"]
        self.neutral = LocalSplats(*geometry, columns["opacities"][:, 0], tensors.get(RESIDUAL))
        self._binding = columns["binding"][:, 0].to(torch.int64)
        self._canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        positions = self._canonical.positions(self._binding, self.neutral.means)
        self._activated = activate(self.neutral.log_scales, self.neutral.quats)
        self.colors: Shader
        self.line_offsets: LineOffsets | None = None
        if "sh_dc" not in tensors:
            features = plane_features(tensors, Bounds(*tensors["plane_box"]), positions)
            of_direction = tensors[FIRST_LAYER][:, -ENCODING_SIZE:].t().contiguous()
            self.colors = shader(position_part(tensors, features), of_direction, tensors[LAST_LAYER])
        else:
            self.colors = harmonic_shader(tensors["sh_dc"], tensors["sh_rest"])
        self._jaw_bases = tensors["jaw_bases"].cpu().numpy().astype(np.float64)
        if "lines" in tensors:
            self.line_offsets = LineOffsets(tensors, positions)
            self._expressions = len(tensors["lines"]) - len(self._jaw_bases)
        super().__init__(stored, LastPose(self._placed), device, cutoffs)

    @classmethod
    def read(cls, folder: Path, device: str) -> OursAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or incompatible files."""
        content_of, coded = partial(field_of, device=device), partial(read_coded, layout=field_layout)
        files, head, subject, field = read_stored(folder, FIELD_FILE, content_of, coded)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        return cls(files, mesh, subject, field, device)

    def _posed(self, pose: HeadPose) -> DrivenPose:
        if self.line_offsets is None:
            offsets = None
        else:
            driving = driving_coefficients(pose, self._expressions, self._jaw_bases)
            coefficients = to_device(torch.from_numpy(np.concatenate(driving)), self._binding.device)
            offsets = self.line_offsets(coefficients)
        frames = self.mesh.drive(pose)
        return DrivenPose(frames, self._canonical.turns(frames), offsets)

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        posed = self._posed(pose)
        end_stage("drive")
        splats = self._changed(posed)
        shape = splats.log_scales, splats.quats
        known = shape[0] is self.neutral.log_scales and shape[1] is self.neutral.quats
        activated = self._activated if known else None
        world = to_world(posed.frames, self._binding, splats.means, *shape, activated)

        def colors(center: Tensor) -> Tensor:
            return changed_colors(self.colors(world.means, center, posed.turns, self._binding), splats)

        return PlacedSplats(world, torch.sigmoid(splats.logits), colors)

    def _changed(self, posed: DrivenPose) -> LocalSplats:
        if posed.offsets is None:
            return self.neutral
        return apply_offsets(self.neutral, posed.offsets, self.field.dynamic)
