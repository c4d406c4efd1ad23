"""The trained avatar of "ours": its rendering, with offsets of the feature lines prepared for fast frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, HeadPose
from ...bench.native.dispatch import to_device
from ...datasets.head.arrays import faces_in_region
from ..avatars.compact.field import field as field_layout
from ..avatars.compact.layouts import read_coded
from ..ops.harmonics import harmonic_shader
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
from ..shared.rendering import USUAL, Cutoffs, LastPose, PlacedSplats, StoredSplatAvatar, changes_of
from ..shared.subject_mesh import SubjectMesh
from .appearance import driving_coefficients, penalty_weights
from .config import OursConfig
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


class LineOffsets:
    """Offsets of the splats inside the lines' box; others have none.

    ``positions``: (N, 3) canonical positions.
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

    - ``face``: (F,) bool, triangles of the face, by which `changes` tells penalised splats from others.
    - ``subject``, ``field``: the subject, and the content of its file.
    - ``neutral``: the splats before an expression changes them.
    - ``line_offsets``: offsets given by the lines; None without lines.
    - ``colors``: view-dependent colour of the planes, or of spherical harmonics, see `Shader`.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        mesh: SubjectMesh,
        subject: Subject,
        field: StoredField,
        device: str,
        cutoffs: Cutoffs = USUAL,
        *,
        face: Tensor | None = None,
    ):
        tensors = field.tensors
        self._face = face
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
        face = None
        if "face" in head.regions:
            face = torch.zeros(len(mesh.faces), dtype=torch.bool, device=device)
            face[torch.from_numpy(faces_in_region(head, "face")).to(device)] = True
        return cls(files, mesh, subject, field, device, face=face)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the lines on the splats inside their box; penalised are those that the published penalty would keep."""
        if self.line_offsets is None:
            return Changes({})
        rows, changed = self.line_offsets.inside, self._changed(pose)
        triangles, values = self._binding[rows], {}
        if "opacity" in self.field.dynamic:
            values["opacity"] = torch.sigmoid(changed.logits[rows])
        if "position" in self.field.dynamic:
            size = self.mesh.frames(self.mesh.canonical).size[triangles]
            values["position"] = 1000 * (changed.means - self.neutral.means)[rows] * size[:, None]
        if "color" in self.field.dynamic and changed.color_change is not None:
            values["color"] = changed.color_change[rows]
        penalised = None
        if self._face is not None:
            unposed = self.mesh.unposed(self.mesh.arguments([pose]))
            weights = penalty_weights(unposed, self.mesh.canonical, self.mesh.faces, self._face, OursConfig())
            penalised = (weights[triangles] > 0).cpu().numpy()
        return changes_of(values, penalised)

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        frames = self.mesh.drive(pose)
        end_stage("drive")
        turns, splats = self._canonical.turns(frames), self._changed(pose)
        shape = splats.log_scales, splats.quats
        known = shape[0] is self.neutral.log_scales and shape[1] is self.neutral.quats
        activated = self._activated if known else None
        world = to_world(frames, self._binding, splats.means, *shape, activated)

        def colors(center: Tensor) -> Tensor:
            return changed_colors(self.colors(world.means, center, turns, self._binding), splats)

        return PlacedSplats(world, torch.sigmoid(splats.logits), colors)

    def _changed(self, pose: HeadPose) -> LocalSplats:
        """The splats with the offsets of the lines, if any."""
        if self.line_offsets is None:
            return self.neutral
        driving = driving_coefficients(pose, self._expressions, self._jaw_bases)
        coefficients = to_device(torch.from_numpy(np.concatenate(driving)), self._binding.device)
        return apply_offsets(self.neutral, self.line_offsets(coefficients), self.field.dynamic)
