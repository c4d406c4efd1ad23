"""The splats of a compact avatar: sorted by triangle, each column rounded to what can be seen."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ..ours.storage import SPLAT_WIDTHS
from .coded import Arrays, coded
from .integers import dequantise, from_smallest_three, narrow, smallest_three
from .precision import Precision

HARMONICS = ("sh_dc", "sh_rest")
SIZE_FLOOR = 0.02
"""Splats smaller than this, in the unit of their triangle, are placed as finely as one of this size."""
LARGEST = 80.0
"""Logarithms are cut here, so that no file makes the size overflow."""


def encode_splats(
    tensors: dict[str, Tensor], precision: Precision, turned: bool
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Arrays and steps of a splat table sorted by triangle.

    Parameters
    ----------
    tensors : with ``splats`` (N, 12) and, where they hold the colour, the harmonics.
    turned : an expression adds to the quaternions. Then all four components are kept, of any length; otherwise three
        are enough, see `smallest_three`.
    """
    means, logits, log_scales, quats, triangles = _columns(tensors["splats"])
    deltas = np.diff(triangles[:, 0].astype(np.int64), prepend=0)
    if (deltas < 0).any():
        raise ValueError("splats: expected in the order of their triangles, found another")
    steps = {
        "scales": precision.scales,
        "positions": precision.positions,
        "rotations": precision.rotations,
        "opacities": precision.opacities,
    }
    scales = coded(log_scales.T, precision.scales)
    local = quats.T if turned or not precision.rotations else smallest_three(quats).T
    arrays = {
        "triangles": narrow(deltas),
        "log_scales": scales,
        "positions": coded(means.T, precision.positions * _size(_scales(scales, precision.scales))),
        "rotations": coded(local, precision.rotations),
        "logits": coded(logits[:, 0], precision.opacities),
    }
    if "sh_dc" in tensors:
        steps["harmonics"] = precision.harmonics
        arrays |= {
            name: coded(np.moveaxis(tensors[name].cpu().numpy(), 0, -1), precision.harmonics)
            for name in HARMONICS
        }
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
    return tensors


def _columns(table: Tensor) -> list[FloatArray]:
    """Means, logits, log-scales, quaternions and triangles, (N, width) each."""
    return [part.cpu().numpy() for part in table.split(list(SPLAT_WIDTHS.values()), dim=1)]


def _scales(stored: np.ndarray, step: float) -> FloatArray:
    """(3, N) log-scales as they will be read."""
    return dequantise(stored, step) if step else stored


def _size(log_scales: FloatArray) -> FloatArray:
    """(N,) geometric mean of the standard deviations, (3, N) log-scales as read."""
    return np.maximum(np.exp(np.minimum(log_scales.astype(np.float64).mean(0), LARGEST)), SIZE_FLOOR)
