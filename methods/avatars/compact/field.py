"""Layout of the coded file of "ours": splats, planes, lines and networks."""

from __future__ import annotations

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset
from ...ops.harmonics import C0
from ...ops.planes import Bounds
from ...ours.field import FIRST_LAYER, LAST_LAYER, PLANES, CanonicalFrames, normalised_weight, plane_features
from ...ours.storage import RESIDUAL, SPLAT_WIDTHS
from ...shared.avatar_files import Subject
from ...shared.subject_mesh import SubjectMesh
from .coder import Coder, scale_of
from .container import MOST_NUMBERS
from .layouts import COLOURS, Tensors, code_harmonics, code_others, code_splats


def field(coder: Coder, head: HeadAsset, subject: Subject) -> Tensors:
    """The tensors of a field; splats are the columns of its table by name."""
    turned = "rotation" in coder.text["dynamic"].split(",")
    triangles = coder.whole("binding", part="triangles")
    splats, classes = code_splats(coder, floor=0.02, turned=turned)
    columns = splats | {"opacities": splats["opacities"][:, None], "binding": triangles[:, None]}
    tensors = {"splats": np.concatenate([columns[name] for name in SPLAT_WIDTHS], axis=1).astype(np.float32)}
    if coder.has("sh_dc", COLOURS):
        tensors |= code_harmonics(coder, classes)
    if coder.has(RESIDUAL):
        tensors[RESIDUAL] = coder.vectors(RESIDUAL, "colors", scale=scale_of(classes))
    if coder.has(PLANES[0]):
        shares = metrics = None
        if coder.source is not None:
            shares, metrics = _plane_shares(coder, head, subject, tensors["splats"]), _plane_metrics(coder)
        for number, name in enumerate(PLANES):
            tensors[name] = _plane(coder, name, shares and shares[number], metrics and metrics[number])
    if coder.has("lines"):
        tensors["lines"] = _lines(coder)
    exact = ("plane_box", "line_box", "jaw_bases")
    return tensors | code_others(coder, exact)


def _plane(coder: Coder, name: str, shares: FloatArray | None, metric: FloatArray | None) -> FloatArray:
    """An (S, C) plane. Samples that no splat reads are left out and become 0."""
    used = coder.whole(f"{name}/used", None if shares is None else shares > 0, "planes") > 0
    own = None if shares is None else shares[used]
    weighted = coder.source is not None and coder.source.weights is not None
    classes = coder.classes(f"{name}/classes", own if weighted else None, int(used.sum()))
    values = None if coder.source is None else coder.given(name)[used]
    options = {"values": values, "metric": metric, "weights": own}
    found = coder.vectors(name, "planes", scale=scale_of(classes), **options)
    if len(used) * found.shape[1] > MOST_NUMBERS:
        raise ValueError(f"{name} has {len(used)} samples of {found.shape[1]} numbers")
    plane = np.zeros((len(used), found.shape[1]), np.float32)
    plane[used] = found
    return plane


def _lines(coder: Coder) -> FloatArray:
    """The (K, 3, L, C) lines."""
    values = metric = shape = None
    if coder.source is not None:
        lines = coder.given("lines")
        shape, metric = lines.shape[:3], _offset_metric(coder)
        values = lines.reshape(-1, lines.shape[3])
    shape = coder.whole("lines/shape", shape, "lines")
    found = coder.vectors(
        "lines",
        coder.precision.lines,
        "lines",
        values=values,
        metric=metric,
        weights=None if values is None else np.ones(len(values)),
        centred=False,
    )
    return found.reshape(*shape, found.shape[1])


def _plane_shares(coder: Coder, head: HeadAsset, subject: Subject, splats: FloatArray) -> list[FloatArray]:
    """(S,) for each plane: sum over splats of weight times interpolation weight of the sample; 0 if no splat reads it."""
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    frames = CanonicalFrames.of(mesh.frames(mesh.canonical))
    table = torch.from_numpy(splats)
    positions = frames.positions(table[:, -1].to(torch.int64), table[:, : SPLAT_WIDTHS["means"]])
    ones = {name: torch.ones(len(coder.source.tensors[name]), 1, requires_grad=True) for name in PLANES}
    box = Bounds(*torch.from_numpy(coder.source.tensors["plane_box"]))
    # Weights are above 0, since every sample that is read is stored.
    weights = coder.source.weights
    own = np.ones(len(splats)) if weights is None else np.maximum(weights, 1e-6 * np.mean(weights) + 1e-30)
    factor = torch.from_numpy(own / max(own.mean(), 1e-30)).to(positions)
    with torch.enable_grad():
        features = plane_features(ones, box, positions)
        total = torch.stack([(part[:, 0] * factor).sum() for part in features]).sum()
    gradients = torch.autograd.grad(total, [ones[name] for name in PLANES])
    return [gradient[:, 0].numpy().astype(np.float64) for gradient in gradients]


def _plane_metrics(coder: Coder) -> list[FloatArray]:
    """(C, C) for each plane: change of the colour if all hidden units were active with random signs."""
    first, last = (coder.source.tensors[name].astype(np.float64) for name in (FIRST_LAYER, LAST_LAYER))
    ends = np.cumsum([coder.source.tensors[name].shape[1] for name in PLANES])
    weighted = C0 * np.linalg.norm(last, axis=0)[:, None] * first
    return [part.T @ part for part in np.split(weighted, ends, axis=1)[:-1]]


def _offset_metric(coder: Coder) -> FloatArray:
    """(C, C) metric of the channels of the lines: squared change of the offsets, the mean over kinds and axes, if all
    hidden units were active with random signs."""
    tensors = {name: torch.from_numpy(value) for name, value in coder.source.tensors.items()}
    weights = [normalised_weight(tensors, layer).numpy().astype(np.float64) for layer in range(3)]
    by_second = np.linalg.norm(weights[2], axis=0)
    by_first = np.linalg.norm(by_second[:, None] * weights[1], axis=0)
    channels = tensors["lines"].shape[3]
    blocks = (by_first[:, None] * weights[0]).reshape(len(by_first), -1, channels)
    return np.asarray(np.einsum("hbc,hbd->cd", blocks, blocks) / blocks.shape[1])
