"""Content of the coded file of splats that a network translates, rotates and scales: avatars of FlashAvatar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset
from ...flashavatar.hyper_gaussians import gaussian_shapes
from ...flashavatar.model import TrainedSplats
from ...shared.avatar_files import Subject
from ...shared.networks import layer_names
from .container import Arrays, Content, read_content
from .encoding import (
    decode_harmonics,
    decode_matrix,
    decode_shapes,
    encode_harmonics,
    encode_matrix,
    encode_shapes,
)
from .file import decode_subject, encode_subject
from .networks import FINER
from .precision import Precision
from .surface import decode_points, encode_points
from .transform import read_classes, store_classes, visibility_classes

FLOOR = 5e-5
"""Splats smaller than this, metres, are placed as finely as one of this size."""
BARYCENTRIC_STEP = 1 / 64
"""Finer than for splats with separate positions, which compensate the rounding."""


def encode_offsets(
    trained: TrainedSplats,
    subject: Subject,
    precision: Precision,
    weights: FloatArray | None = None,
) -> Content:
    """Content of a coded file; ``weights`` is the (N,) `importance` of the splats, None: all are equally visible."""
    precision = precision.scaled
    order = np.argsort(trained.points.triangles, kind="stable")
    tensors = {name: value.detach().cpu().numpy() for name, value in trained.tensors.items()}
    log_scales, quats, logits, dc, rest = (
        tensors[name][order] for name in ("log_scales", "quats", "opacities", "sh_dc", "sh_rest")
    )
    own = None if weights is None else weights[order]
    classes = visibility_classes(own, len(order))
    still = np.zeros((len(order), 3), np.float32)
    shapes, steps = encode_shapes(
        *(still, log_scales, quats, logits, precision, classes), turned=True, floor=FLOOR
    )
    steps["harmonics"] = precision.harmonics
    points = encode_points(trained.points.rows(order), precision, BARYCENTRIC_STEP)
    arrays = {"classes": store_classes(classes), **points, **shapes}
    arrays |= encode_harmonics(dc, rest, precision.harmonics, classes, own, None)
    for weight, bias in zip(*layer_names(trained.settings.layers + 1)):
        arrays |= encode_matrix(weight, tensors[weight], FINER * precision.networks)
        arrays[bias] = tensors[bias].astype(np.float32)
    for name in gaussian_shapes(trained.settings.hyper_gaussians):
        # By columns, since values of one kind have similar magnitudes.
        arrays |= encode_matrix(name, tensors[name][order].T, FINER * precision.networks)
    person = encode_subject(subject, precision)
    text = {**person.text, trained.KEY: trained.text()}
    return Content({**arrays, **person.arrays}, text, {**steps, **person.steps})


def read_offsets(path: Path, head: HeadAsset, device: str) -> tuple[Subject, TrainedSplats]:
    """Subject and splats of a file of `encode_offsets`. Raises `InputError` for anything else."""
    arrays = Arrays(path, read_content(path))
    subject = decode_subject(arrays, head)
    config = TrainedSplats.settings_of(path, arrays.text.get(TrainedSplats.KEY, ""))
    points = decode_points(arrays, head, BARYCENTRIC_STEP)
    classes = read_classes(arrays, "classes", len(points.triangles))
    shapes = decode_shapes(arrays, classes, FLOOR, turned=True)
    dc, rest = decode_harmonics(arrays, classes)
    tensors = {"log_scales": shapes["log_scales"], "quats": shapes["quats"], "opacities": shapes["logits"]}
    tensors |= {"sh_dc": dc, "sh_rest": rest}
    for weight, bias in zip(*layer_names(config.layers + 1)):
        tensors |= {weight: decode_matrix(arrays, weight), bias: arrays.floats(bias, None)}
    tensors |= {name: decode_matrix(arrays, name).T for name in gaussian_shapes(config.hyper_gaussians)}
    content = {name: torch.from_numpy(np.array(values, np.float32)) for name, values in tensors.items()}
    return subject, TrainedSplats(content, points, config).checked(path, head, device)
