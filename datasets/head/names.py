"""Names of the expressions of head models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.expressions import Expression
from .procedural.expressions import PAIRED, SEMANTIC_NAMES, SIDEWAYS, SINGLE
from .procedural.versions import VERSIONS, semantic_to_coefficients

SIDES = (("_left", "_right"), ("_L", "_R"))
"""Name suffixes of two mirrored shapes."""


def named_expressions(version: str, names: Sequence[str], size: int) -> list[Expression]:
    """Named expressions of a head model, with left and right combined; none for models like FLAME.

    Blinks represented by eyelid bases are not included, since they are no expression coefficients.

    Parameters
    ----------
    version : str
        Of the head model.
    names : Sequence[str]
        Names of its expression directions; () if they have none.
    size : int
        E, the number of expression directions.
    """
    if version in VERSIONS:
        matrix, _ = semantic_to_coefficients(version)
        if matrix.shape[1] == size:
            return _procedural(dict(zip(SEMANTIC_NAMES, matrix)))
    return _paired(dict(zip(names, np.eye(size))))


def _procedural(rows: Mapping[str, FloatArray]) -> list[Expression]:
    found = [_one_sided(name, rows[f"{name}_left"] + rows[f"{name}_right"]) for name in PAIRED]
    found += [_one_sided(name, rows[name]) for name in SINGLE]
    found += [
        Expression(f"{name} sideways", rows[f"{name}_left"] - rows[f"{name}_right"], -1.0, 1.0)
        for name in SIDEWAYS
    ]
    return [shape for shape in found if shape.direction.any()]


def _paired(columns: Mapping[str, FloatArray]) -> list[Expression]:
    found: dict[str, Expression] = {}
    for name, column in columns.items():
        both = [(left, right) for left, right in SIDES if name.endswith((left, right))]
        stem = name.removesuffix(both[0][0]).removesuffix(both[0][1]) if both else name
        pair = [stem + side for side in both[0]] if both else []
        if pair and all(side in columns for side in pair):
            found[stem] = _one_sided(stem, columns[pair[0]] + columns[pair[1]])
        else:
            found[name] = _one_sided(name, column)
    return list(found.values())


def _one_sided(name: str, direction: FloatArray) -> Expression:
    return Expression(name.replace("_", " "), direction, 0.0, 1.0)
