"""Layouts of the coded files: what the avatars of each method consist of, and the steps of each part.

A layout is called to encode and to decode (`Coder`); it returns the tensors of the method's exact file by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ...flashavatar.model import gaussian_shapes
from ...gbs.blendshapes import GEOMETRY, difference_widths
from ...gha.gaussian_head import POINTS
from ...ops.planes import C0, Bounds, sh_degree
from ...ours.field import (
    FIRST_LAYER,
    LAST_LAYER,
    PLANES,
    RESIDUAL,
    SPLAT_WIDTHS,
    CanonicalFrames,
    normalised_weight,
    plane_features,
)
from ...rgbavatar.model import SHAPES
from ...shared.avatar_files import Subject
from ...shared.surface_points import SubjectMesh, SurfacePoints, full_barycentric
from ..settings import Precision
from .coder import FINEST, Coder, read_content, scale_of, visibility_classes

Tensors = dict[str, np.ndarray]
Layout = Callable[[Coder, HeadAsset, Subject], Tensors]

COLOURS = "colours"
"""Name of the coded harmonics: (N, 3 K) vectors of the K numbers of each channel."""
COARSEST_SHAPE = 2
"""Coarsest class of visibility for the shapes of splats: an error of several steps of size or opacity would put a hidden splat
before visible ones."""
FLOOR = 5e-5
"""Splats on a surface smaller than this, metres, are placed as finely as one of this size."""
DIFFERENCE_STEP = 0.5  # of that of the attribute: in a pose, several differences add up


def read_coded(
    path: Path, head: HeadAsset, layout: Layout
) -> tuple[Subject, dict[str, Tensor], Mapping[str, str]]:
    """Subject, tensors of the exact file, and texts of a coded file."""
    content = read_content(path)
    version = content.text.get("head_model")
    if version != head.version:
        raise InputError(path, "head_model", repr(head.version), repr(version)[:80])
    try:
        coder = Coder(Precision(**content.steps), content.text, content.arrays)
        if coder.precision.parts != content.steps:
            raise ValueError("steps of other parts")
        subject = code_subject(coder, head)
        with np.errstate(over="ignore", invalid="ignore"):
            tensors = layout(coder, head, subject)
        if coder.left:
            raise ValueError(f"further arrays: {', '.join(coder.left)}")
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(
            path, "", "arrays of a coded avatar that fit each other", repr(error)[:200]
        ) from error
    return (
        subject,
        {name: torch.from_numpy(np.array(values)) for name, values in tensors.items()},
        content.text,
    )


def code_subject(coder: Coder, head: HeadAsset) -> Subject:
    """Code the subject of an avatar."""
    shape = coder.exact("shape", part="subject")
    offset = coder.rounded("static_offset", "subject")
    if shape.shape != (head.shape_basis.shape[2],) or offset.shape != head.template.shape:
        raise ValueError(f"a subject of another head model, shapes {shape.shape} and {offset.shape}")
    if not (np.isfinite(shape).all() and np.isfinite(offset).all()):
        raise ValueError("a subject whose numbers are not finite")
    return Subject(coder.text["name"], coder.text["head_model"], shape, offset)


def code_points(coder: Coder, head: HeadAsset, finest: float = 1 / 64) -> tuple[Tensors, SurfacePoints]:
    """Surface points of splats, rounded to multiples of ``finest`` of a side, and their tensors."""
    triangles = coder.whole("triangles", part="triangles")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(head.faces):
        raise ValueError("triangles that the head model does not have")
    inside = coder.rounded("barycentric", "positions", finest / (coder.precision.positions or 1.0))
    tensors = {"triangles": triangles.astype(np.int32), "barycentric": inside}
    return tensors, SurfacePoints(triangles, full_barycentric(inside))


def code_splats(
    coder: Coder, floor: float, means: str = "means", base: FloatArray | float = 0.0
) -> tuple[Tensors, IntArray]:
    """Means, log-scales, quaternions and opacities of splats, and their classes of visibility.

    Splats smaller than ``floor`` are placed as finely as one of this size. ``means`` is the name of the means, "" if there are
    none, and ``base`` are points to which they are close.
    """
    classes = coder.whole("classes", part="classes")
    scale = scale_of(classes, COARSEST_SHAPE)
    tensors = {"log_scales": coder.rounded("log_scales", "scales", scale)}
    tensors["opacities"] = coder.rounded("opacities", "opacities", scale[:, 0])
    tensors["quats"] = coder.rounded("quats", "rotations", scale)
    if means:
        unit = scale * splat_size(tensors["log_scales"], floor)
        tensors[means] = coder.rounded(means, "positions", unit, base)
    return tensors, classes


def splat_size(log_scales: FloatArray, floor: float) -> FloatArray:
    """(N, 1) geometric mean of the standard deviations of (N, 3) log-scales, at least ``floor``."""
    return np.maximum(np.exp(log_scales.astype(np.float64).mean(1, keepdims=True)), floor)


def code_harmonics(coder: Coder, classes: IntArray) -> Tensors:
    """(N, 3) and (N, 3, K - 1) harmonics; by default their error is the mean squared colour over directions."""
    step = coder.precision.harmonics * math.sqrt(4 * math.pi)
    joined = coder.vectors(COLOURS, "harmonics", step, scale=scale_of(classes)).reshape(len(classes), 3, -1)
    return {"sh_dc": joined[:, :, 0], "sh_rest": joined[:, :, 1:]}


def code_others(coder: Coder, exact: Sequence[str] = ()) -> Tensors:
    """All other tensors: those of two and more axes are weights of networks, except ``exact``; vectors stay as they are."""
    tensors = {}
    for name in coder.left:
        if name.endswith("/steps"):
            continue
        if coder.source is not None:
            weights = coder.source.tensors[name].ndim > 1 and name not in exact
        else:
            weights = coder.has(f"{name}/steps")
        step = coder.precision.networks if weights else 0.0
        tensors[name] = coder.matrix(name, "networks" if weights else "other", step)
    return tensors


def bound(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """Splats bound to triangles, with harmonics: GaussianAvatars."""
    triangles = coder.whole("binding", part="triangles")
    splats, classes = code_splats(coder, 0.02)
    return {"binding": triangles, **splats, **code_harmonics(coder, classes)}


def blended(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """Neutral splats on a surface with differences for expressions: GaussianBlendshapes."""
    tensors, points = code_points(coder, head, 1 / 16)  # positions are relative to the rounded points
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    rest = points.positions(mesh.canonical.numpy(), mesh.faces.numpy()).astype(np.float32)
    splats, classes = code_splats(coder, FLOOR, base=rest)
    splats |= code_harmonics(coder, classes)
    moved_by = coder.whole("moved_by", part="differences")
    owners, expressions = np.nonzero(moved_by)
    # The root mean squares of the expression coefficients in training.
    coefficients = coder.exact("coefficients", part="differences").astype(np.float64)
    widths = difference_widths(sh_degree(torch.from_numpy(splats["sh_rest"])))
    units = _units(coder, splats["log_scales"], widths)[owners] / coefficients[expressions][:, None]
    weights = None if coder.source is None or coder.source.weights is None else coder.source.weights[owners]
    scale = scale_of(classes[owners], COARSEST_SHAPE)
    options: dict[str, Any] = {"scale": scale, "units": units, "weights": weights}
    tensors["differences"] = coder.vectors("differences", "differences", DIFFERENCE_STEP, **options)
    columns = [splats[name].reshape(len(classes), -1) for name in (*GEOMETRY, "sh_rest")]
    tensors["splats"] = np.concatenate(columns, axis=1)
    tensors["moved_by"] = np.packbits(moved_by > 0, axis=1)
    return tensors


def _units(coder: Coder, log_scales: FloatArray, widths: Mapping[str, int]) -> FloatArray:
    """(N, C) steps of changes of attributes of splats; 0 where an attribute is exact."""
    precision = coder.precision
    # A coefficient of harmonics changes colours by C0, root mean square over directions.
    steps: dict[str, Any] = dict.fromkeys(("sh_dc", "sh_rest", "colors"), precision.harmonics / C0)
    steps["means"] = precision.positions * splat_size(log_scales, FLOOR)
    steps |= {"log_scales": precision.scales, "quats": precision.rotations, "opacities": precision.opacities}
    parts = [np.broadcast_to(steps[name], (len(log_scales), width)) for name, width in widths.items()]
    return np.concatenate(parts, axis=1)


def reduced(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """Splats on a surface with learnt blendshapes: RGBAvatar."""
    tensors, _ = code_points(coder, head)
    splats, classes = code_splats(coder, FLOOR)
    step = coder.precision.harmonics / C0
    splats["colors"] = coder.vectors("colors", "harmonics", step, scale=scale_of(classes))
    widths = {name: splats[name].shape[1] for name in SHAPES}
    units, scale = _units(coder, splats["log_scales"], widths), scale_of(classes, COARSEST_SHAPE)
    differences = coder.vectors("shapes", "differences", 1.0, scale=scale, units=units)
    table = differences.reshape(len(differences), -1, units.shape[1]).swapaxes(0, 1)
    parts = np.split(table, np.cumsum([*widths.values()])[:-1], axis=2)
    return {**tensors, **splats, **dict(zip(SHAPES.values(), parts)), **code_others(coder)}


def offsets(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """Splats that a network translates, rotates and scales: FlashAvatar."""
    tensors, _ = code_points(coder, head)
    splats, classes = code_splats(coder, FLOOR, means="")
    tensors |= splats | code_harmonics(coder, classes)
    for name in filter(coder.has, gaussian_shapes(1)):  # those of HyperGaussians
        tensors[name] = coder.vectors(name, "networks")
    return tensors | code_others(coder)


def networks(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """Points with features, and networks: Gaussian Head Avatar."""
    splats, classes = code_splats(coder, 1e-4, means="points")
    splats["features"] = coder.vectors("features", "tables", scale=scale_of(classes))
    columns = [splats[name].reshape(len(classes), -1) for name in (*POINTS, "features")]
    return {"table": np.concatenate(columns, axis=1), **code_others(coder, ("landmarks",))}


def grid(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """A hash grid with networks, and occupied cells: INSTA."""
    table = coder.rounded("table", "tables", coder.exact("spread").item())
    return {"occupied": coder.whole("occupied").astype(np.uint8), "table": table, **code_others(coder)}


def field(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """The tensors of a field."""
    triangles = coder.whole("binding", part="triangles")
    splats, classes = code_splats(coder, 0.02)
    columns = splats | {"opacities": splats["opacities"][:, None], "binding": triangles[:, None]}
    tensors = {"splats": np.concatenate([columns[name] for name in SPLAT_WIDTHS], axis=1).astype(np.float32)}
    if coder.has(COLOURS):
        tensors |= code_harmonics(coder, classes)
    if coder.has(RESIDUAL):
        tensors[RESIDUAL] = coder.vectors(RESIDUAL, "colors", scale=scale_of(classes))
    if coder.has(PLANES[0]):
        encoding = coder.source is not None
        shares = _shares(coder, head, subject, tensors["splats"]) if encoding else [None] * len(PLANES)
        tensors |= {name: _plane(coder, name, own) for name, own in zip(PLANES, shares)}
    if coder.has("lines"):
        shape = coder.whole("lines/shape", lambda: np.array(coder.given("lines").shape), "lines")
        values = lambda: coder.given("lines").reshape(-1, shape[3])
        samples = coder.vectors("lines", "lines", values=values, weights=np.ones(shape[:3].prod()))
        tensors["lines"] = samples.reshape(shape)
    return tensors | code_others(coder, ("plane_box", "line_box", "jaw_bases"))


def _plane(coder: Coder, name: str, shares: FloatArray | None) -> FloatArray:
    """An (S, C) plane. Samples that no splat reads, whose ``shares`` are 0, are left out and become 0."""

    def numbers() -> IntArray:
        """0 where no splat reads a sample, otherwise its class of visibility from 1 on."""
        assert shares is not None
        assert coder.source is not None
        weights = None if coder.source.weights is None else shares[shares > 0]
        result = np.zeros(len(shares), np.int64)
        result[shares > 0] = visibility_classes(weights, int(np.count_nonzero(shares))) - FINEST + 1
        return result

    classes = coder.whole(f"{name}/classes", numbers, "planes")
    used = classes > 0
    own, scale = None if shares is None else shares[used], scale_of(classes[used] - 1 + FINEST)
    samples = coder.vectors(name, "planes", scale=scale, values=lambda: coder.given(name)[used], weights=own)
    plane = np.zeros((len(used), samples.shape[1]), np.float32)
    plane[used] = samples
    return plane


def _shares(coder: Coder, head: HeadAsset, subject: Subject, splats: FloatArray) -> list[FloatArray]:
    """(S,) for each plane: sum over splats of weight times interpolation weight of the sample; 0 if no splat reads it."""
    assert coder.source is not None
    mesh, given = SubjectMesh(head, subject.shape, subject.static_offset, "cpu"), coder.source.tensors
    frames, table = CanonicalFrames.of(mesh.frames(mesh.canonical)), torch.from_numpy(splats)
    positions = frames.positions(table[:, -1].to(torch.int64), table[:, : SPLAT_WIDTHS["means"]])
    ones = {name: torch.ones(len(given[name]), 1, requires_grad=True) for name in PLANES}
    # Weights are above 0, since every sample that is read is stored.
    weights = np.ones(len(splats)) if coder.source.weights is None else coder.source.weights
    factor = torch.from_numpy(np.maximum(weights / max(weights.mean(), 1e-30), 1e-6)).to(positions)
    with torch.enable_grad():
        features = plane_features(ones, Bounds(*torch.from_numpy(given["plane_box"])), positions)
        total = torch.stack([(part[:, 0] * factor).sum() for part in features]).sum()
    gradients = torch.autograd.grad(total, [ones[name] for name in PLANES])
    return [gradient[:, 0].numpy().astype(np.float64) for gradient in gradients]


def field_metrics(tensors: Mapping[str, torch.Tensor]) -> dict[str, FloatArray]:
    """Metrics of planes and lines: squared change of colour, and of offsets (the mean over kinds and axes), if all hidden
    units were active with random signs."""
    metrics = {}
    if PLANES[0] in tensors:
        first, last = (tensors[name].double().cpu().numpy() for name in (FIRST_LAYER, LAST_LAYER))
        weighted = C0 * np.linalg.norm(last, axis=0)[:, None] * first
        ends = np.cumsum([tensors[name].shape[1] for name in PLANES])
        metrics = {name: part.T @ part for name, part in zip(PLANES, np.split(weighted, ends, axis=1))}
    if "lines" in tensors:
        layers = [normalised_weight(tensors, layer).double().cpu().numpy() for layer in range(3)]
        by_first = np.linalg.norm(np.linalg.norm(layers[2], axis=0)[:, None] * layers[1], axis=0)
        blocks = (by_first[:, None] * layers[0]).reshape(len(by_first), -1, tensors["lines"].shape[3])
        metrics["lines"] = np.einsum("hbc,hbd->cd", blocks, blocks) / blocks.shape[1]
    return metrics
