"""Content of the coded file of neutral splats with differences for expressions: avatars of GaussianBlendshapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ...gbs.blendshapes import Entries, difference_widths
from ...gbs.storage import Stored
from ...shared.avatar_files import Subject
from ...shared.subject_mesh import SubjectMesh
from ...shared.surface_points import SurfacePoints
from ...shared.tensor_files import check_sizes
from .container import Arrays, Content, read_content
from .encoding import (
    C0,
    COARSEST_SHAPE,
    decode_harmonics,
    decode_shapes,
    encode_harmonics,
    encode_shapes,
    splat_size,
)
from .file import decode_subject, encode_subject
from .precision import Precision
from .surface import decode_points, encode_points, points_as_read
from .transform import decode_vectors, encode_vectors, read_classes, store_classes, visibility_classes

FLOOR = 5e-5
"""Splats smaller than this, metres, are placed as finely as one of this size."""
DIFFERENCE_STEP = 0.5
"""Step of differences relative to that of the attribute: in a pose, several differences add up."""


def encode_blended(
    stored: Stored,
    subject: Subject,
    head: HeadAsset,
    precision: Precision,
    weights: FloatArray | None = None,
    coefficients: FloatArray | None = None,
) -> Content:
    """Content of a coded file. Differences that round to 0 are left out.

    Parameters
    ----------
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    coefficients : FloatArray | None
        (K,) root mean squares of the expression coefficients in training; None: all are 1.
    """
    precision = precision.scaled
    order = np.argsort(stored.points.triangles, kind="stable")
    neutral = {name: value.detach().cpu().numpy()[order] for name, value in stored.neutral.items()}
    own = None if weights is None else weights[order]
    classes = visibility_classes(own, len(order))
    person = encode_subject(subject, precision)
    read = decode_subject(Arrays(Path(), person), head)
    on_surface = encode_points(stored.points.rows(order), precision)
    points = points_as_read(on_surface, head)
    arrays = {"classes": store_classes(classes), **on_surface}
    local = neutral["means"] - _rest(points, read, head)
    geometry = neutral["log_scales"], neutral["quats"], neutral["opacities"]
    shapes, steps = encode_shapes(local, *geometry, precision, classes, turned=True, floor=FLOOR)
    arrays |= shapes
    steps["harmonics"] = precision.harmonics
    colours = neutral["sh_dc"], neutral["sh_rest"]
    arrays |= encode_harmonics(*colours, precision.harmonics, classes, own, None)

    # Rows of the differences, in the new order of the splats.
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    owners = place[stored.entries.owners.cpu().numpy()]
    expressions = stored.entries.expressions.cpu().numpy()
    rows = np.lexsort((expressions, owners))
    owners, expressions = owners[rows], expressions[rows]
    table = stored.differences.detach().cpu().numpy()[rows].astype(np.float64)
    scales = np.ones(stored.expressions) if coefficients is None else coefficients[: stored.expressions]
    scales = np.maximum(scales, 1e-3 * max(float(np.max(scales, initial=0)), 1e-9)).astype(np.float32)
    read_shapes = decode_shapes(Arrays(Path(), Content(dict(shapes), {}, steps)), classes, FLOOR)
    units = _units(
        precision, splat_size(read_shapes["log_scales"].T, FLOOR), owners, scales[expressions], table.shape[1]
    )
    if all(
        getattr(precision, part) for part in ("positions", "scales", "rotations", "opacities", "harmonics")
    ):
        of_rows = None if own is None else own[owners]
        vectors = encode_vectors(
            "differences",
            table / units,
            np.eye(table.shape[1]),
            DIFFERENCE_STEP,
            np.minimum(classes[owners], COARSEST_SHAPE),
            of_rows,
            centred=False,
        )
        kept = vectors["differences"].any(0)
        vectors["differences"] = vectors["differences"][:, kept]
        arrays["difference_units"] = scales
        arrays |= vectors
    else:
        kept = np.ones(len(table), bool)
        arrays["exact_differences"] = table.astype(np.float32)
    moved_by = np.zeros((stored.expressions, len(order)), np.uint8)
    moved_by[expressions[kept], owners[kept]] = 1
    arrays["moved_by"] = moved_by
    return Content({**arrays, **person.arrays}, person.text, {**steps, **person.steps})


def read_blended(path: Path, head: HeadAsset, device: str) -> tuple[Subject, Stored]:
    """Subject and splats of a file of `encode_blended`. Raises `InputError` for anything else."""
    arrays = Arrays(path, read_content(path))
    subject = decode_subject(arrays, head)
    points = decode_points(arrays, head)
    count = len(points.triangles)
    classes = read_classes(arrays, "classes", count)
    shapes = decode_shapes(arrays, classes, FLOOR, turned=True)
    check_sizes(path, torch.from_numpy(shapes["log_scales"]))
    dc, rest = decode_harmonics(arrays, classes)
    means = shapes["means"] + _rest(points, subject, head)
    neutral: dict[str, FloatArray] = {**shapes, "means": means, "opacities": shapes["logits"]}
    neutral |= {"sh_dc": dc, "sh_rest": rest}
    neutral.pop("logits")
    moved_by = arrays.integers("moved_by", None, count) > 0
    if len(moved_by) > head.expression_basis.shape[2]:
        raise InputError(
            path, "moved_by", f"at most {head.expression_basis.shape[2]} rows", str(len(moved_by))
        )
    owners, expressions = np.nonzero(moved_by.T)
    if "exact_differences" in arrays:
        differences = arrays.floats("exact_differences", len(owners), None)
    else:
        scales = arrays.floats("difference_units", len(moved_by))
        differences = decode_vectors(
            arrays, "differences", DIFFERENCE_STEP, np.minimum(classes[owners], COARSEST_SHAPE)
        )
        precision = Precision(**{part: arrays.step(part) for part in (*PARTS, "harmonics")})
        size = splat_size(shapes["log_scales"].T, FLOOR)
        differences = differences * _units(precision, size, owners, scales[expressions], differences.shape[1])
    widths = [sum(difference_widths(degree).values()) for degree in range(4)]
    if differences.shape[1] not in widths or differences.shape[1] - widths[0] > rest[0].size:
        raise InputError(
            path, "differences", f"{widths} columns, no more than those of the splats", str(differences.shape)
        )
    if not np.isfinite(differences).all():
        raise InputError(path, "differences", "finite numbers", "others")
    counts = torch.from_numpy(moved_by.sum(0)).to(device)
    moving = torch.from_numpy(expressions).to(device)
    entries = Entries.of(counts, moving, torch.ones(len(owners), device=device))
    tensors = {name: _tensor(values, device) for name, values in neutral.items()}
    return subject, Stored(tensors, points, len(moved_by), entries, _tensor(differences, device))


PARTS = ("positions", "scales", "rotations", "opacities")


def _tensor(values: FloatArray, device: str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)


def _rest(points: SurfacePoints, subject: Subject, head: HeadAsset) -> FloatArray:
    """(N, 3) positions of the points on the neutral mesh, metres."""
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    return points.positions(mesh.canonical.numpy(), mesh.faces.numpy()).astype(np.float32)


def _units(
    precision: Precision, size: FloatArray, owners: IntArray, scales: FloatArray, columns: int
) -> FloatArray:
    """(M, C) steps of the attributes that the differences change, per unit of their coefficient."""
    widths = difference_widths(0)
    by_name = {
        "means": precision.positions * size[owners],
        "log_scales": precision.scales,
        "quats": precision.rotations,
        "opacities": precision.opacities,
    }
    # A coefficient of harmonics changes colours by C0, root mean square over directions.
    harmonic = precision.harmonics / C0
    parts = [
        np.broadcast_to(np.asarray(by_name.get(name, harmonic))[..., None], (len(owners), width))
        for name, width in widths.items()
        if name != "sh_rest"
    ]
    rest = columns - sum(part.shape[1] for part in parts)
    parts.append(np.full((len(owners), rest), harmonic))
    return np.concatenate(parts, axis=1) / scales[:, None]
