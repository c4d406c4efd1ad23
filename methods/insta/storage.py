"""The file of an INSTA avatar: parameters in half precision, occupied cells as bits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...bench.configuration import build
from ...bench.errors import HeadbenchError, InputError
from ...bench.io.arrays import Member, read_arrays
from ...bench.io.documents import read_json
from ...bench.io.files import write_json
from ..shared.avatar_files import write_arrays
from .config import InstaConfig
from .field import Architecture

FIELD_FILE = "field.npz"
SETTINGS_FILE = "field.json"
OCCUPIED = "occupied"


def write_settings(path: Path, config: InstaConfig) -> None:
    """Write the settings that decide how the field is read and rendered."""
    write_json(path, asdict(config))


def read_settings(path: Path) -> InstaConfig:
    """Read what `write_settings` wrote. Raises `InputError` for settings that are unknown or out of range."""
    try:
        config: InstaConfig = build(InstaConfig, read_json(path), str(path))
    except InputError:
        raise
    except (HeadbenchError, TypeError, ValueError) as error:
        raise InputError(path, "", "settings of INSTA", str(error)) from error
    return config


def write_field(path: Path, parameters: Mapping[str, Tensor], occupied: np.ndarray) -> None:
    """Write parameters, and (X, Y, Z) occupancy."""
    arrays = {name: value.detach().cpu().half().numpy() for name, value in parameters.items()}
    bits = np.packbits(occupied.reshape(-1))
    write_arrays(path, {**arrays, OCCUPIED: bits})


def read_field(
    path: Path, architecture: Architecture, size: tuple[int, ...], device: str
) -> tuple[dict[str, Tensor], np.ndarray]:
    """Read what `write_field` wrote: float32 parameters, and flat numbers of occupied cells.

    Raises `InputError` where an array is missing, not finite or of another shape or type.
    """
    shapes = architecture.shapes()
    cells = math.prod(size)
    members = {name: Member("f", shape, dtype="f2") for name, shape in shapes.items()}
    arrays = read_arrays(path, {**members, OCCUPIED: Member("u", (-(-cells // 8),), dtype="u1")})
    parameters = {name: torch.from_numpy(arrays[name].astype(np.float32)).to(device) for name in shapes}
    return parameters, np.flatnonzero(np.unpackbits(arrays[OCCUPIED], count=cells))
