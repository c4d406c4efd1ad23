"""The default head as a model in FLAME's layout, in two versions with one topology and different bases."""

from __future__ import annotations

import functools

import numpy as np

from ..arrays import HeadArrays
from ..geometry import LENGTH_BITS, REGRESSOR_BITS, SHARE_BITS, on_grid
from .expressions import LIDS, identity_basis
from .surface import (
    PARENTS,
    joint_regressor,
    landmarks,
    load_sculpture,
    pose_basis,
    regions,
    skinning_weights,
)
from .versions import SEEDS, basis_of_version, full_version, version_shapes


@functools.cache
def procedural_head(version: str = "2023") -> HeadArrays:
    """The embedded default head, made once in a process.

    ``version``: "2023" ("procedural2023") or "2020" ("procedural2020"). Both have the same topology and template. In 2020
    two eyelid bases represent the blinks, and shapes and directions differ slightly.
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
        shape_basis=on_grid(identity_basis(surface, SEEDS[name]), LENGTH_BITS).astype(np.float32),
        expression_basis=on_grid(basis_of_version(shapes, name).directions, LENGTH_BITS).astype(np.float32),
        pose_basis=on_grid(pose_basis(surface), LENGTH_BITS).astype(np.float32),
        joint_regressor=on_grid(joint_regressor(surface), REGRESSOR_BITS).astype(np.float32),
        skinning_weights=on_grid(skinning_weights(surface), SHARE_BITS).astype(np.float32),
        parents=PARENTS.copy(),
        eyelid_basis=lids,
        regions=regions(surface),
        landmarks=landmarks(surface),
    )
