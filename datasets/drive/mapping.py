"""Custom tables, whose columns a map file converts to coefficients of a head model or to blendshapes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_yaml
from ...bench.registry import unknown
from ..head.arrays import HeadArrays
from .blendshapes import ARKIT, apply_blendshapes
from .signal import POSE_PARTS, DrivingSignal, SignalRequest, make_poses

_COMPONENT = re.compile(r"([a-z]+)\.(\d+)")


def read_mapped(request: SignalRequest) -> DrivingSignal:
    """Poses of a table by the map file of the request, ``{column: {coefficient: weight}}``.

    Raises `InputError` for a map with a column that the table lacks, with an unknown coefficient, or with ARKit's names beside
    coefficients, which are of another head.
    """
    table, source = request.columns, Path(request.map)
    content = {str(name): entry for name, entry in read_yaml(source).items()}
    weights = checked(content, dict[str, dict[str, float]], source)
    for column, entry in weights.items() or (("", {}),):
        if not entry:
            raise InputError(source, column, "{column: {coefficient: weight}}", "an empty map")
        if column not in table.columns:
            raise unknown(str(source), "columns", column, [*table.columns])
    unused = dict.fromkeys((name for name in table.columns if name not in weights), "not in the map")
    values = {column: table.single(column) for column in weights}
    targets = {name for entry in weights.values() for name in entry}
    blendshapes = targets & {*ARKIT}
    if blendshapes and blendshapes != targets:
        other = min(targets - blendshapes)
        raise InputError(source, other, "names of blendshapes alone, or coefficients alone", "both")
    sums: dict[str, FloatArray] = {name: np.zeros(len(table)) for name in sorted(targets)}
    for column, entry in weights.items():
        for name, weight in entry.items():
            sums[name] += weight * values[column]
    if blendshapes:
        signal = apply_blendshapes(request, sums)
        return DrivingSignal("mapped", signal.head, signal.poses, {**unused, **signal.unused})
    head = request.head()
    return DrivingSignal("mapped", head, make_poses(table.path, head, _parts(source, head, sums)), unused)


def _parts(source: Path, head: HeadArrays, sums: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(T, n) parts of poses from (T,) values by the name of a coefficient or of an expression of the head."""
    length = len(next(iter(sums.values())))
    lids = {} if head.eyelid_basis is None else {"eyelids": head.eyelid_basis.shape[2]}
    sizes = {"expression": head.expression_basis.shape[2], **POSE_PARTS, **lids}
    named = {shape.name: shape.direction for shape in head.named_expressions()}
    named |= dict(zip(head.expression_names, np.eye(sizes["expression"])))
    parts = {name: np.zeros((length, size)) for name, size in sizes.items()}
    for name, values in sums.items():
        match = _COMPONENT.fullmatch(name)
        if name in named:
            parts["expression"] += values[:, None] * named[name]
        elif match and int(match[2]) < sizes.get(match[1], 0):
            parts[match[1]][:, int(match[2])] += values
        else:
            known = [f"{part}.{n}" for part, size in sizes.items() for n in range(size)]
            raise unknown(str(source), "coefficients", name, [*named, *known])
    return parts
