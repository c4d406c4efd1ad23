"""Fit a FLAME-like rig to a mesh that comes with blendshapes only: joints, hinge and skinning weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...bench.contracts import FloatArray, IntArray


class Hinge(NamedTuple):
    """A rotation about an axis parallel to x: the motion of a jaw that opens."""

    angle: float  # radians, positive opens (from +y towards +z)
    center: FloatArray  # (3,) a point of the axis, with x = 0

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) rotation."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])

    def displacement(self, points: FloatArray) -> FloatArray:
        """What the full motion adds at points (n, 3)."""
        return (points - self.center) @ (self.matrix - np.eye(3)).T


def fit_hinge(points: FloatArray, moved: FloatArray) -> Hinge:
    """Least-squares hinge that takes points to moved points, both (n, 3).

    Planar case of the orthogonal Procrustes problem (Schoenemann 1966); the centre is the fixed point of the
    fitted rigid motion of the y-z plane.

    Raises
    ------
    ValueError
        Where the points hardly turn, so that the motion has no centre.
    """
    plane, target = points[:, 1:], moved[:, 1:]
    middle, target_middle = plane.mean(0), target.mean(0)
    a, b = plane - middle, target - target_middle
    angle = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    if abs(angle) < 1e-3:
        raise ValueError(f"a motion of {angle:.2g} radians has no centre of rotation")
    turn = Hinge(angle, np.zeros(3)).matrix[1:, 1:]
    center = np.linalg.solve(np.eye(2) - turn, target_middle - turn @ middle)
    return Hinge(angle, np.array([0.0, *center]))


def hinge_weights(hinge: Hinge, points: FloatArray, displacement: FloatArray, softness: float) -> FloatArray:
    """Share of the hinge's motion that each point follows, in [0, 1].

    The least-squares factor of the rigid motion that explains the displacement; ``softness`` (metres) damps
    it where the rigid motion itself is small, near the axis, and the quotient says little.
    """
    rigid = hinge.displacement(points)
    share = (rigid * displacement).sum(1) / ((rigid**2).sum(1) + softness**2)
    return np.clip(share, 0.0, 1.0)


def hinge_correctives(
    hinge: Hinge, points: FloatArray, displacement: FloatArray, weights: FloatArray
) -> FloatArray:
    """(n, 3, 9) pose basis of the hinge's joint: what skinning leaves unexplained of the displacement.

    Added to the points before skinning, at the full angle it makes skinning end exactly at
    ``points + displacement``. It goes with the sine of the angle: half each in the two off-diagonal elements
    of R - I about x.
    """
    blended = weights[:, None, None] * (hinge.matrix - np.eye(3)) + np.eye(3)
    shift = weights[:, None] * (hinge.center - hinge.matrix @ hinge.center)
    wanted = np.linalg.solve(blended, (points + displacement - shift)[..., None])[..., 0] - points
    basis = np.zeros((len(points), 3, 9))
    basis[:, :, 7] = wanted / (2 * np.sin(hinge.angle))  # element (2, 1), +sine
    basis[:, :, 5] = -basis[:, :, 7]  # element (1, 2), -sine
    return basis


def regressor_row(vertices: FloatArray, support: IntArray, target: FloatArray) -> FloatArray:
    """(V,) weights on the support that sum to 1 and reproduce the target, as even as possible.

    The target then moves with the support in every translation, rotation and scaling of the mesh.

    Raises
    ------
    ValueError
        Where the support does not span the target.
    """
    constraints = np.vstack([vertices[support].T, np.ones(len(support))])
    even = np.full(len(support), 1 / len(support))
    wanted = np.array([*target, 1.0])
    weights = even + np.linalg.lstsq(constraints, wanted - constraints @ even, rcond=None)[0]
    if not np.allclose(constraints @ weights, wanted, atol=1e-6):
        raise ValueError("the support does not span the target")
    row = np.zeros(len(vertices))
    row[support] = weights
    return row

