"""Expressions of a head model as controls: its named expressions, or else its strongest directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from .contracts import FloatArray, HeadAsset, HeadPose

COEFFICIENT = 2.0
"""Range of unnamed directions without recorded poses: standard deviations of FLAME's coefficients."""
BEYOND = 1.5
"""Range of unnamed directions, relative to the largest recorded coefficient."""


class Expression(NamedTuple):
    """An expression: (E,) coefficients at value 1, the natural extreme of a named expression, and its range."""

    name: str
    direction: FloatArray
    low: float
    high: float


@runtime_checkable
class NamedExpressions(Protocol):
    """Optional capability of a head model: expressions with names."""

    def named_expressions(self) -> Sequence[Expression]:
        """The named expressions, possibly none."""


def expressions_of(head: HeadAsset, count: int, poses: Sequence[HeadPose]) -> list[Expression]:
    """The expressions of a head model with the largest vertex displacement at the end of their range, the strongest first.

    For models without names, such as FLAME, they are single coefficients with the range of the recorded ``poses``.
    """
    expressions = list(head.named_expressions()) if isinstance(head, NamedExpressions) else []
    basis = np.asarray(head.expression_basis, np.float64)
    if not expressions:
        reach = np.full(basis.shape[2], COEFFICIENT)
        if poses:
            largest = np.abs([pose.expression for pose in poses]).max(axis=0)
            reach = np.where(largest > 0, BEYOND * largest, reach)
        expressions = [
            Expression(f"expression {number + 1}", row, -far, far)
            for number, (row, far) in enumerate(zip(np.eye(len(reach)), reach.round(4).tolist()))
        ]
    moved = [np.linalg.norm(basis @ (shape.high * shape.direction), axis=1).max() for shape in expressions]
    order = sorted(range(len(expressions)), key=lambda number: -moved[number])
    return [expressions[number] for number in order[:count]]
