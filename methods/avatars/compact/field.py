"""Layout of the coded file of "ours": splats, planes, lines and networks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ...ops.harmonics import C0
from ...ops.planes import Bounds
from ...ours.field import FIRST_LAYER, LAST_LAYER, PLANES, CanonicalFrames, normalised_weight, plane_features
from ...ours.storage import RESIDUAL, SPLAT_WIDTHS
from ...shared.avatar_files import Subject
from ...shared.subject_mesh import SubjectMesh
from .coder import FINEST, Coder, scale_of, visibility_classes
from .layouts import COLOURS, Tensors, code_harmonics, code_others, code_splats


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
        found = coder.vectors("lines", "lines", values=values, weights=np.ones(shape[:3].prod()))
        tensors["lines"] = found.reshape(shape)
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
    found = coder.vectors(name, "planes", scale=scale, values=lambda: coder.given(name)[used], weights=own)
    plane = np.zeros((len(used), found.shape[1]), np.float32)
    plane[used] = found
    return plane


def _shares(coder: Coder, head: HeadAsset, subject: Subject, splats: FloatArray) -> list[FloatArray]:
    """(S,) for each plane: sum over splats of weight times interpolation weight of the sample; 0 if no splat reads it."""
    assert coder.source is not None
    mesh, given = SubjectMesh(head, subject.shape, subject.static_offset, "cpu"), coder.source.tensors
    frames, table = CanonicalFrames.of(mesh.frames(mesh.canonical)), torch.from_numpy(splats)
    positions = frames.positions(table[:, -1].to(torch.int64), table[:, : SPLAT_WIDTHS["means"]])
    ones = {name: torch.ones(len(given[name]), 1, requires_grad=True) for name in PLANES}
    # Weights are above 0, since every sample that is read is stored.
    own = np.ones(len(splats)) if coder.source.weights is None else coder.source.weights
    factor = torch.from_numpy(np.maximum(own / max(own.mean(), 1e-30), 1e-6)).to(positions)
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
