"""Versions of the default head, and the coefficients of its named shapes in each.

Names of the expressions of head models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ....bench.contracts import FloatArray
from ....bench.errors import InputError
from ....bench.expressions import Expression
from .expressions import (
    LIDS,
    PAIRED,
    SEMANTIC_NAMES,
    SIDEWAYS,
    SINGLE,
    ExpressionBasis,
    keep_off_eyes,
    principal_basis,
    semantic_shapes,
)
from .surface import SculptedHead, load_sculpture

VERSIONS = ("procedural2020", "procedural2023")
SEEDS = {"procedural2020": 2020, "procedural2023": 2023}


def semantic_to_coefficients(version: str = "2023") -> tuple[FloatArray, FloatArray | None]:
    """Expression coefficients of the semantic shapes in a version.

    Returns
    -------
    tuple[FloatArray, FloatArray | None]
        (K, E) expression coefficients of each shape in `SEMANTIC_NAMES` at activation 1, and (K, 2)
        coefficients of the eyelid bases, or None if the version has none. Coefficients of
        combinations are added.
    """
    name = full_version(version)
    shapes = version_shapes(load_sculpture(), name)
    basis = basis_of_version(shapes, name)
    matrix = np.zeros((len(SEMANTIC_NAMES), basis.directions.shape[2]))
    matrix[[SEMANTIC_NAMES.index(shape) for shape in basis.names]] = basis.from_semantic
    if name != "procedural2020":
        return matrix, None
    lids = np.zeros((len(SEMANTIC_NAMES), len(LIDS)))
    for column, lid in enumerate(LIDS):
        lids[SEMANTIC_NAMES.index(lid), column] = 1
    return matrix, lids


def full_version(version: str) -> str:
    """ "procedural2023" for "2023"; raises `InputError` for versions that do not exist."""
    name = version if version.startswith("procedural") else f"procedural{version}"
    if name not in VERSIONS:
        raise InputError("procedural head", "version", " or ".join(VERSIONS), repr(version))
    return name


def version_shapes(surface: SculptedHead, version: str) -> dict[str, FloatArray]:
    """The semantic shapes (V, 3) of a version, metres at activation 1."""
    shapes = semantic_shapes(surface)
    if version != "procedural2020":
        return shapes
    # Simulates coarser capture of the older version: strengths vary over the face by up to 12 %.
    random = np.random.default_rng(SEEDS[version])
    height, depth = surface.vertices[:, 1], surface.vertices[:, 2]
    changed = {}
    for name in SEMANTIC_NAMES:
        stem = name.rsplit("_", 1)[0] if name.endswith(("_left", "_right")) else name
        if name == stem or name.endswith("_left"):
            wave, phase = random.uniform(60, 140, 2), random.uniform(0, 2 * np.pi, 2)
        strength = 1 + 0.06 * np.sin(wave[0] * height + phase[0]) + 0.06 * np.sin(wave[1] * depth + phase[1])
        field = shapes[name] * strength[:, None]
        changed[name] = shapes[name] if name in LIDS else keep_off_eyes(surface, field)
    return changed


def basis_of_version(shapes: dict[str, FloatArray], version: str) -> ExpressionBasis:
    """The expression basis of a version from its `version_shapes`."""
    kept = {name: field for name, field in shapes.items() if version != "procedural2020" or name not in LIDS}
    deviation = np.array([0.30 if name in LIDS else 0.35 for name in kept])
    return principal_basis(kept, deviation, SEEDS[version])


SIDES = (("_left", "_right"), ("_L", "_R"))
"""Name suffixes of two mirrored shapes."""


def named_expressions(version: str, names: Sequence[str], size: int) -> list[Expression]:
    """Named expressions of a head model, with left and right combined; none for models like FLAME.

    Blinks represented by eyelid bases are not included, since they are no expression coefficients.

    ``version``: Of the head model. ``names``: Names of its expression directions; () if they have none. ``size``: E, the
    number of expression directions.
    """
    if version in VERSIONS:
        matrix, _ = semantic_to_coefficients(version)
        if matrix.shape[1] == size:
            return _procedural(dict(zip(SEMANTIC_NAMES, matrix)))
    return _paired(dict(zip(names, np.eye(size))))


def _procedural(rows: Mapping[str, FloatArray]) -> list[Expression]:
    expressions = [_one_sided(name, rows[f"{name}_left"] + rows[f"{name}_right"]) for name in PAIRED]
    expressions += [_one_sided(name, rows[name]) for name in SINGLE]
    expressions += [
        Expression(f"{name} sideways", rows[f"{name}_left"] - rows[f"{name}_right"], -1.0, 1.0)
        for name in SIDEWAYS
    ]
    return [shape for shape in expressions if shape.direction.any()]


def _paired(columns: Mapping[str, FloatArray]) -> list[Expression]:
    expressions: dict[str, Expression] = {}
    for name, column in columns.items():
        both = [(left, right) for left, right in SIDES if name.endswith((left, right))]
        stem = name.removesuffix(both[0][0]).removesuffix(both[0][1]) if both else name
        pair = [stem + side for side in both[0]] if both else []
        if pair and all(side in columns for side in pair):
            expressions[stem] = _one_sided(stem, columns[pair[0]] + columns[pair[1]])
        else:
            expressions[name] = _one_sided(name, column)
    return list(expressions.values())


def _one_sided(name: str, direction: FloatArray) -> Expression:
    return Expression(name.replace("_", " "), direction, 0.0, 1.0)
