"""The file of a compact avatar: packed arrays by name in one safetensors file, with their shapes beside them.

Layout
------
* Each tensor is a one-dimensional uint8 stream of `packing.pack`.
* The metadata has one key, ``compact``: JSON with ``version`` (1), ``text`` (strings by name), ``steps`` (numbers by
  name) and ``arrays``: for each tensor ``[dtype, shape]``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.io.documents import parse_json
from ...bench.io.files import write_bytes
from ..shared.tensor_files import check_tensors, read_safetensors
from .packing import DTYPES, MAX_BYTES, pack, unpack

KEY, VERSION = "compact", 1
MAX_ARRAYS = 64
MOST, MOST_PER_BYTE = 2**22, 16
"""Numbers of all arrays of a file: 4 million, and 16 for each packed byte. Avatars have one or two for each byte; the
coder packs zeros ten thousand times smaller."""


@dataclass(frozen=True, eq=False)
class Content:
    """What such a file holds: arrays of the types of `packing.DTYPES`, texts and steps by name."""

    arrays: Mapping[str, np.ndarray]
    text: Mapping[str, str] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)


def packed_sizes(arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Bytes that each array takes in a file."""
    return {name: len(pack(values)) for name, values in arrays.items()}


def write_content(path: Path, content: Content) -> None:
    """Write a file whole or not at all; equal content gives equal bytes."""
    packed = {name: np.frombuffer(pack(values), np.uint8) for name, values in content.arrays.items()}
    arrays = {name: [values.dtype.str[1:], list(values.shape)] for name, values in content.arrays.items()}
    layout = {
        "version": VERSION,
        "text": dict(content.text),
        "steps": dict(content.steps),
        "arrays": arrays,
    }
    write_bytes(path, save(packed, {KEY: json.dumps(layout, separators=(",", ":"))}))


def read_content(path: Path) -> Content:
    """Read what `write_content` wrote.

    Sizes are checked before anything is unpacked, see `MOST`. Raises `InputError` for anything else.
    """
    tensors, metadata = read_safetensors(path)
    layout = _layout(path, metadata, sum(value.nbytes for value in tensors.values()))
    if set(tensors) != set(layout["arrays"]):
        found = ", ".join(sorted(set(tensors).symmetric_difference(layout["arrays"])))
        raise InputError(path, KEY, "the file's tensors and no others", f"a difference in {found}")
    check_tensors(path, tensors, dict.fromkeys(tensors, Member("u", (None,), dtype="u1")))
    arrays = {}
    for name, stream in sorted(tensors.items()):
        dtype, shape = layout["arrays"][name]
        try:
            arrays[name] = unpack(stream.numpy().tobytes(), dtype, tuple(shape))
        except ValueError as error:
            raise InputError(path, name, f"{dtype} of shape {tuple(shape)}", str(error)) from error
    return Content(arrays, layout["text"], layout["steps"])


def _layout(path: Path, metadata: Mapping[str, str], packed: int) -> dict[str, Any]:
    """The checked JSON of the metadata of a file with so many packed bytes."""
    layout = parse_json(metadata.get(KEY, "{}"), path, KEY)
    if layout.get("version") != VERSION:
        raise InputError(path, KEY, f"the layout of a compact avatar, version {VERSION}", "none or another")
    arrays, text, steps = (layout.get(name) for name in ("arrays", "text", "steps"))
    if not isinstance(arrays, dict) or len(arrays) > MAX_ARRAYS or not all(map(_is_entry, arrays.values())):
        expected = f"up to {MAX_ARRAYS} times [type, shape], types among {', '.join(DTYPES)}"
        raise InputError(path, f"{KEY}, arrays", expected, repr(arrays)[:200])
    numbers, limit = sum(math.prod(shape) for _, shape in arrays.values()), MOST + MOST_PER_BYTE * packed
    if numbers > limit:
        raise InputError(path, f"{KEY}, arrays", f"at most {limit} numbers in {packed} bytes", f"{numbers}")
    if not isinstance(text, dict) or not all(isinstance(value, str) for value in text.values()):
        raise InputError(path, f"{KEY}, text", "strings by name", repr(text)[:200])
    if not isinstance(steps, dict) or not all(map(_is_step, steps.values())):
        raise InputError(path, f"{KEY}, steps", "numbers from 0 to 1 by name", repr(steps)[:200])
    return layout


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[1], list):
        return False
    dtype, shape = entry
    whole = len(shape) <= 4 and all(type(size) is int and 0 <= size <= MAX_BYTES for size in shape)
    return isinstance(dtype, str) and dtype in DTYPES and whole


def _is_step(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < 1
