"""Expressions of a head model that have names: each as coefficients of the model's basis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...bench.contracts import FloatArray
from .arrays import HeadArrays
from .procedural.expressions import PAIRED, SEMANTIC_NAMES, SIDEWAYS, SINGLE
from .procedural.model import VERSIONS, semantic_to_coefficients

SIDES = (("_left", "_right"), ("_L", "_R"))
"""Endings of the names of two shapes that are mirror images."""


class NamedExpression(NamedTuple):
    """(E,) coefficients of an expression at 1, its natural extreme; at -1 it is the other one if there are two sides."""

    coefficients: FloatArray
    two_sided: bool = False


def named_expressions(head: HeadArrays) -> dict[str, NamedExpression]:
    """The expressions that a head model names, left and right together; none for models like FLAME.

    A blink that a model has as eyelid bases is not among them, since it is no expression coefficient.
    """
    size = head.expression_basis.shape[2]
    if head.version in VERSIONS:
        matrix, _ = semantic_to_coefficients(head.version)
        if matrix.shape[1] == size:
            return _procedural(dict(zip(SEMANTIC_NAMES, matrix)))
    return _paired(dict(zip(head.expression_names, np.eye(size))))


def strongest(head: HeadArrays, directions: Sequence[FloatArray]) -> list[int]:
    """Indices of expressions, (E,) coefficients each, by the largest displacement of a vertex, largest first."""
    basis = np.asarray(head.expression_basis, np.float64)
    moved = [float(np.linalg.norm(basis @ direction, axis=1).max()) for direction in directions]
    return sorted(range(len(moved)), key=lambda number: -moved[number])


def _procedural(rows: Mapping[str, FloatArray]) -> dict[str, NamedExpression]:
    found = {name: NamedExpression(rows[f"{name}_left"] + rows[f"{name}_right"]) for name in PAIRED}
    found |= {name: NamedExpression(rows[name]) for name in SINGLE}
    found |= {
        f"{name}_sideways": NamedExpression(rows[f"{name}_left"] - rows[f"{name}_right"], True)
        for name in SIDEWAYS
    }
    return {name.replace("_", " "): shape for name, shape in found.items() if shape.coefficients.any()}


def _paired(columns: Mapping[str, FloatArray]) -> dict[str, NamedExpression]:
    found: dict[str, NamedExpression] = {}
    for name, column in columns.items():
        for left, right in SIDES:
            stem = name.removesuffix(left).removesuffix(right)
            if stem != name and stem + left in columns and stem + right in columns:
                found[stem] = NamedExpression(columns[stem + left] + columns[stem + right])
                break
        else:
            found[name] = NamedExpression(column)
    return found
