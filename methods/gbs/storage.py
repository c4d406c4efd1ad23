"""The exact file of an avatar of GaussianBlendshapes: neutral splats and differences, fully validated on reading."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..ops.harmonics import coefficient_count
from ..shared.surface_points import POINT_MEMBERS, SurfacePoints, point_tensors, take_points
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, write_tensors
from .blendshapes import Entries, difference_widths

EXPRESSIONS = "expressions"
"""Key of the file's metadata: number of leading expressions that may have differences."""

GEOMETRY = {"means": 3, "log_scales": 3, "quats": 4, "opacities": 1, "sh_dc": 3}
"""First columns of the (N, 14 + 3 R) float32 table of neutral splats; R harmonics above degree 0 by channel follow."""
MEMBERS = {
    "splats": Member("f", ("N", None), MAX_MAGNITUDE, "f4"),
    **POINT_MEMBERS,
    "moved_by": Member("u", ("N", "bytes"), dtype="u1"),
    "differences": Member("f", (None, None), MAX_MAGNITUDE, "f4"),
}


class Stored(NamedTuple):
    """Content of an avatar's file."""

    neutral: dict[str, Tensor]
    """Per-splat tensors by name, see `blendshapes.apply_pose`."""
    points: SurfacePoints
    """Surface point of each splat at the start of training."""
    expressions: int

    entries: Entries
    """Rows of the differences; their weights are 1."""
    differences: Tensor
    """(M, C) difference at coefficient 1, in the columns of `blendshapes.difference_widths`."""


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
        **point_tensors(points),
        "splats": torch.cat(columns, dim=1),
        "moved_by": torch.from_numpy(np.packbits(moved_by.numpy(), axis=1)),
        "differences": differences,
    }
    write_tensors(path, tensors, {EXPRESSIONS: str(expressions)})


def stored_of(
    path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], head: HeadAsset, device: str
) -> Stored:
    """Check the content of a file that `write_avatar` wrote. Raises `InputError` where a tensor is missing or does not fit."""
    said, expression_size = metadata.get(EXPRESSIONS, ""), head.expression_basis.shape[2]
    if not said.isdecimal() or len(said) > 9 or int(said) > expression_size:
        raise InputError(path, EXPRESSIONS, f"a number up to {expression_size}", repr(said[:20]))
    expressions = int(said)
    moved_by = _check(path, tensors, expressions)
    owners, moving = np.nonzero(moved_by)
    counts = torch.from_numpy(moved_by.sum(1)).to(device)
    columns = tensors["splats"].to(device).split([*GEOMETRY.values(), _rest(tensors["splats"])], dim=1)
    neutral = {name: column.contiguous() for name, column in zip((*GEOMETRY, "sh_rest"), columns)}
    neutral["opacities"] = neutral["opacities"][:, 0]
    neutral["sh_rest"] = neutral["sh_rest"].reshape(len(counts), 3, -1)
    points = take_points(path, tensors, len(head.faces))
    entries = Entries.of(counts, torch.from_numpy(moving).to(device), torch.ones(len(owners), device=device))
    return Stored(neutral, points, expressions, entries, tensors["differences"].to(device))


def _rest(splats: Tensor) -> int:
    return splats.shape[1] - sum(GEOMETRY.values())


def _check(path: Path, tensors: Mapping[str, Tensor], expressions: int) -> IntArray:
    """(N, K) whether an expression moves a splat. Raises `InputError` for the first tensor that does not fit."""
    sizes = check_tensors(path, tensors, MEMBERS, {"bytes": -(-expressions // 8)})
    splats = tensors["splats"]

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}, or other numbers")

    rests = [3 * (coefficient_count(degree) - 1) for degree in range(4)]
    require("splats", sizes["N"] > 0 and _rest(splats) in rests, f"(N, 14 + 3 R), 3 R one of {rests}")
    check_sizes(path, splats[:, GEOMETRY["means"] : GEOMETRY["means"] + GEOMETRY["log_scales"]])
    moved_by = np.unpackbits(tensors["moved_by"].numpy(), axis=1, count=expressions)
    widths = [sum(difference_widths(d).values()) for d in range(4) if rests[d] <= _rest(splats)]
    table = tensors["differences"]
    fits = len(table) == int(moved_by.sum()) and table.shape[1] in widths
    require("differences", fits, f"({int(moved_by.sum())}, C), C one of {widths}")
    return moved_by.astype(np.int64)
