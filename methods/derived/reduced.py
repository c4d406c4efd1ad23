"""Tensors stored with fewer bits: 16-bit floats, or 8-bit numbers between each column's extremes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import save
from torch import Tensor

from ...bench.io.files import write_bytes
from ..shared.tensor_files import read_safetensors

Kind = Literal["half", "8bit"]
LEVELS = 255
LOW, STEP = "/low", "/step"
"""Endings of the names under which an 8-bit tensor's lowest values and steps lie, by column."""


def write_reduced(path: Path, tensors: Mapping[str, Tensor], kind: Kind, exact: Collection[str] = ()) -> None:
    """Write float tensors as 16-bit floats ("half") or 8-bit numbers ("8bit"); those in ``exact``, vectors and whole numbers as they are."""
    stored: dict[str, Tensor] = {}
    for name, value in tensors.items():
        if name in exact or value.ndim < 2 or not value.is_floating_point():
            stored[name] = value.contiguous()
        elif kind == "half":
            stored[name] = value.to(torch.float16).contiguous()
        else:
            stored |= _eight_bits(name, value)
    write_bytes(path, save(stored))


def read_reduced(path: Path) -> dict[str, Tensor]:
    """What `write_reduced` wrote, as float32 up to rounding; exact tensors as they were."""
    stored, _ = read_safetensors(path)
    result: dict[str, Tensor] = {}
    for name, value in stored.items():
        if name.endswith((LOW, STEP)):
            continue
        if f"{name}{STEP}" in stored:
            value = stored[f"{name}{LOW}"] + value.to(torch.float32) * stored[f"{name}{STEP}"]
        elif value.dtype == torch.float16:
            value = value.to(torch.float32)
        result[name] = value
    return result


def _eight_bits(name: str, value: Tensor) -> dict[str, Tensor]:
    """Levels, lowest value and step of each column (index of the last axis)."""
    columns = value.reshape(-1, value.shape[-1])
    if not len(columns):
        return {name: value.contiguous()}
    low = columns.amin(0)
    step = (columns.amax(0) - low) / LEVELS
    # A constant column has the step 0, and level 0 throughout.
    levels = torch.where(step > 0, (columns - low) / step.clamp_min(torch.finfo(step.dtype).tiny), 0.0)
    quantised = levels.round().clamp(0, LEVELS).to(torch.uint8).reshape(value.shape)
    return {name: quantised.contiguous(), f"{name}{LOW}": low, f"{name}{STEP}": step}
