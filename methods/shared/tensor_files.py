"""Tensors in safetensors files, validated on reading like the arrays of an npz."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from ...bench.errors import InputError
from ...bench.io.arrays import Member, check_arrays
from ...bench.io.files import reading, write_bytes

MAX_MAGNITUDE = 1e6
"""Maximum magnitude of values of an avatar: network weights, features, positions in units of the triangle."""
MAX_LOGARITHM = 30.0
"""Maximum logarithm of a size; larger ones overflow when they are squared and multiplied."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors atomically, real numbers in float32; equal tensors give equal bytes."""
    stored = {}
    for name, value in tensors.items():
        dtype = torch.float32 if value.is_floating_point() else value.dtype
        stored[name] = value.detach().to("cpu", dtype).contiguous()
    write_bytes(path, save(stored, dict(metadata)))


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors of a file, on the CPU, and its metadata."""
    expected = "a safetensors file"
    with reading(path, expected), safe_open(path, framework="pt", device="cpu") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        metadata = dict(file.metadata() or {})
    return tensors, metadata


def check_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    members: Mapping[str, Member],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """`check_arrays` for tensors on the CPU; sizes of the named axes."""
    arrays = {}
    for name in members.keys() & tensors.keys():
        try:
            arrays[name] = tensors[name].numpy()
        except TypeError as error:  # a dtype that numpy lacks
            expected = members[name].dtype or "numbers"
            raise InputError(path, name, expected, str(tensors[name].dtype)) from error
    return check_arrays(path, arrays, members, sizes)


def check_sizes(path: Path, logarithms: Tensor, name: str = "log_scales") -> None:
    """Raise `InputError` for logarithms of sizes beyond `MAX_LOGARITHM`."""
    largest = float(logarithms.max()) if logarithms.numel() else 0.0
    if largest > MAX_LOGARITHM:
        raise InputError(path, name, f"logarithms of sizes up to {MAX_LOGARITHM:g}", f"{largest:g}")
