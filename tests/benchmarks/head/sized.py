"""The embedded head with bases of any size, for measurements: as large as a licensed model's, licensed by nobody."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ....bench.contracts import FloatArray
from ....datasets.head.arrays import HeadArrays
from ....datasets.head.procedural.model import procedural_head

FLAME_SIZES = (300, 100)
"""Identity and expression directions of FLAME."""

_WAVES = 3
_COARSE, _FINE = 20.0, 160.0  # radians per metre: bumps from the size of a cheek to that of a lip
_IDENTITY, _EXPRESSION = 0.004, 0.003  # metres: root mean square of the first direction
_CORRECTIVE = 0.002  # metres per unit entry of R - I


def sized_head(version: str, shape_size: int, expression_size: int) -> HeadArrays:
    """The procedural head's surface and rig with smooth random bases, dense as those of a scanned model.

    Directions are sums of plane waves, later ones finer and smaller; expressions act where the procedural head's
    do. All 36 pose correctives act. Versions differ in their bases alone.

    Parameters
    ----------
    version : of the procedural head, "2020" or "2023"; seeds the bases too.
    shape_size, expression_size : how many directions.
    """
    head = procedural_head(version)
    rng = np.random.default_rng([int(version[-4:]), shape_size, expression_size])
    points = np.asarray(head.template, dtype=np.float64)
    mobility = np.linalg.norm(head.expression_basis.reshape(len(points), -1), axis=1)
    mobility = np.sqrt(mobility / mobility.max())
    eyeballs = np.concatenate([head.regions["left_eyeball"], head.regions["right_eyeball"]])
    identity = _IDENTITY * _waves(points, shape_size, rng)
    identity[eyeballs] = identity[eyeballs].mean(axis=0)
    return replace(
        head,
        version=f"{head.version}-{shape_size}-{expression_size}",
        shape_basis=identity.astype(np.float32),
        expression_basis=(
            _EXPRESSION * mobility[:, None, None] * _waves(points, expression_size, rng)
        ).astype(np.float32),
        pose_basis=(
            _CORRECTIVE * mobility[:, None, None] * _waves(points, head.pose_basis.shape[2], rng)
        ).astype(np.float32),
    )


def _waves(points: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(V, 3, count) smooth fields, the first ones of unit root mean square, falling with the index."""
    fineness = np.geomspace(_COARSE, _FINE, count)
    axes = rng.normal(size=(3, _WAVES * 3 * count))
    axes /= np.linalg.norm(axes, axis=0)
    phases = points @ axes * np.repeat(fineness, 3 * _WAVES) + rng.uniform(0, 2 * np.pi, axes.shape[1])
    fields = np.sin(phases).reshape(len(points), count, 3, _WAVES).sum(axis=3)
    fields /= np.sqrt(np.square(fields).mean(axis=(0, 2), keepdims=True))
    return (fields / np.sqrt(1 + np.arange(count))[:, None]).transpose(0, 2, 1)
