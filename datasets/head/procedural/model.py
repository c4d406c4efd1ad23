"""The default head as a model in FLAME's layout, in two versions with one topology and different bases."""

from __future__ import annotations

import numpy as np

from ....bench.contracts import FloatArray
from ....bench.errors import InputError
from ...rounding import LENGTH_BITS, REGRESSOR_BITS, SHARE_BITS, on_grid
from ..arrays import HeadArrays
from .expressions import (
    LIDS,
    SEMANTIC_NAMES,
    ExpressionBasis,
    identity_basis,
    keep_off_eyes,
    principal_basis,
    semantic_shapes,
)
from .surface import (
    PARENTS,
    SculptedHead,
    joint_regressor,
    landmarks,
    load_sculpture,
    pose_basis,
    regions,
    skinning_weights,
)

VERSIONS = ("procedural2020", "procedural2023")
_SEEDS = {"procedural2020": 2020, "procedural2023": 2023}


def procedural_head(version: str = "2023") -> HeadArrays:
    """The embedded default head.

    Parameters
    ----------
    version : str
        "2023" ("procedural2023") or "2020" ("procedural2020"). Both have the same topology and
        template. In 2020 two eyelid bases represent the blinks, and shapes and directions differ slightly.

    Raises
    ------
    InputError
        The version is unknown.
    """
    name = full_version(version)
    surface = load_sculpture()
    shapes = version_shapes(surface, name)
    lids = None
    if name == "procedural2020":
        lids = on_grid(np.stack([shapes[lid] for lid in LIDS], axis=-1), LENGTH_BITS).astype(np.float32)
    return HeadArrays(
        version=name,
        template=on_grid(surface.vertices, LENGTH_BITS).astype(np.float32),
        faces=surface.faces,
        shape_basis=on_grid(identity_basis(surface, _SEEDS[name]), LENGTH_BITS).astype(np.float32),
        expression_basis=on_grid(_expression_basis(shapes, name).directions, LENGTH_BITS).astype(np.float32),
        pose_basis=on_grid(pose_basis(surface), LENGTH_BITS).astype(np.float32),
        joint_regressor=on_grid(joint_regressor(surface), REGRESSOR_BITS).astype(np.float32),
        skinning_weights=on_grid(skinning_weights(surface), SHARE_BITS).astype(np.float32),
        parents=PARENTS.copy(),
        eyelid_basis=lids,
        regions=regions(surface),
        landmarks=landmarks(surface),
    )


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
    basis = _expression_basis(shapes, name)
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
    random = np.random.default_rng(_SEEDS[version])
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


def _expression_basis(shapes: dict[str, FloatArray], version: str) -> ExpressionBasis:
    kept = {name: field for name, field in shapes.items() if version != "procedural2020" or name not in LIDS}
    deviation = np.array([0.30 if name in LIDS else 0.35 for name in kept])
    return principal_basis(kept, deviation, _SEEDS[version])
