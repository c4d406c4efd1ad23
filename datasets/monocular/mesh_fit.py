"""Identity, jaw, eyes and eyelids from meshes that the head model made: what a layout leaves out of its parameters.

The meshes are FLAME's own, vertex by vertex, so that this is the inversion of a known function and no tracking: on
meshes written with eight digits it gives back the parameters to about 1e-6. What remains says whether the head model is
the one that the meshes were made with.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers
from ...bench.io.files import read_bytes, reading
from ..head.arrays import JOINT_NAMES, HeadArrays

MAX_BYTES = 2**26
"""Of a mesh; FLAME's takes 0.6 MB."""
WORST_DISTANCE = 1e-4
"""Metres that the middle vertex may lie from the mesh: rounding leaves 1e-8, another head model of the same topology
1e-3, and lids that the head model has no basis for move fewer than half of the vertices."""

_VERTEX = re.compile(rb"^v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_TURNING = [JOINT_NAMES.index(name) for name in ("jaw", "left_eye", "right_eye")]
_STEP, _SMALL, _MOST_STEPS = 1e-6, 1e-9, 30
_ROWS = 200
"""Vertices of each joint and lid that decide; rounding to eight digits needs no more."""


def read_vertices(path: Path, count: int) -> FloatArray:
    """(V, 3) vertices of a Wavefront OBJ; faces are not read, since programs simplify them and keep the vertices.

    Raises `InputError` for a file that is missing, or has another number of vertices than ``count``.
    """
    content = read_bytes(path, "a Wavefront OBJ", MAX_BYTES)
    found = _VERTEX.findall(content)
    if len(found) != count:
        remedy = "Give the head model the video was tracked with."
        raise InputError(path, "v", f"{count} vertices, as the head model has", f"{len(found)}", remedy)
    with reading(path, "three numbers for each vertex", "v"):  # no array of the longest word
        vertices = np.array([[float(word) for word in vertex] for vertex in found])
    check_numbers(path, "v", vertices, MAX_MAGNITUDE)
    return vertices


class Identity(NamedTuple):
    """What `MeshFit.fit_identity` finds."""

    shape: FloatArray
    """(S,)"""
    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""


class Pose(NamedTuple):
    """What `MeshFit.fit_pose` finds."""

    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    lids: FloatArray
    """(2,) eyelids, left and right; (0,) where the head model has no basis for them."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""
    farthest: float
    """Largest distance of a vertex from the mesh, metres."""


class MeshFit:
    """Inverts a head model whose root and neck are at rest."""

    def __init__(self, head: HeadArrays) -> None:
        self._template = np.asarray(head.template, np.float64)
        self._shape_basis = np.asarray(head.shape_basis, np.float64)
        self._weights = np.asarray(head.skinning_weights, np.float64)[:, _TURNING]
        pose = np.asarray(head.pose_basis, np.float64)
        # Columns 9(j-1) and on are joint j's.
        self._correctives = np.stack([pose[:, :, 9 * (j - 1) : 9 * j] for j in _TURNING])
        self._regressor = np.asarray(head.joint_regressor, np.float64)[_TURNING]
        none = np.zeros((*self._template.shape, 0))
        self._lids = none if head.eyelid_basis is None else np.asarray(head.eyelid_basis, np.float64)
        parts = [*self._weights.T, *np.abs(self._lids).max(axis=1).T]
        strong = [np.flatnonzero(part > 0.1 * part.max(initial=0)) for part in parts]
        picked = [rows[np.asarray(spread(_ROWS, len(rows)), np.int64)] for rows in strong]
        self._rows: IntArray = np.unique(np.concatenate(picked))

    def fit_identity(self, mesh: FloatArray) -> Identity:
        """Shape coefficients, jaw and eyes of a (V, 3) mesh without expression, by Gauss and Newton's method."""
        basis = self._shape_basis
        vertices, _, size = basis.shape
        shape, turns = np.zeros(size), np.zeros(9)
        moved = np.tensordot(self._regressor, basis, 1)  # (3, 3, S): how joints follow the shape
        for _ in range(_MOST_STEPS):
            shaped = self._template + basis @ shape
            posed = self._posed(shaped, turns)
            matrices = Rotation.from_rotvec(turns.reshape(3, 3)).as_matrix() - np.eye(3)
            skin = np.eye(3) + np.einsum("vj,jab->vab", self._weights, matrices)
            by_shape = np.matmul(skin, basis) - np.tensordot(self._weights, matrices @ moved, 1)
            by_turn = self._derivatives(shaped, turns, posed)
            jacobian = np.concatenate([by_shape, by_turn], axis=2).reshape(3 * vertices, -1)
            gram, right = jacobian.T @ jacobian, jacobian.T @ (mesh - posed).ravel()
            step = np.linalg.lstsq(gram, right, rcond=1e-13)[0]
            shape, turns = shape + step[:size], turns + step[size:]
            if np.abs(step).max() < _SMALL:
                break
        left = self._posed(self._template + basis @ shape, turns) - mesh
        return Identity(shape, turns, _middle(left))

    def fit_pose(self, mesh: FloatArray, shaped: FloatArray, known: FloatArray | None) -> Pose:
        """Jaw, eyes and eyelids of one mesh.

        Parameters
        ----------
        mesh : (V, 3).
        shaped : (V, 3) head with identity and expression, unposed.
        known : (9,) jaw and eyes where they are known, so that the eyelids alone are fitted.
        """
        turns, lids = np.zeros(9) if known is None else known, np.zeros(self._lids.shape[2])
        joints, rows = self._regressor @ shaped, self._rows
        by_lids = self._lids[rows].reshape(3 * len(rows), -1)
        for _ in range(_MOST_STEPS):
            posed = self._posed(shaped, turns, rows, joints)
            columns = [by_lids]
            if known is None:
                columns.append(self._derivatives(shaped, turns, posed, rows, joints).reshape(-1, 9))
            left = (mesh[rows] - posed).ravel() - by_lids @ lids
            step = np.linalg.lstsq(np.hstack(columns), left, rcond=None)[0]
            lids = lids + step[: len(lids)]
            if known is None:
                turns = turns + step[len(lids) :]
            if np.abs(step).max(initial=0) < _SMALL:
                break
        left = mesh - self._posed(shaped, turns, None, joints) - self._lids @ lids
        return Pose(turns, lids, _middle(left), float(np.linalg.norm(left, axis=1).max()))

    def _posed(
        self,
        shaped: FloatArray,
        turns: FloatArray,
        rows: IntArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Vertices, all or ``rows``, by the formulae of `HeadModel`; ``joints`` saves regressing them."""
        pick = slice(None) if rows is None else rows
        matrices = Rotation.from_rotvec(turns.reshape(3, 3)).as_matrix() - np.eye(3)
        result = shaped[pick]
        for correctives, matrix in zip(self._correctives, matrices):
            result = result + correctives[pick] @ matrix.ravel()
        corrected = result
        for weight, matrix, joint in zip(
            self._weights[pick].T, matrices, self._regressor @ shaped if joints is None else joints
        ):
            result = result + weight[:, None] * ((corrected - joint) @ matrix.T)
        return result

    def _derivatives(
        self,
        shaped: FloatArray,
        turns: FloatArray,
        posed: FloatArray,
        rows: IntArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """(N, 3, 9) derivatives of the posed vertices by the turns, by forward differences."""
        columns = [
            (self._posed(shaped, turns + _STEP * one, rows, joints) - posed) / _STEP for one in np.eye(9)
        ]
        return np.stack(columns, axis=2)


def _middle(left: FloatArray) -> float:
    return float(np.median(np.linalg.norm(left, axis=1)))


def check_distance(file: Path, distance: float, version: str) -> None:
    """Raise `InputError` where a mesh lies further from the head than rounding explains."""
    if not distance <= WORST_DISTANCE:
        expected = (
            f"a mesh that head model {version} makes, its middle vertex within {1e3 * WORST_DISTANCE:g} mm"
        )
        remedy = (
            "Give the head model that the video was tracked with: Metrical Tracker's is FLAME 2020 "
            "(generic_model.pkl), whose coefficients are not those of FLAME 2023."
        )
        raise InputError(file, "v", expected, f"{1e3 * distance:.3g} mm", remedy)


def spread(count: int, of: int) -> Sequence[int]:
    """``count`` indices spread evenly over ``of``."""
    return sorted({round(i * (of - 1) / max(count - 1, 1)) for i in range(min(count, of))})
