"""Encode a field's tensors as arrays rounded by their visible effect, and decode them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray
from ....bench.errors import InputError
from ...ops.harmonics import C0
from ...ops.planes import Bounds
from ...ours.field import FIRST_LAYER, LAST_LAYER, PLANES, normalised_weight, plane_features
from ...ours.storage import RESIDUAL, splat_columns
from .container import Arrays, coded, dequantise, from_smallest_three, narrow, smallest_three
from .precision import Precision

MATRICES = (FIRST_LAYER, LAST_LAYER, *(f"line_direction_{layer}" for layer in range(3)))
MAX_TABLE = 2**25
"""Maximum size of a plane or of all lines, including omitted samples: 512 x 512 samples of 128 channels."""
SENSITIVITY_FLOOR = 1e-6  # a channel without effect may have any finite step


def encode_field(
    tensors: Mapping[str, Tensor], positions: Tensor, precision: Precision
) -> dict[str, np.ndarray]:
    """Arrays of all shared tensors, and their steps by channel and row.

    Parameters
    ----------
    positions : Tensor
        (N, 3) canonical positions of the splats after decoding: samples of the planes that no splat
        reads are left out and become 0.
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
    """Raise `InputError` if a table would be too large with its omitted samples, which take no bytes."""
    if size > MAX_TABLE:
        raise InputError(arrays.path, name, f"a table of at most {MAX_TABLE} numbers", str(size))


def negligible_lines(tensors: Mapping[str, Tensor], step: float) -> np.ndarray:
    """(E + J,) whether all samples of a line are zero, or would be once rounded to ``step`` (`Precision.lines`)."""
    steps = (step / _offset_sensitivity(tensors)).astype(np.float32).astype(np.float64)
    largest = np.abs(_numpy(tensors["lines"])).max((1, 2), initial=0)
    return (largest <= 0.5 * steps).all(1)


def _used_samples(tensors: Mapping[str, Tensor], positions: Tensor) -> list[np.ndarray]:
    """(S,) for each plane: whether any splat reads the sample, that is, whether it has a gradient."""
    ones = {name: torch.ones(len(tensors[name]), 1, requires_grad=True) for name in PLANES}
    box = Bounds(*tensors["plane_box"].cpu())
    with torch.enable_grad():
        total = torch.stack([part.sum() for part in plane_features(ones, box, positions.cpu())]).sum()
    gradients = torch.autograd.grad(total, [ones[name] for name in PLANES])
    return [gradient[:, 0].numpy() > 0 for gradient in gradients]


def _color_sensitivity(tensors: Mapping[str, Tensor]) -> FloatArray:
    """(C,) change of colour per unit of each plane channel, if all hidden units were active with random signs."""
    first, last = _numpy(tensors[FIRST_LAYER]), _numpy(tensors[LAST_LAYER])
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


HARMONICS = ("sh_dc", "sh_rest")
SIZE_FLOOR = 0.02
"""Splats smaller than this, in the unit of their triangle, are placed as finely as one of this size."""
LARGEST = 80.0
"""Logarithms are clamped here, so that sizes cannot overflow."""


def encode_splats(
    tensors: dict[str, Tensor], precision: Precision, turned: bool
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Arrays and steps of a splat table sorted by triangle.

    Parameters
    ----------
    tensors : dict[str, Tensor]
        ``splats`` (N, 12) and, if they hold the colour, the harmonics.
    turned : bool
        Whether an expression adds to the quaternions. Then all four components are kept, of any
        length; otherwise three are enough, see `smallest_three`.
    """
    columns = splat_columns(tensors["splats"].cpu())
    means, logits, log_scales, quats, triangles = (part.numpy() for part in columns.values())
    deltas = np.diff(triangles[:, 0].astype(np.int64), prepend=0)
    if (deltas < 0).any():
        raise ValueError("splats: expected to be sorted by triangle, found another order")
    steps = {part: getattr(precision, part) for part in ("scales", "positions", "rotations", "opacities")}
    scales = coded(log_scales.T, precision.scales)
    as_read = dequantise(scales, precision.scales) if precision.scales else scales
    local = quats.T if turned or not precision.rotations else smallest_three(quats).T
    arrays = {
        "triangles": narrow(deltas),
        "log_scales": scales,
        "positions": coded(means.T, precision.positions * _size(as_read)),
        "rotations": coded(local, precision.rotations),
        "logits": coded(logits[:, 0], precision.opacities),
    }
    if "sh_dc" in tensors:
        steps["harmonics"] = precision.harmonics
        arrays |= {
            name: coded(np.moveaxis(tensors[name].cpu().numpy(), 0, -1), precision.harmonics)
            for name in HARMONICS
        }
    if RESIDUAL in tensors:
        steps["colors"] = precision.colors
        arrays[RESIDUAL] = coded(tensors[RESIDUAL].cpu().numpy().T, precision.colors)
    return arrays, steps


def decode_splats(arrays: Arrays) -> dict[str, Tensor]:
    """``splats`` and harmonics of the arrays of `encode_splats`. Raises `InputError` where they do not fit."""
    deltas = arrays.integers("triangles", None).astype(np.int64)
    count = len(deltas)
    triangles = np.cumsum(deltas)
    if count and triangles[-1] >= 2**24:
        raise InputError(arrays.path, "triangles", "numbers below 2^24", str(triangles[-1]))
    log_scales = arrays.decoded("log_scales", arrays.step("scales"), 3, count)
    means = arrays.decoded("positions", arrays.step("positions") * _size(log_scales), 3, count)
    rotations = arrays.decoded("rotations", arrays.step("rotations"), None, count)
    if len(rotations) not in (3, 4):
        raise InputError(arrays.path, "rotations", f"shape (3 or 4, {count})", f"shape {rotations.shape}")
    quats = from_smallest_three(rotations.T) if len(rotations) == 3 else rotations.T
    logits = arrays.decoded("logits", arrays.step("opacities"), count)
    columns = [means.T, logits[:, None], log_scales.T, quats, triangles[:, None]]
    table = np.concatenate([column.astype(np.float32) for column in columns], axis=1)
    tensors = {"splats": torch.from_numpy(table)}
    if HARMONICS[0] in arrays:
        step = arrays.step("harmonics")
        shapes: dict[str, tuple[int | None, ...]] = {"sh_dc": (3, count), "sh_rest": (3, None, count)}
        for name in HARMONICS:
            values = np.moveaxis(arrays.decoded(name, step, *shapes[name]), -1, 0)
            tensors[name] = torch.from_numpy(np.ascontiguousarray(values))
    if RESIDUAL in arrays:
        values = arrays.decoded(RESIDUAL, arrays.step("colors"), 3, count)
        tensors[RESIDUAL] = torch.from_numpy(np.ascontiguousarray(values.T))
    return tensors


def _size(log_scales: FloatArray) -> FloatArray:
    """(N,) geometric mean of the standard deviations, (3, N) log-scales as read."""
    return np.maximum(np.exp(np.minimum(log_scales.astype(np.float64).mean(0), LARGEST)), SIZE_FLOOR)
