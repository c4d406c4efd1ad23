"""Checkpoints: tensors and plain containers, written atomically and read without executing code.

A checkpoint is a safetensors file. Its metadata has one key, ``checkpoint``: JSON with ``layout``, ``run``, ``state``
and ``digest``. In the state, tensors are referenced by number, and containers have their type.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from ...bench.errors import InputError
from ...bench.io.documents import parse_json
from ...bench.io.files import reading, write_bytes
from .tensor_files import read_safetensors

LAYOUT = 2
KEY = "checkpoint"
REMEDY = "Delete it to start over."


def save_checkpoint(path: Path, run: str, state: dict[str, Any]) -> None:
    """Write the state of a run.

    - ``run``: digest of everything the run was started with; `load_checkpoint` refuses files with another digest.
    - ``state``: nested dicts, lists and tuples of tensors, numbers and text.
    """
    tensors: dict[str, Tensor] = {}
    tree = _packed(state, tensors)
    content = {"layout": LAYOUT, "run": run, "state": tree, "digest": _digest(tree, tensors)}
    write_bytes(path, save(tensors, {KEY: json.dumps(content)}))


def load_checkpoint(path: Path, run: str, device: str) -> dict[str, Any] | None:
    """Read the state of a run, or None without a checkpoint."""
    if not path.exists():
        return None
    try:
        tensors, metadata = read_safetensors(path)
        content = parse_json(metadata.get(KEY, ""), path, KEY)
    except InputError as error:
        raise InputError(path, "", "a checkpoint", error.found, REMEDY) from error
    if content.get("layout") != LAYOUT:
        raise InputError(path, "layout", str(LAYOUT), "another layout", REMEDY)
    if content.get("run") != run:
        raise InputError(
            path,
            "run",
            "a checkpoint of this method, clip, settings, budget and seed",
            "one of another run",
            "Use another output folder, or delete it to start over.",
        )
    if content.get("digest") != _digest(content.get("state"), tensors):
        raise InputError(path, "digest", "what was written", "damaged data", REMEDY)
    # Copies, since the rounding of sums also depends on memory alignment.
    copies = {name: value.to(device, copy=True) for name, value in tensors.items()}
    with reading(path, "containers and tensors of the file", "state", REMEDY):
        state = _unpacked(content["state"], copies)
    if not isinstance(state, dict):
        raise InputError(path, "state", "a dictionary", type(state).__name__, REMEDY)
    return state


def _packed(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The value as JSON, with tensors by number."""
    if isinstance(value, Tensor):
        name, strides = str(len(tensors)), value.stride()
        # The order of axes in memory affects the rounding of sums and thus the continued run.
        axes = sorted(range(value.ndim), key=lambda axis: strides[axis], reverse=True)
        # A copy, since a file cannot have two tensors with shared memory.
        ordered = value.detach().permute(axes)
        tensors[name] = ordered.to("cpu", copy=True, memory_format=torch.contiguous_format)
        return {"tensor": [name, axes]}
    if isinstance(value, Mapping):
        return {"dict": [[_packed(key, tensors), _packed(entry, tensors)] for key, entry in value.items()]}
    if isinstance(value, (list, tuple)):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [_packed(entry, tensors) for entry in value]}
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{type(value).__name__} is not supported in a checkpoint")


def _unpacked(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Inverse of `_packed`."""
    if not isinstance(tree, dict):
        return tree
    ((kind, value),) = tree.items()
    if kind == "tensor":
        name, axes = value
        return tensors[name].permute([axes.index(axis) for axis in range(len(axes))])
    if kind == "float":
        return float(value)
    if kind == "dict":
        return {_unpacked(key, tensors): _unpacked(entry, tensors) for key, entry in value}
    return {"list": list, "tuple": tuple}[kind](_unpacked(entry, tensors) for entry in value)


def _digest(tree: Any, tensors: Mapping[str, Tensor]) -> str:
    state = hashlib.sha256(json.dumps(tree).encode())
    for name, value in sorted(tensors.items()):
        state.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        state.update(value.reshape(-1).view(torch.uint8).numpy())
    return state.hexdigest()
