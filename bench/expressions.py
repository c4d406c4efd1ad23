"""Expressions of a head model as controls: those that it names, else its strongest directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from .contracts import FloatArray, HeadAsset, HeadPose

COEFFICIENT = 2.0
"""Range of directions without a name and without recorded poses: standard deviations of FLAME's coefficients."""
BEYOND = 1.5
"""Range of directions without a name, relative to the largest recorded coefficient."""


class Expression(NamedTuple):
    """An expression: (E,) coefficients at 1, which is its natural extreme if it has a name, and its range."""

    name: str
    direction: FloatArray
    low: float
    high: float


@runtime_checkable
class NamedExpressions(Protocol):
    """Optional capability of a head model: expressions with names."""

    def named_expressions(self) -> Sequence[Expression]:
        """The expressions; none if it names none."""


def expressions_of(head: HeadAsset, count: int, poses: Sequence[HeadPose]) -> list[Expression]:
    """The expressions of a head model that move a vertex farthest at the end of their range, the strongest first.

    Those of models without names, such as FLAME, are the single coefficients, ranged by recorded ``poses``.
    """
    found = list(head.named_expressions()) if isinstance(head, NamedExpressions) else []
    basis = np.asarray(head.expression_basis, np.float64)
    if not found:
        reach = np.full(basis.shape[2], COEFFICIENT)
        if poses:
            largest = np.abs([pose.expression for pose in poses]).max(axis=0)
            reach = np.where(largest > 0, BEYOND * largest, reach)
        found = [
            Expression(f"expression {number + 1}", row, -far, far)
            for number, (row, far) in enumerate(zip(np.eye(len(reach)), reach.round(4).tolist()))
        ]
    moved = [np.linalg.norm(basis @ (shape.high * shape.direction), axis=1).max() for shape in found]
    order = sorted(range(len(found)), key=lambda number: -moved[number])
    return [found[number] for number in order[:count]]
