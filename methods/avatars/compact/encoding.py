"""Encode a field's tensors as arrays rounded by their visible effect, and decode them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, IntArray
from ....bench.errors import InputError
from ...ops.harmonics import C0, sh_basis
from ...ops.planes import ENCODING_SIZE, Bounds
from ...ours.field import FIRST_LAYER, LAST_LAYER, PLANES, normalised_weight, plane_features
from ...ours.storage import RESIDUAL, splat_columns
from .container import Arrays, coded, dequantise, fold, from_smallest_three, narrow, smallest_three
from .precision import Precision
from .transform import (
    decode_vectors,
    encode_vectors,
    has_vectors,
    levels,
    read_classes,
    scale_of,
    store_classes,
    visibility_classes,
)

MATRICES = (FIRST_LAYER, LAST_LAYER, *(f"line_direction_{layer}" for layer in range(3)))
MAX_TABLE = 2**25
"""Maximum size of a plane or of all lines, including omitted samples: 512 x 512 samples of 128 channels."""


def encode_field(
    tensors: Mapping[str, Tensor], positions: Tensor, precision: Precision, weights: FloatArray | None = None
) -> dict[str, np.ndarray]:
    """Arrays of all shared tensors, and their steps by channel and row.

    Parameters
    ----------
    positions : Tensor
        (N, 3) canonical positions of the splats after decoding: samples of the planes that no splat
        reads are left out and become 0.
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    """
    arrays: dict[str, np.ndarray] = {}
    if PLANES[0] in tensors:
        arrays |= _encode_planes(tensors, positions, precision.planes, weights)
    if "lines" in tensors:
        arrays |= _encode_lines(tensors, precision.lines)
    inputs = _input_magnitudes(tensors, positions)
    for name in MATRICES:
        if name in tensors:
            arrays |= encode_matrix(name, _numpy(tensors[name]), precision.networks, inputs.get(name))
    return arrays


def encode_matrix(
    name: str, weights: FloatArray, step: float, inputs: FloatArray | None = None
) -> dict[str, np.ndarray]:
    """Arrays of (R, C) weights, rounded relative to the largest of their row, and the steps of the rows.

    ``inputs`` are the (C,) magnitudes of what the weights are multiplied with, if they are known: weights are then rounded,
    and compared in their row, as multiplied with them.
    """
    if not step:
        return {name: coded(weights, 0.0), f"{name}_steps": np.zeros(len(weights), np.float32)}
    scaled, arrays = np.asarray(weights, np.float64), {}
    if inputs is not None:
        floor = 1e-3 * max(float(np.max(inputs, initial=0)), 1e-9)
        arrays[f"{name}_inputs"] = np.maximum(inputs, floor).astype(np.float32)
        scaled = scaled * arrays[f"{name}_inputs"]
    largest = np.abs(scaled).max(1, initial=0)
    steps = np.where(largest > 0, step * largest, 1.0).astype(np.float32)
    whole = levels((scaled / steps[:, None].astype(np.float64)).ravel()).reshape(scaled.shape)
    return {**arrays, name: narrow(fold(whole)), f"{name}_steps": steps}


def decode_matrix(arrays: Arrays, name: str) -> FloatArray:
    """Inverse of `encode_matrix` up to rounding."""
    steps = arrays.floats(f"{name}_steps", None)
    weights = arrays.decoded(name, steps[:, None].astype(np.float64), len(steps), None)
    if f"{name}_inputs" in arrays:
        inputs = arrays.floats(f"{name}_inputs", weights.shape[1])
        if not (inputs > 0).all():
            raise InputError(arrays.path, f"{name}_inputs", "numbers above 0", "others")
        weights = weights / inputs
    return weights


def decode_field(arrays: Arrays) -> dict[str, Tensor]:
    """Tensors of the arrays of `encode_field`. Raises `InputError` where they do not fit together."""
    tensors: dict[str, FloatArray] = {}
    for name in PLANES:
        if name in arrays:
            tensors[name] = _decode_plane(arrays, name, arrays.steps.get("planes", 0.0))
    if "lines" in arrays:
        tensors["lines"] = _decode_lines(arrays, arrays.steps.get("lines", 0.0))
    for name in MATRICES:
        if name in arrays:
            tensors[name] = decode_matrix(arrays, name)
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in tensors.items()}


def _encode_planes(
    tensors: Mapping[str, Tensor], positions: Tensor, step: float, weights: FloatArray | None
) -> dict[str, np.ndarray]:
    arrays = {}
    first, last = _numpy(tensors[FIRST_LAYER]), _numpy(tensors[LAST_LAYER])
    start = 0
    for name, shares in zip(PLANES, _plane_shares(tensors, positions, weights)):
        used, plane = shares > 0, _numpy(tensors[name])
        columns = first[:, start : start + plane.shape[1]]
        start += plane.shape[1]
        arrays[f"{name}_used"] = used.astype(np.uint8)
        if not step:
            arrays[f"{name}_steps"] = np.zeros(plane.shape[1], np.float32)
            arrays[name] = plane[used].T.astype(np.float32)
            continue
        # Change of the colour if all hidden units were active with random signs.
        weighted = C0 * np.linalg.norm(last, axis=0)[:, None] * columns
        own = shares[used]
        classes = visibility_classes(own if weights is not None else None, len(own))
        arrays[f"{name}_classes"] = store_classes(classes)
        arrays |= encode_vectors(name, plane[used], weighted.T @ weighted, step, classes, own)
    return arrays


def _decode_plane(arrays: Arrays, name: str, step: float) -> FloatArray:
    used = arrays.integers(f"{name}_used", None) > 0
    if has_vectors(arrays, name):
        classes = read_classes(arrays, f"{name}_classes", int(used.sum()))
        values = decode_vectors(arrays, name, step, classes)
    else:
        steps = arrays.floats(f"{name}_steps", None)
        values = arrays.decoded(name, steps[:, None].astype(np.float64), len(steps), int(used.sum())).T
    _check_size(arrays, f"{name}_used", len(used) * values.shape[1])
    plane = np.zeros((len(used), values.shape[1]), np.float32)
    plane[used] = values
    return plane


def _encode_lines(tensors: Mapping[str, Tensor], step: float) -> dict[str, np.ndarray]:
    lines = _numpy(tensors["lines"])
    kept = np.abs(lines).reshape(len(lines), -1).max(1, initial=0) > 0
    arrays = {"lines_kept": kept.astype(np.uint8), "lines_samples": np.array([lines.shape[2]], np.uint32)}
    if not step:
        steps = np.zeros(lines.shape[3], np.float32)
        return {**arrays, "lines": np.moveaxis(lines[kept], -1, 0), "lines_steps": steps}
    vectors = lines[kept].reshape(-1, lines.shape[3])
    classes = np.zeros(len(vectors), np.int64)
    return {**arrays, **encode_vectors("lines", vectors, _offset_metric(tensors), step, classes, None)}


def _decode_lines(arrays: Arrays, step: float) -> FloatArray:
    kept = arrays.integers("lines_kept", None) > 0
    if has_vectors(arrays, "lines"):
        (samples,) = arrays.integers("lines_samples", 1).astype(np.int64)
        _check_size(arrays, "lines_samples", int(samples) * len(kept))
        vectors = decode_vectors(arrays, "lines", step, np.zeros(3 * int(samples * kept.sum()), np.int64))
        values = vectors.reshape(int(kept.sum()), 3, int(samples), vectors.shape[1])
    else:
        arrays.drop("lines_samples")
        steps = arrays.floats("lines_steps", None)
        wide = steps[:, None, None, None].astype(np.float64)
        values = np.moveaxis(arrays.decoded("lines", wide, len(steps), int(kept.sum()), None, None), 0, -1)
    _check_size(arrays, "lines_kept", len(kept) * values.shape[1] * values.shape[2] * values.shape[3])
    lines = np.zeros((len(kept), *values.shape[1:]), np.float32)
    lines[kept] = values
    return lines


def _check_size(arrays: Arrays, name: str, size: int) -> None:
    """Raise `InputError` if a table would be too large with its omitted samples, which take no bytes."""
    if size > MAX_TABLE:
        raise InputError(arrays.path, name, f"a table of at most {MAX_TABLE} numbers", str(size))


def negligible_lines(tensors: Mapping[str, Tensor], step: float) -> np.ndarray:
    """(E + J,) whether no sample of a line is visible, each compared with half a ``step`` (`Precision.lines`)."""
    lines = _numpy(tensors["lines"]).astype(np.float64)
    squares = np.einsum("kalc,cd,kald->kal", lines, _offset_metric(tensors), lines, optimize=True)
    return squares.max((1, 2), initial=0) <= (0.5 * step) ** 2


def _plane_shares(
    tensors: Mapping[str, Tensor], positions: Tensor, weights: FloatArray | None
) -> list[np.ndarray]:
    """(S,) for each plane: sum over splats of weight times interpolation weight of the sample; 0 if no splat reads it."""
    ones = {name: torch.ones(len(tensors[name]), 1, requires_grad=True) for name in PLANES}
    box = Bounds(*tensors["plane_box"].cpu())
    # Weights are above 0, since every sample that is read is stored.
    own = np.ones(len(positions)) if weights is None else np.maximum(weights, 1e-6 * np.mean(weights) + 1e-30)
    factor = (
        torch.from_numpy(own / max(own.mean(), 1e-30)).to(positions.cpu()) if len(own) else torch.zeros(0)
    )
    with torch.enable_grad():
        features = plane_features(ones, box, positions.cpu())
        total = torch.stack([(part[:, 0] * factor).sum() for part in features]).sum()
    gradients = torch.autograd.grad(total, [ones[name] for name in PLANES])
    return [gradient[:, 0].numpy().astype(np.float64) for gradient in gradients]


def _input_magnitudes(tensors: Mapping[str, Tensor], positions: Tensor) -> dict[str, FloatArray]:
    """Root mean squares of the inputs of the first layers, by name of the weights."""
    found: dict[str, FloatArray] = {}
    if PLANES[0] in tensors and len(positions):
        box = Bounds(*tensors["plane_box"].cpu())
        cpu = {name: tensors[name].cpu() for name in PLANES}
        features = torch.cat(plane_features(cpu, box, positions.cpu()), dim=1)
        of_planes = features.square().mean(0).sqrt().numpy().astype(np.float64)
        # The encoding of the direction has sines and cosines.
        found[FIRST_LAYER] = np.concatenate([of_planes, np.full(ENCODING_SIZE, math.sqrt(0.5))])
    if "lines" in tensors:
        lines, jaws = _numpy(tensors["lines"]).astype(np.float64), len(tensors["jaw_bases"])
        kinds = np.split(lines, [len(lines) - jaws])
        squares = [(kind**2).sum(0).mean(1) for kind in kinds]  # (3, C) each, for coefficients of 1
        found["line_direction_0"] = np.sqrt(np.stack(squares)).ravel()
    return found


def _offset_metric(tensors: Mapping[str, Tensor]) -> FloatArray:
    """(C, C) metric of the channels of the lines: squared change of the offsets, the mean over kinds and axes, if all
    hidden units were active with random signs."""
    weights = [_numpy(normalised_weight(tensors, layer)).astype(np.float64) for layer in range(3)]
    by_second = np.linalg.norm(weights[2], axis=0)
    by_first = np.linalg.norm(by_second[:, None] * weights[1], axis=0)
    channels = tensors["lines"].shape[3]
    blocks = (by_first[:, None] * weights[0]).reshape(len(by_first), -1, channels)
    return np.asarray(np.einsum("hbc,hbd->cd", blocks, blocks) / blocks.shape[1])


def _numpy(values: Tensor) -> FloatArray:
    return values.detach().cpu().numpy()


HARMONICS = ("sh_dc", "sh_rest")
SIZE_FLOOR = 0.02
"""Splats smaller than this, in the unit of their triangle, are placed as finely as one of this size."""
LARGEST = 80.0
"""Logarithms are clamped here, so that sizes cannot overflow."""


COARSEST_SHAPE = 2
"""Coarsest class of visibility for the shapes of splats: an error of several steps of size or opacity would put a hidden splat
before visible ones."""


def colour_metric(count: int, directions: FloatArray | None = None) -> FloatArray:
    """(3 K, 3 K) metric of harmonics of three channels, K = ``count`` numbers each: mean squared colour over directions.

    Parameters
    ----------
    directions : FloatArray | None
        (M, 3) unit vectors along which training views see the splats, if the harmonics stay in the world: four fifths
        of the weight are theirs, and one fifth is that of the whole sphere, so that other views are kept, too.
    """
    whole = np.eye(count) / (4 * np.pi)
    if directions is not None:
        basis = sh_basis(torch.from_numpy(np.asarray(directions, np.float64)), math.isqrt(count) - 1).numpy()
        whole = 0.2 * whole + 0.8 * basis.T @ basis / len(basis)
    return np.kron(np.eye(3), whole)


def encode_splats(
    tensors: dict[str, Tensor],
    precision: Precision,
    turned: bool,
    weights: FloatArray | None = None,
    directions: FloatArray | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Arrays and steps of a splat table sorted by triangle.

    Parameters
    ----------
    tensors : dict[str, Tensor]
        ``splats`` (N, 12) and, if they hold the colour, the harmonics.
    turned : bool
        Whether an expression adds to the quaternions. Then all four components are kept, of any
        length; otherwise three are enough, see `smallest_three`.
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    directions : FloatArray | None
        As for `colour_metric`.
    """
    columns = splat_columns(tensors["splats"].cpu())
    means, logits, log_scales, quats, triangles = (part.numpy() for part in columns.values())
    deltas = np.diff(triangles[:, 0].astype(np.int64), prepend=0)
    if (deltas < 0).any():
        raise ValueError("splats: expected to be sorted by triangle, found another order")
    classes = visibility_classes(weights, len(means))
    arrays = {"classes": store_classes(classes), "triangles": narrow(deltas)}
    shapes, steps = encode_shapes(means, log_scales, quats, logits[:, 0], precision, classes, turned=turned)
    arrays |= shapes
    if "sh_dc" in tensors:
        steps["harmonics"] = precision.harmonics
        both = {name: _numpy(tensors[name]) for name in HARMONICS}
        arrays |= encode_harmonics(
            both["sh_dc"], both["sh_rest"], precision.harmonics, classes, weights, directions
        )
    if RESIDUAL in tensors:
        steps["colors"] = precision.colors
        own = _numpy(tensors[RESIDUAL])
        if precision.colors:
            arrays |= encode_vectors(RESIDUAL, own, np.eye(3), precision.colors, classes, weights)
        else:
            arrays[RESIDUAL] = coded(own.T, 0.0)
    return arrays, steps


def encode_shapes(
    means: FloatArray,
    log_scales: FloatArray,
    quats: FloatArray,
    logits: FloatArray,
    precision: Precision,
    classes: IntArray,
    *,
    turned: bool,
    floor: float = SIZE_FLOOR,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Arrays and steps of (N, 3) means, (N, 3) log-scales, (N, 4) quaternions and (N,) logits; ``floor`` as `SIZE_FLOOR`."""
    scale = scale_of(classes, COARSEST_SHAPE)
    steps = {part: getattr(precision, part) for part in ("scales", "positions", "rotations", "opacities")}
    scales = coded(log_scales.T, precision.scales * scale)
    as_read = dequantise(scales, precision.scales * scale) if precision.scales else scales
    local = quats.T if turned or not precision.rotations else smallest_three(quats).T
    return {
        "log_scales": scales,
        "logits": coded(logits, precision.opacities * scale),
        "rotations": coded(local, precision.rotations * scale),
        "positions": coded(means.T, precision.positions * scale * splat_size(as_read, floor)),
    }, steps


def decode_shapes(
    arrays: Arrays, classes: IntArray, floor: float = SIZE_FLOOR, *, turned: bool = False
) -> dict[str, FloatArray]:
    """``means``, ``log_scales``, ``quats`` and ``logits`` of `encode_shapes`; ``turned`` requires four components of rotations."""
    count, scale = len(classes), scale_of(classes, COARSEST_SHAPE)
    log_scales = arrays.decoded("log_scales", arrays.step("scales") * scale, 3, count)
    means = arrays.decoded(
        "positions", arrays.step("positions") * scale * splat_size(log_scales, floor), 3, count
    )
    rotations = arrays.decoded("rotations", arrays.step("rotations") * scale, None, count)
    if len(rotations) not in ((4,) if turned else (3, 4)):
        expected = f"shape ({'' if turned else '3 or '}4, {count})"
        raise InputError(arrays.path, "rotations", expected, f"shape {rotations.shape}")
    quats = from_smallest_three(rotations.T) if len(rotations) == 3 else rotations.T
    logits = arrays.decoded("logits", arrays.step("opacities") * scale, count)
    return {"means": means.T, "log_scales": log_scales.T, "quats": quats, "logits": logits}


def encode_harmonics(
    dc: FloatArray,
    rest: FloatArray,
    step: float,
    classes: IntArray,
    weights: FloatArray | None,
    directions: FloatArray | None,
) -> dict[str, np.ndarray]:
    """Arrays of (N, 3) and (N, 3, K - 1) harmonics."""
    if not step:
        return {name: coded(np.moveaxis(part, 0, -1), 0.0) for name, part in zip(HARMONICS, (dc, rest))}
    joined = np.concatenate([dc[:, :, None], rest], axis=2)
    metric = colour_metric(joined.shape[2], directions)
    return encode_vectors("colours", joined.reshape(len(dc), -1), metric, step, classes, weights)


def decode_harmonics(arrays: Arrays, classes: IntArray) -> tuple[FloatArray, FloatArray]:
    """(N, 3) and (N, 3, K - 1) harmonics of `encode_harmonics`."""
    step, count = arrays.step("harmonics"), len(classes)
    if has_vectors(arrays, "colours"):
        values = decode_vectors(arrays, "colours", step, classes)
        if values.shape[1] % 3 or not values.shape[1]:
            raise InputError(arrays.path, "colours_mean", "3 K numbers", str(values.shape[1]))
        joined = values.reshape(count, 3, -1)
        return joined[:, :, 0], joined[:, :, 1:]
    shapes: dict[str, tuple[int | None, ...]] = {"sh_dc": (3, count), "sh_rest": (3, None, count)}
    dc, rest = (np.moveaxis(arrays.decoded(name, step, *shapes[name]), -1, 0) for name in HARMONICS)
    return dc, rest


def decode_splats(arrays: Arrays) -> dict[str, Tensor]:
    """``splats`` and harmonics of the arrays of `encode_splats`. Raises `InputError` where they do not fit."""
    deltas = arrays.integers("triangles", None).astype(np.int64)
    count = len(deltas)
    classes = read_classes(arrays, "classes", count) if "classes" in arrays else np.zeros(count, np.int64)
    triangles = np.cumsum(deltas)
    if count and triangles[-1] >= 2**24:
        raise InputError(arrays.path, "triangles", "numbers below 2^24", str(triangles[-1]))
    shapes = decode_shapes(arrays, classes)
    columns = [shapes["means"], shapes["logits"][:, None], shapes["log_scales"], shapes["quats"]]
    columns.append(triangles[:, None].astype(np.float32))
    table = np.concatenate([column.astype(np.float32) for column in columns], axis=1)
    tensors = {"splats": torch.from_numpy(table)}
    if HARMONICS[0] in arrays or has_vectors(arrays, "colours"):
        for name, values in zip(HARMONICS, decode_harmonics(arrays, classes)):
            tensors[name] = torch.from_numpy(np.ascontiguousarray(values))
    if has_vectors(arrays, RESIDUAL):
        own = decode_vectors(arrays, RESIDUAL, arrays.step("colors"), classes)
        if own.shape[1] != 3:
            raise InputError(arrays.path, f"{RESIDUAL}_mean", "3 numbers", str(own.shape[1]))
        tensors[RESIDUAL] = torch.from_numpy(own)
    elif RESIDUAL in arrays:
        values = arrays.decoded(RESIDUAL, arrays.step("colors"), 3, count)
        tensors[RESIDUAL] = torch.from_numpy(np.ascontiguousarray(values.T))
    return tensors


def splat_size(log_scales: FloatArray, floor: float) -> FloatArray:
    """(N,) geometric mean of the standard deviations, (3, N) log-scales as read."""
    return np.maximum(np.exp(np.minimum(log_scales.astype(np.float64).mean(0), LARGEST)), floor)
