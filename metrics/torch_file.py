"""State dictionaries written by ``torch.save``, read by ``torch.load(weights_only=True)``, which executes no
code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor

from ..bench.errors import InputError
from ..bench.io.arrays import check_numbers
from ..bench.io.files import open_regular, reading

EXPECTED = "a PyTorch file of weights"


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Read the tensors named in ``shapes`` as float32, on the CPU.

    Raises `InputError` for a file that is missing, damaged, of another kind or with other objects than tensors; and for a
    tensor that is missing, of another shape, not floating-point or not finite.
    """
    with open_regular(path, EXPECTED) as stream, reading(path, EXPECTED):
        try:
            content = torch.load(stream, map_location="cpu", weights_only=True)
        except UnpicklingError as error:  # its message advises to load without weights_only
            name = re.search(r"GLOBAL (\S+)", str(error))
            found = f"the name {name[1]}, which no weights need" if name else "another pickle"
            raise InputError(path, "", EXPECTED, found) from error
    if not isinstance(content, dict):
        raise InputError(path, "", "a dictionary of tensors", type(content).__name__)
    return {name: _tensor(path, name, content.get(name), shape) for name, shape in shapes.items()}


def _tensor(path: Path, name: str, value: object, shape: tuple[int, ...]) -> Tensor:
    expected = f"a float tensor of shape {shape}"
    if value is None:
        raise InputError(path, name, expected, "no such entry", "Is it the file of another network?")
    if not isinstance(value, Tensor) or not value.is_floating_point():
        found = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise InputError(path, name, expected, str(found))
    if value.shape != shape:
        raise InputError(path, name, expected, f"shape {tuple(value.shape)}")
    with reading(path, expected, name):  # it may be sparse, or on the meta device
        numbers = value.detach().to(torch.float32).contiguous()
        check_numbers(path, name, numbers.numpy())
    return numbers
