"""Content of the coded files of avatars made of networks: INSTA and Gaussian Head Avatar."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, HeadAsset
from ....bench.errors import InputError
from ...shared.avatar_files import Subject
from .container import Arrays, Content, fold, narrow, read_content
from .encoding import decode_matrix, decode_shapes, encode_matrix, encode_shapes
from .file import decode_subject, encode_subject
from .precision import Precision
from .transform import (
    decode_vectors,
    encode_vectors,
    levels,
    read_classes,
    store_classes,
    visibility_classes,
)

FLOOR = 1e-4
"""Splats smaller than this, in canonical units, are placed as finely as one of this size."""
FINER = 0.5
"""Factor of the steps of weights: the whole appearance depends on the networks, which take only a small part of the file."""
GEOMETRY = {"points": 3, "log_scales": 3, "quats": 4, "opacities": 1}
"""Columns of a table of splats with features, as `gha.avatar.write_avatar` stores it; features follow."""


def encode_networks(
    tensors: Mapping[str, FloatArray],
    subject: Subject,
    precision: Precision,
    *,
    grid: str = "",
    splats: str = "",
    exact: tuple[str, ...] = (),
    text: Mapping[str, str] | None = None,
    weights: FloatArray | None = None,
) -> Content:
    """Content of a coded file of tensors by name.

    Tensors of two and more axes are weights: a row for each output, rounded relative to its largest. Vectors and those in
    ``exact`` stay as they are.

    Parameters
    ----------
    grid : str
        Name of an (E, F) table of features, rounded relative to its standard deviation.
    splats : str
        Name of an (N, 11 + F) table of splats with features, see `GEOMETRY`.
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    """
    precision = precision.scaled
    arrays: dict[str, np.ndarray] = {}
    steps: dict[str, float] = {}
    if splats:
        more, steps = _encode_splats(np.asarray(tensors[splats], np.float32), precision, weights)
        arrays |= more
    for name, value in tensors.items():
        if name == splats:
            continue
        values = np.asarray(value)
        if values.dtype.kind == "u":
            arrays[f"plain/{name}"] = values
        elif name == grid and precision.tables:
            spread = float(np.std(values.astype(np.float64)))
            scale = np.array([precision.tables * spread if spread > 0 else 1.0], np.float32)
            whole = [levels(column / float(scale[0])) for column in values.T.astype(np.float64)]
            arrays |= {f"grid/{name}": narrow(fold(np.stack(whole))), f"grid/{name}_step": scale}
        elif name == grid or name in exact or values.ndim < 2 or not precision.networks:
            arrays[f"plain/{name}"] = values.astype(np.float32)
        else:
            rows = values.reshape(len(values), -1)
            arrays |= encode_matrix(f"matrix/{name}", rows, FINER * precision.networks)
    person = encode_subject(subject, precision)
    return Content({**arrays, **person.arrays}, {**person.text, **(text or {})}, {**steps, **person.steps})


def read_networks(
    path: Path,
    head: HeadAsset,
    shapes: Mapping[str, tuple[int | None, ...]],
    splats: str = "",
    content: Content | None = None,
) -> tuple[Subject, dict[str, np.ndarray]]:
    """Subject and tensors of a file of `encode_networks`, whose shapes must be these; None in a shape matches any size.

    Raises `InputError` for anything else. ``content`` is that of the file if it was read before.
    """
    arrays = Arrays(path, content or read_content(path))
    subject = decode_subject(arrays, head)
    found: dict[str, np.ndarray] = {}
    for name, shape in shapes.items():
        if name == splats:
            values = _decode_splats(arrays)
        elif f"grid/{name}" in arrays:
            (step,) = arrays.floats(f"grid/{name}_step", 1)
            values = arrays.decoded(f"grid/{name}", float(step), shape[1], shape[0]).T
        elif f"matrix/{name}" in arrays:
            values = decode_matrix(arrays, f"matrix/{name}")
            if None not in shape and values.shape == (shape[0], math.prod(shape[1:])):  # type: ignore[arg-type]
                values = values.reshape(shape)  # type: ignore[arg-type]
        else:
            values = arrays.take(f"plain/{name}", *shape)
        fits = values.ndim == len(shape) and all(
            want in (None, has) for want, has in zip(shape, values.shape)
        )
        if not fits or (values.dtype.kind == "f" and not np.isfinite(values).all()):
            raise InputError(
                path, name, f"finite numbers of shape {shape}", f"others, or shape {values.shape}"
            )
        found[name] = np.ascontiguousarray(values)
    if left := arrays.names:
        raise InputError(path, ", ".join(left)[:80], "no further arrays", "some")
    return subject, found


def as_tensors(arrays: Mapping[str, np.ndarray], device: str) -> dict[str, Tensor]:
    """Float arrays as tensors."""
    return {name: torch.from_numpy(values).to(device) for name, values in arrays.items()}


def _encode_splats(
    table: FloatArray, precision: Precision, weights: FloatArray | None
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    ends = np.cumsum([*GEOMETRY.values()])
    points, log_scales, quats, logits, features = np.split(table, ends, axis=1)
    classes = visibility_classes(weights, len(table))
    shapes = points, log_scales, quats, logits[:, 0]
    arrays, steps = encode_shapes(*shapes, precision, classes, turned=True, floor=FLOOR)
    arrays = {"classes": store_classes(classes), **arrays}
    if precision.tables:
        spread = np.maximum(features.std(0).astype(np.float64), 1e-6)
        metric = np.diag(spread**-2)
        arrays |= encode_vectors("features", features, metric, precision.tables, classes, weights)
    else:
        arrays["exact_features"] = features.T.copy()
    return arrays, {**steps, "tables": precision.tables}


def _decode_splats(arrays: Arrays) -> FloatArray:
    classes = read_classes(arrays, "classes", None)
    shapes = decode_shapes(arrays, classes, FLOOR, turned=True)
    if "exact_features" in arrays:
        features = arrays.floats("exact_features", None, len(classes)).T
    else:
        features = decode_vectors(arrays, "features", arrays.step("tables"), classes)
    columns = shapes["means"], shapes["log_scales"], shapes["quats"], shapes["logits"][:, None], features
    return np.concatenate(columns, axis=1).astype(np.float32)
