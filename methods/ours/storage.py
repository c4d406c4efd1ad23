"""The exact file of an avatar of "ours": float32 tensors by name, fully validated on reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..ops.harmonics import coefficient_count
from ..ops.planes import ENCODING_SIZE, Bounds
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors, write_tensors
from .config import Dynamic
from .field import COLOR_NETWORK, FIRST_LAYER, LAST_LAYER, PLANES, WIDTHS, offset_width

FIELD_FILE = "avatar.safetensors"
DYNAMIC = "dynamic"
"""Key of the file's metadata: attributes that the lines change, in the order of the offset network's outputs."""

RESIDUAL = "color_residual"
"""The (N, 3) separate colours of splats, added to those of the planes."""

PER_SPLAT = ("splats", "sh_dc", "sh_rest", RESIDUAL)
"""Tensors with a row for each splat."""

SPLAT_WIDTHS = {"means": 3, "opacities": 1, "log_scales": 3, "quats": 4, "binding": 1}
"""Columns of the (N, 12) float32 splat table, 48 bytes each; the triangle is exact up to 2^24."""


def splat_columns(table: Tensor) -> dict[str, Tensor]:
    """The (N, width) columns of a splat table by name."""
    return dict(zip(SPLAT_WIDTHS, table.split(list(SPLAT_WIDTHS.values()), dim=1)))


def write_field(
    path: Path,
    splats: Mapping[str, Tensor],
    binding: Tensor,
    shared: Mapping[str, Tensor],
    plane_box: Bounds,
    line_box: Bounds,
    jaw_bases: np.ndarray,
    dynamic: Sequence[Dynamic],
) -> None:
    """Write splats, planes, lines, networks, boxes and jaw bases as float32 safetensors."""
    columns = {**splats, "opacities": splats["opacities"][:, None], "binding": binding[:, None]}
    tensors = dict(shared) | {name: splats[name] for name in PER_SPLAT if name in splats}
    tensors |= {
        "splats": torch.cat([columns[name] for name in SPLAT_WIDTHS], dim=1),
        "plane_box": torch.stack(list(plane_box)),
        "line_box": torch.stack(list(line_box)),
        "jaw_bases": torch.tensor(np.asarray(jaw_bases, dtype=np.float32)),
    }
    save_field(path, StoredField(tensors, tuple(dynamic)))


class StoredField(NamedTuple):
    """Content of an avatar's file: its tensors by name, and the attributes that the lines change."""

    tensors: dict[str, Tensor]
    dynamic: tuple[Dynamic, ...]


def save_field(path: Path, field: StoredField) -> None:
    """Write the exact file of a field atomically."""
    write_tensors(path, field.tensors, {DYNAMIC: ",".join(field.dynamic)})


def read_field(path: Path, head: HeadAsset, device: str) -> StoredField:
    """Read and check what `save_field` wrote. Raises `InputError` if a tensor is missing or does not fit."""
    return field_of(path, *read_safetensors(path), head, device)


def field_of(
    path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], head: HeadAsset, device: str
) -> StoredField:
    """Check the tensors and metadata of a file.

    Raises `InputError` if a tensor is missing, is not finite float32 or does not fit the others.
    """
    names = metadata.get(DYNAMIC, "opacity")
    given = names.split(",")
    if len(set(given)) != len(given) or not set(given) <= set(WIDTHS):
        raise InputError(path, DYNAMIC, f"names among {', '.join(WIDTHS)}, each once", repr(names)[:80])
    dynamic = cast(tuple[Dynamic, ...], tuple(given))
    needed = ["splats", "plane_box", "line_box", "jaw_bases"]
    if "sh_dc" in tensors:
        needed += ["sh_rest"]
    else:
        needed += COLOR_NETWORK
    if "lines" in tensors:
        needed += [f"line_{part}_{layer}" for layer in range(3) for part in ("direction", "gain", "bias")]
    number = Member("f", None, MAX_MAGNITUDE, "f4")
    check_tensors(path, tensors, dict.fromkeys([*needed, *tensors], number))
    _check_shapes(path, tensors, head, offset_width(dynamic))
    return StoredField({name: value.to(device) for name, value in tensors.items()}, dynamic)


def _check_shapes(path: Path, tensors: Mapping[str, Tensor], head: HeadAsset, outputs: int) -> None:
    """Raise `InputError` for the first tensor inconsistent with the others, so that rendering cannot fail."""

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}")

    def exactly(name: str, *shape: int) -> None:
        require(name, tensors[name].shape == shape, f"shape {shape}")

    face_count, expression_size = len(head.faces), head.expression_basis.shape[2]
    splats = tensors["splats"]
    width = sum(SPLAT_WIDTHS.values())
    require("splats", splats.ndim == 2 and splats.shape[1] == width, f"(N, {width})")
    binding = splats[:, -1]
    if len(binding) and not (0 <= float(binding.min()) and float(binding.max()) < face_count):
        found = f"{float(binding.min()):g} to {float(binding.max()):g}"
        raise InputError(path, "splats, triangle", f"0 to {face_count - 1}", found)
    check_sizes(path, splat_columns(splats)["log_scales"])
    for name in ("plane_box", "line_box"):
        exactly(name, 2, 3)
        if not (tensors[name][0] < tensors[name][1]).all():
            raise InputError(path, name, "a low corner below the high corner", str(tensors[name].tolist()))

    if "sh_dc" in tensors:
        exactly("sh_dc", len(splats), 3)
        rest = tensors["sh_rest"]
        counts = [coefficient_count(degree) - 1 for degree in range(4)]
        fits = rest.shape[:2] == (len(splats), 3) and rest.ndim == 3 and rest.shape[2] in counts
        require("sh_rest", fits, f"({len(splats)}, 3, K), K one of {counts}")
    else:
        if RESIDUAL in tensors:
            exactly(RESIDUAL, len(splats), 3)
        for name in PLANES:
            plane = tensors[name]
            square = plane.ndim == 2 and round(len(plane) ** 0.5) ** 2 == len(plane) >= 4
            alike = square and len(plane) == len(tensors[PLANES[0]])
            require(name, alike, "(R * R, C), R of all planes equal")
        inputs = sum(tensors[name].shape[1] for name in PLANES) + ENCODING_SIZE
        first = tensors[FIRST_LAYER]
        require(FIRST_LAYER, first.ndim == 2 and first.shape[1] == inputs, f"(H, {inputs})")
        exactly(LAST_LAYER, 3, len(first))

    bases = tensors["jaw_bases"]
    require("jaw_bases", bases.ndim == 2 and bases.shape[1] == 4, "(J, 4)")
    if "lines" not in tensors:
        return
    lines, jaws = tensors["lines"], len(bases)
    fits = lines.ndim == 4 and lines.shape[1] == 3 and jaws <= len(lines) <= jaws + expression_size
    expected = f"(E + {jaws}, 3, L, C), E at most {expression_size}, L > 1"
    require("lines", fits and lines.shape[2] >= 2, expected)
    sizes = [6 * lines.shape[3], *(len(tensors[f"line_bias_{layer}"]) for layer in (0, 1)), outputs]
    for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        exactly(f"line_direction_{layer}", fan_out, fan_in)
        exactly(f"line_gain_{layer}", fan_out, 1)
        exactly(f"line_bias_{layer}", fan_out)
