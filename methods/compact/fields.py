"""Planes, lines and networks of a compact avatar: rounded in proportion to what they change in the picture."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ..ours.feature_lines import normalised_weight
from ..ours.field import Box, plane_features
from ..shared.sh import C0
from ..shared.triplane import PAIRS
from .coded import Arrays, coded
from .precision import Precision

PLANES = tuple(f"plane_{pair}" for pair, _, _ in PAIRS)
MATRICES = ("color_weight_0", "color_weight_1", *(f"line_direction_{layer}" for layer in range(3)))
MAX_TABLE = 2**25
"""Numbers of a plane or of all lines, those left out included; 512 x 512 samples of 128 channels."""
SENSITIVITY_FLOOR = 1e-6  # a channel that changes nothing may have any step, but a finite one


def encode_field(
    tensors: Mapping[str, Tensor], positions: Tensor, precision: Precision
) -> dict[str, np.ndarray]:
    """Arrays of everything that splats share; their steps, which differ by channel and row, are among them.

    Parameters
    ----------
    tensors : of a field.
    positions : (N, 3) canonical positions of the splats, as they will be read: samples of the planes that no splat
        reads are left out, and become 0.
    """
    arrays: dict[str, np.ndarray] = {}
    if PLANES[0] in tensors:
        arrays |= _encode_planes(tensors, positions, precision.planes)
    if "lines" in tensors:
        arrays |= _encode_lines(tensors, precision.lines)
    for name in MATRICES:
        if name in tensors:
            weights = _numpy(tensors[name])
            steps = precision.networks * np.abs(weights).max(1, keepdims=True)
            steps = np.where(steps > 0, steps, 1.0) if precision.networks else steps
            arrays |= {name: coded(weights, steps), f"{name}_steps": steps[:, 0].astype(np.float32)}
    return arrays


def decode_field(arrays: Arrays) -> dict[str, Tensor]:
    """Tensors of the arrays of `encode_field`. Raises `InputError` where they do not fit together."""
    tensors: dict[str, FloatArray] = {}
    for name in PLANES:
        if name in arrays:
            tensors[name] = _decode_plane(arrays, name)
    if "lines" in arrays:
        tensors["lines"] = _decode_lines(arrays)
    for name in MATRICES:
        if name in arrays:
            steps = arrays.floats(f"{name}_steps", None)
            tensors[name] = arrays.decoded(name, steps[:, None].astype(np.float64), len(steps), None)
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in tensors.items()}


def _encode_planes(tensors: Mapping[str, Tensor], positions: Tensor, step: float) -> dict[str, np.ndarray]:
    arrays = {}
    sensitivity = np.split(_color_sensitivity(tensors), np.cumsum([tensors[n].shape[1] for n in PLANES])[:-1])
    for name, used, weights in zip(PLANES, _used_samples(tensors, positions), sensitivity):
        steps = (step / weights).astype(np.float32)
        values = _numpy(tensors[name])[used].T
        arrays[name] = coded(values, steps[:, None].astype(np.float64))
        arrays[f"{name}_steps"] = steps
        arrays[f"{name}_used"] = used.astype(np.uint8)
    return arrays


def _decode_plane(arrays: Arrays, name: str) -> FloatArray:
    used = arrays.integers(f"{name}_used", None) > 0
    steps = arrays.floats(f"{name}_steps", None)
    values = arrays.decoded(name, steps[:, None].astype(np.float64), len(steps), int(used.sum()))
    _check_size(arrays, f"{name}_used", len(used) * len(steps))
    plane = np.zeros((len(used), len(steps)), np.float32)
    plane[used] = values.T
    return plane


def _encode_lines(tensors: Mapping[str, Tensor], step: float) -> dict[str, np.ndarray]:
    lines = _numpy(tensors["lines"])
    steps = (step / _offset_sensitivity(tensors)).astype(np.float32)
    kept = np.abs(lines).reshape(len(lines), -1).max(1, initial=0) > 0
    # Channels first: each has its own spread, to which the entropy coder adapts.
    values = np.moveaxis(lines[kept], -1, 0)
    return {
        "lines": coded(values, steps[:, None, None, None].astype(np.float64)),
        "lines_steps": steps,
        "lines_kept": kept.astype(np.uint8),
    }


def _decode_lines(arrays: Arrays) -> FloatArray:
    kept = arrays.integers("lines_kept", None) > 0
    steps = arrays.floats("lines_steps", None)
    wide = steps[:, None, None, None].astype(np.float64)
    values = arrays.decoded("lines", wide, len(steps), int(kept.sum()), None, None)
    _check_size(arrays, "lines_kept", len(kept) * values.shape[2] * values.shape[3] * len(steps))
    lines = np.zeros((len(kept), *values.shape[2:], len(steps)), np.float32)
    lines[kept] = np.moveaxis(values, 0, -1)
    return lines


def _check_size(arrays: Arrays, name: str, size: int) -> None:
    """Raise `InputError` where what was left out, which takes no bytes, would make a table too large."""
    if size > MAX_TABLE:
        raise InputError(arrays.path, name, f"a table of at most {MAX_TABLE} numbers", str(size))


def negligible_lines(tensors: Mapping[str, Tensor], step: float) -> np.ndarray:
    """(E + J,) whether all samples of a line are zero, or would be once rounded to ``step`` (`Precision.lines`)."""
    steps = (step / _offset_sensitivity(tensors)).astype(np.float32).astype(np.float64)
    largest = np.abs(_numpy(tensors["lines"])).max((1, 2), initial=0)
    return (largest <= 0.5 * steps).all(1)


def _used_samples(tensors: Mapping[str, Tensor], positions: Tensor) -> list[np.ndarray]:
    """(S,) for each plane: whether some splat reads a sample. Whatever has a gradient is read."""
    ones = {name: torch.ones(len(tensors[name]), 1, requires_grad=True) for name in PLANES}
    box = Box(*tensors["plane_box"].cpu())
    with torch.enable_grad():
        total = torch.stack([part.sum() for part in plane_features(ones, box, positions.cpu())]).sum()
    gradients = torch.autograd.grad(total, [ones[name] for name in PLANES])
    return [gradient[:, 0].numpy() > 0 for gradient in gradients]


def _color_sensitivity(tensors: Mapping[str, Tensor]) -> FloatArray:
    """(C,) change of colour by a unit of each plane channel, were all hidden units at work with random signs."""
    first, last = _numpy(tensors["color_weight_0"]), _numpy(tensors["color_weight_1"])
    channels = sum(tensors[name].shape[1] for name in PLANES)
    weight = C0 * np.linalg.norm(last, axis=0)
    return np.maximum(np.linalg.norm(weight[:, None] * first[:, :channels], axis=0), SENSITIVITY_FLOOR)


def _offset_sensitivity(tensors: Mapping[str, Tensor]) -> FloatArray:
    """(C,) the same for the channels of the lines and their offsets, the largest over kinds and axes."""
    weights = [_numpy(normalised_weight(tensors, layer)) for layer in range(3)]
    by_second = np.linalg.norm(weights[2], axis=0)
    by_first = np.linalg.norm(by_second[:, None] * weights[1], axis=0)
    by_feature = np.linalg.norm(by_first[:, None] * weights[0], axis=0)
    channels = tensors["lines"].shape[3]
    return np.maximum(by_feature.reshape(-1, channels).max(0), SENSITIVITY_FLOOR)


def _numpy(values: Tensor) -> FloatArray:
    return values.detach().cpu().numpy()
