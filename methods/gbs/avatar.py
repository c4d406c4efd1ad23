"""The trained avatar of GaussianBlendshapes: its rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from ...bench.contracts import FloatArray, HeadPose, IntArray, no_stage
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.io.files import write_bytes
from ..avatars.harmonics import turn_harmonics
from ..ops.harmonics import coefficient_count, sh_degree
from ..shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head, read_subject
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors
from .blendshapes import Entries, PointMotions, PosedAttributes, Rig, apply_pose, difference_widths
from .points import SurfacePoints, full_barycentric


class GBSAvatar(StoredSplatAvatar):
    """A trained head: neutral splats, differences for expressions, and the joints that move them.

    Files: ``avatar.safetensors`` and ``subject.npz`` count as storage. The folder also has the shared head model with
    teeth. Values derived from the mesh are computed when the avatar is loaded.
    """

    def __init__(self, folder: Path, rig: Rig, stored: Stored, device: str):
        super().__init__([folder / AVATAR_FILE, folder / SUBJECT_FILE], self._placed, device)
        self._rig, self.stored = rig, stored
        self._last = LastPose(self._posed)

    @classmethod
    def read(cls, folder: Path, device: str) -> GBSAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        head = read_shared_head(folder)
        subject: Subject = read_subject(folder / SUBJECT_FILE, head)
        stored = read_avatar(folder / AVATAR_FILE, len(head.faces), head.expression_basis.shape[2], device)
        rig = Rig(head, subject.shape, subject.static_offset, stored.points, stored.expressions, device)
        return cls(folder, rig, stored, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the splats' axes, which turn with the surface."""
        posed = self._last(pose, no_stage)
        dc, rest = turn_harmonics(posed.sh_dc.cpu(), posed.sh_rest.cpu(), posed.rotation.cpu())
        return dc.numpy(), rest.numpy()

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


AVATAR_FILE = "avatar.safetensors"
EXPRESSIONS = "expressions"
"""Key of the file's metadata: number of leading expressions that may have differences."""

GEOMETRY = {"means": 3, "log_scales": 3, "quats": 4, "opacities": 1, "sh_dc": 3}
"""First columns of the (N, 14 + 3 R) float32 table of neutral splats; R harmonics above degree 0 by channel follow."""
MEMBERS = {
    "splats": Member("f", ("N", None), MAX_MAGNITUDE, "f4"),
    "triangles": Member("i", ("N",), dtype="i4"),
    "barycentric": Member("f", ("N", 2), MAX_MAGNITUDE, "f4"),
    "moved_by": Member("u", ("N", "bytes"), dtype="u1"),
    "differences": Member("f", (None, None), MAX_MAGNITUDE, "f4"),
}


class Stored(NamedTuple):
    """Content of an avatar's file.

    Attributes
    ----------
    neutral : dict[str, Tensor]
        Per-splat tensors by name, see `blendshapes.apply_pose`.
    points : SurfacePoints
        Surface point of each splat at the start of training.
    entries : Entries
        Rows of the differences; their weights are 1.
    differences : Tensor
        (M, C) difference at coefficient 1, in the columns of `blendshapes.difference_widths`.
    """

    neutral: dict[str, Tensor]
    points: SurfacePoints
    expressions: int
    entries: Entries
    differences: Tensor


def write_avatar(
    path: Path,
    neutral: Mapping[str, Tensor],
    points: SurfacePoints,
    expressions: int,
    entries: Entries,
    differences: Tensor,
) -> None:
    """Write an avatar as safetensors, exact.

    A splat takes 4 (14 + 3 R) bytes for neutral attributes, 12 for its surface point, a bit for each expression, and 4
    C bytes for each expression that moves it: 12,055 bytes with all harmonics and all of 50 expressions.
    """
    count = len(neutral["means"])
    columns = [neutral[name].reshape(count, -1) for name in (*GEOMETRY, "sh_rest")]
    moved_by = torch.zeros(count, expressions, dtype=torch.bool)
    moved_by[entries.owners.cpu(), entries.expressions.cpu()] = True
    tensors = {
        "splats": torch.cat([column.detach().to("cpu", torch.float32) for column in columns], dim=1),
        "triangles": torch.from_numpy(points.triangles.astype(np.int32)),
        "barycentric": torch.from_numpy(points.barycentric[:, 1:].astype(np.float32)),
        "moved_by": torch.from_numpy(np.packbits(moved_by.numpy(), axis=1)),
        "differences": differences.detach().to("cpu", torch.float32).contiguous(),
    }
    write_bytes(path, save(tensors, {EXPRESSIONS: str(expressions)}))


def read_avatar(path: Path, face_count: int, expression_size: int, device: str) -> Stored:
    """Read and check what `write_avatar` wrote. Raises `InputError` where a tensor is missing or does not fit."""
    tensors, metadata = read_safetensors(path)
    said = metadata.get(EXPRESSIONS, "")
    if not said.isdecimal() or len(said) > 9 or int(said) > expression_size:
        raise InputError(path, EXPRESSIONS, f"a number up to {expression_size}", repr(said[:20]))
    expressions = int(said)
    moved_by = _check(path, tensors, face_count, expressions)
    owners, moving = np.nonzero(moved_by)
    counts = torch.from_numpy(moved_by.sum(1)).to(device)
    columns = tensors["splats"].to(device).split([*GEOMETRY.values(), _rest(tensors["splats"])], dim=1)
    neutral = {name: column.contiguous() for name, column in zip((*GEOMETRY, "sh_rest"), columns)}
    neutral["opacities"] = neutral["opacities"][:, 0]
    neutral["sh_rest"] = neutral["sh_rest"].reshape(len(counts), 3, -1)
    points = SurfacePoints(
        tensors["triangles"].numpy().astype(np.int64), full_barycentric(tensors["barycentric"].numpy())
    )
    entries = Entries.of(counts, torch.from_numpy(moving).to(device), torch.ones(len(owners), device=device))
    return Stored(neutral, points, expressions, entries, tensors["differences"].to(device))


def _rest(splats: Tensor) -> int:
    return splats.shape[1] - sum(GEOMETRY.values())


def _check(path: Path, tensors: Mapping[str, Tensor], face_count: int, expressions: int) -> IntArray:
    """(N, K) whether an expression moves a splat. Raises `InputError` for the first tensor that does not fit."""
    sizes = check_tensors(path, tensors, MEMBERS, {"bytes": -(-expressions // 8)})
    splats, triangles = tensors["splats"], tensors["triangles"]

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}, or other numbers")

    rests = [3 * (coefficient_count(degree) - 1) for degree in range(4)]
    require("splats", sizes["N"] > 0 and _rest(splats) in rests, f"(N, 14 + 3 R), 3 R one of {rests}")
    fits = 0 <= int(triangles.min()) and int(triangles.max()) < face_count
    require("triangles", fits, f"triangles 0 to {face_count - 1}")
    check_sizes(path, splats[:, GEOMETRY["means"] : GEOMETRY["means"] + GEOMETRY["log_scales"]])
    moved_by = np.unpackbits(tensors["moved_by"].numpy(), axis=1, count=expressions)
    widths = [sum(difference_widths(d).values()) for d in range(4) if rests[d] <= _rest(splats)]
    table = tensors["differences"]
    fits = len(table) == int(moved_by.sum()) and table.shape[1] in widths
    require("differences", fits, f"({int(moved_by.sum())}, C), C one of {widths}")
    return moved_by.astype(np.int64)
