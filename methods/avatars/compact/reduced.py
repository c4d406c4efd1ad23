"""Content of the coded file of neutral splats with learnt blendshapes: avatars of RGBAvatar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset
from ....bench.errors import InputError
from ...rgbavatar.model import BIASES, SHAPES, WEIGHTS, StoredShapes
from ...shared.avatar_files import Subject
from ...shared.subject_mesh import SubjectMesh
from ...shared.surface_points import SurfacePoints
from ...shared.tensor_files import check_sizes
from .container import Arrays, Content, read_content
from .encoding import (
    C0,
    COARSEST_SHAPE,
    decode_harmonics,
    decode_matrix,
    decode_shapes,
    encode_harmonics,
    encode_matrix,
    encode_shapes,
    splat_size,
)
from .file import decode_subject, encode_subject
from .precision import Precision
from .surface import decode_points, encode_points, points_as_read
from .transform import decode_vectors, encode_vectors, read_classes, store_classes, visibility_classes

FLOOR = 5e-5
"""Splats smaller than this, metres, are placed as finely as one of this size."""
PARTS = ("positions", "scales", "rotations", "opacities", "harmonics")
CHANGES = 10
"""Numbers of a blendshape of a splat: position, quaternion, colour."""


def encode_reduced(
    stored: StoredShapes,
    subject: Subject,
    head: HeadAsset,
    precision: Precision,
    weights: FloatArray | None = None,
    moments: FloatArray | None = None,
) -> Content:
    """Content of a coded file.

    Parameters
    ----------
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    moments : FloatArray | None
        (K, K) second moments of the blendshapes' weights in training; None: the identity. Errors of blendshapes are weighted
        by these moments.
    """
    precision = precision.scaled
    order = np.argsort(stored.points.triangles, kind="stable")
    tensors = {name: value.detach().cpu().numpy() for name, value in stored.tensors.items()}
    neutral = {name: tensors[name][order] for name in (*SHAPES, "log_scales", "opacities")}
    own = None if weights is None else weights[order]
    classes = visibility_classes(own, len(order))
    exact_points = stored.points.rows(order)
    on_surface = encode_points(exact_points, precision)
    moved = _moved(replace(stored, points=exact_points), points_as_read(on_surface, head), subject, head)
    shapes, steps = encode_shapes(
        *(neutral["means"] + moved, neutral["log_scales"], neutral["quats"], neutral["opacities"]),
        *(precision, classes),
        turned=True,
        floor=FLOOR,
    )
    steps["harmonics"] = precision.harmonics
    no_rest = np.zeros((len(order), 3, 0), np.float32)
    colors = encode_harmonics(neutral["colors"], no_rest, precision.harmonics, classes, own, None)
    arrays = {"classes": store_classes(classes), **on_surface, **shapes, **colors}
    table = np.concatenate([tensors[name][:, order] for name in SHAPES.values()], axis=2)
    count = len(table)
    if all(getattr(precision, part) for part in PARTS):
        read = decode_shapes(Arrays(Path(), Content(dict(shapes), {}, steps)), classes, FLOOR)
        units = _units(precision, splat_size(read["log_scales"].T, FLOOR))
        vectors = (table / units).swapaxes(0, 1).reshape(len(order), count * CHANGES)
        metric = np.kron(np.eye(count) if moments is None else moments, np.eye(CHANGES))
        limited = np.minimum(classes, COARSEST_SHAPE)
        arrays |= encode_vectors("shapes", vectors, metric, 1.0, limited, own, centred=False)
    else:
        arrays["exact_shapes"] = table.astype(np.float32)
    for name in WEIGHTS:
        arrays |= encode_matrix(name, tensors[name], precision.networks)
    arrays |= {name: tensors[name].astype(np.float32) for name in BIASES}
    person = encode_subject(subject, precision)
    text = {**person.text, stored.KEY: stored.text()}
    return Content({**arrays, **person.arrays}, text, {**steps, **person.steps})


def read_reduced(path: Path, head: HeadAsset, device: str) -> tuple[Subject, StoredShapes]:
    """Subject and splats of a file of `encode_reduced`. Raises `InputError` for anything else."""
    arrays = Arrays(path, read_content(path))
    subject = decode_subject(arrays, head)
    settings = StoredShapes.settings_of(path, arrays.text.get(StoredShapes.KEY, ""))
    points = decode_points(arrays, head)
    classes = read_classes(arrays, "classes", len(points.triangles))
    shapes = decode_shapes(arrays, classes, FLOOR, turned=True)
    check_sizes(path, torch.from_numpy(shapes["log_scales"]))
    colors, _ = decode_harmonics(arrays, classes)
    tensors = {name: shapes[name] for name in ("means", "quats", "log_scales")}
    tensors |= {"colors": colors, "opacities": shapes["logits"]}
    tensors |= {name: decode_matrix(arrays, name) for name in WEIGHTS}
    tensors |= {name: arrays.floats(name, None) for name in BIASES}
    count = len(tensors[WEIGHTS[-1]])
    if "exact_shapes" in arrays:
        table = arrays.floats("exact_shapes", count, len(classes), CHANGES)
    else:
        vectors = decode_vectors(arrays, "shapes", 1.0, np.minimum(classes, COARSEST_SHAPE))
        if vectors.shape[1] != count * CHANGES:
            raise InputError(path, "shapes_mean", f"{count * CHANGES} numbers", str(vectors.shape[1]))
        precision = Precision(**{part: arrays.step(part) for part in PARTS})
        units = _units(precision, splat_size(shapes["log_scales"].T, FLOOR))
        table = vectors.reshape(len(classes), count, CHANGES).swapaxes(0, 1) * units
    tensors |= dict(zip(SHAPES.values(), np.split(table, (3, 7), axis=2)))
    content = {name: torch.from_numpy(np.array(values, np.float32)) for name, values in tensors.items()}
    return subject, StoredShapes(content, points, settings).checked(path, head, device)


def _moved(stored: StoredShapes, as_read: SurfacePoints, subject: Subject, head: HeadAsset) -> FloatArray:
    """(N, 3) differences of two sets of points along the axes at the points, on the neutral mesh, metres."""
    mesh, points = SubjectMesh(head, subject.shape, subject.static_offset, "cpu"), stored.points
    vertices, faces = mesh.canonical.double().numpy(), mesh.faces.numpy()
    axes = stored.surface(mesh, points, head, stored.settings).axes({}, mesh.canonical)[0].double().numpy()
    apart = points.positions(vertices, faces) - as_read.positions(vertices, faces)
    return np.asarray(np.linalg.solve(axes, apart[..., None])[..., 0], np.float32)


def _units(precision: Precision, size: FloatArray) -> FloatArray:
    """(N, 10) steps of position, quaternion and colour of splats of these sizes."""
    parts = [precision.positions * size[:, None].repeat(3, 1)]
    for step, width in ((precision.rotations, 4), (precision.harmonics / C0, 3)):
        parts.append(np.full((len(size), width), step))
    return np.concatenate(parts, axis=1)
