"""The file of a compact avatar: packed arrays by name in one safetensors file, with their shapes beside them.

Layout
------
* Each tensor is a one-dimensional uint8 stream of `packing.pack`.
* The metadata has one key, ``compact``: JSON with ``version`` (1), ``text`` (strings by name), ``steps`` (numbers by
  name) and ``arrays``: for each tensor ``[dtype, shape]``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from ...bench.errors import InputError
from ...bench.files import atomic_path
from .packing import DTYPES, MAX_BYTES, pack, unpack

KEY, VERSION = "compact", 1
MAX_ARRAYS = 64


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
    with atomic_path(path) as temporary:
        save_file(packed, temporary, {KEY: json.dumps(layout, separators=(",", ":"))})


def read_content(path: Path) -> Content:
    """Read what `write_content` wrote.

    Sizes are checked before anything is unpacked, all arrays together may take `MAX_BYTES`. Raises `InputError` for
    anything else.
    """
    try:
        with safe_open(path, framework="np") as file:
            layout = _layout(path, file.metadata() or {})
            names = set(file.keys())
            if names != set(layout["arrays"]):
                found = ", ".join(sorted(names.symmetric_difference(layout["arrays"])))
                raise InputError(
                    path, KEY, "the file's tensors and no others", f"a difference in {found}"[:200]
                )
            packed = {name: file.get_tensor(name) for name in sorted(names)}
    except (SafetensorError, OSError) as error:
        raise InputError(path, "", "a safetensors file", str(error)) from error
    arrays = {}
    for name, stream in packed.items():
        dtype, shape = layout["arrays"][name]
        if stream.dtype != np.uint8 or stream.ndim != 1:
            raise InputError(path, name, "a uint8 stream", f"{stream.dtype} of shape {stream.shape}")
        try:
            arrays[name] = unpack(stream.tobytes(), dtype, tuple(shape))
        except ValueError as error:
            raise InputError(path, name, f"{dtype} of shape {tuple(shape)}", str(error)) from error
    return Content(arrays, layout["text"], layout["steps"])


def _layout(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The checked JSON of the metadata."""
    try:
        layout = json.loads(metadata.get(KEY, "null"))
    except (ValueError, RecursionError) as error:
        raise InputError(path, KEY, "JSON", f"text that does not parse ({error})"[:200]) from error
    if not isinstance(layout, dict) or layout.get("version") != VERSION:
        raise InputError(path, KEY, f"the layout of a compact avatar, version {VERSION}", "none or another")
    arrays, text, steps = (layout.get(name) for name in ("arrays", "text", "steps"))
    if not isinstance(arrays, dict) or len(arrays) > MAX_ARRAYS or not all(map(_is_entry, arrays.values())):
        expected = f"up to {MAX_ARRAYS} times [type, shape], types among {', '.join(DTYPES)}"
        raise InputError(path, f"{KEY}, arrays", expected, repr(arrays)[:200])
    total = sum(
        int(np.prod(shape, dtype=object)) * DTYPES[dtype].itemsize for dtype, shape in arrays.values()
    )
    if total > MAX_BYTES:
        raise InputError(path, f"{KEY}, arrays", f"{MAX_BYTES} bytes at most", f"{total}")
    if not isinstance(text, dict) or not all(isinstance(value, str) for value in text.values()):
        raise InputError(path, f"{KEY}, text", "strings by name", repr(text)[:200])
    if not isinstance(steps, dict) or not all(map(_is_step, steps.values())):
        raise InputError(path, f"{KEY}, steps", "numbers from 0 to 1 by name", repr(steps)[:200])
    return layout


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[1], list):
        return False
    dtype, shape = entry
    whole = all(type(size) is int and 0 <= size <= MAX_BYTES for size in shape)
    return isinstance(dtype, str) and dtype in DTYPES and len(shape) <= 4 and whole


def _is_step(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < 1
