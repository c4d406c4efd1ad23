"""Fit of identity, jaw, eyes and eyelids to meshes of the head model, for parameters missing in a layout.

The meshes have FLAME's vertices, so this inverts a known function: for meshes with eight digits it recovers the
parameters to about 1e-6. The residual shows whether the head model is the one of the meshes.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers
from ...bench.io.files import read_bytes, reading
from ...bench.protocol import evenly_with_ends
from ..head.arrays import JOINT_NAMES, HeadArrays
from ..head.model import HeadModel

WORST_DISTANCE = 1e-4
"""Maximum median distance of vertices from the mesh, metres: rounding gives 1e-8, another head model of the same
topology 1e-3, and lids without a basis in the head model move fewer than half of the vertices."""

_VERTEX = re.compile(rb"^v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_TURNING = [JOINT_NAMES.index(name) for name in ("jaw", "left_eye", "right_eye")]
_STEP, _SMALL, _MOST_STEPS = 1e-6, 1e-9, 30
_TOGETHER = 32  # meshes posed at once
_ROWS = 200
"""Number of vertices used for each joint and lid, enough for rounding to eight digits."""


def read_vertices(path: Path, count: int) -> FloatArray:
    """(V, 3) vertices of a Wavefront OBJ; faces are not read, since programs simplify them without changing the
    vertices.

    Raises `InputError` for a file that is missing, or has another number of vertices than ``count``.
    """
    content = read_bytes(path, "a Wavefront OBJ")
    found = _VERTEX.findall(content)
    if len(found) != count:
        remedy = "Give the head model the video was tracked with."
        raise InputError(path, "v", f"{count} vertices, as the head model has", f"{len(found)}", remedy)
    with reading(path, "three numbers for each vertex", "v"):  # no array of the longest word
        vertices = np.array([[float(word) for word in vertex] for vertex in found])
    check_numbers(path, "v", vertices, MAX_MAGNITUDE)
    return vertices


class Identity(NamedTuple):
    """Result of `MeshFit.fit_identity`."""

    shape: FloatArray
    """(S,)"""
    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""


class Pose(NamedTuple):
    """Result of `MeshFit.fit_pose`."""

    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    lids: FloatArray
    """(2,) eyelids, left and right; (0,) where the head model has no basis for them."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""
    farthest: float
    """Largest distance of a vertex from the mesh, metres."""


class MeshFit:
    """Inverts a head model with root and neck at rest."""

    def __init__(self, head: HeadArrays) -> None:
        self._model = HeadModel(head, dtype=torch.float64)
        self._template = np.asarray(head.template, np.float64)
        self._shape_basis = np.asarray(head.shape_basis, np.float64)
        none = np.zeros((*self._template.shape, 0))
        self._lids = none if head.eyelid_basis is None else np.asarray(head.eyelid_basis, np.float64)
        weights = np.asarray(head.skinning_weights, np.float64)[:, _TURNING]
        parts = [*weights.T, *np.abs(self._lids).max(axis=1).T]
        strong = [np.flatnonzero(part > 0.1 * part.max(initial=0)) for part in parts]
        picked = [rows[evenly_with_ends(range(len(rows)), _ROWS)] for rows in strong]
        self._rows: IntArray = np.unique(np.concatenate(picked))

    def fit_identity(self, mesh: FloatArray) -> Identity:
        """Shape coefficients, jaw and eyes of a (V, 3) mesh without expression, by the Gauss-Newton method."""
        basis = np.moveaxis(self._shape_basis, 2, 0)
        size = len(basis)
        shape, turns = np.zeros(size), np.zeros(9)
        for _ in range(_MOST_STEPS):
            shaped = self._template + self._shape_basis @ shape
            posed, by_turn = self._linearised(shaped, turns)
            # For given rotations a posed mesh is linear in the mesh at rest, except for the correctives.
            still = self._posed(np.zeros_like(shaped)[None], turns[None])
            parts = np.array_split(basis, max(size // _TOGETHER, 1))
            by_shape = [self._posed(part, turns[None]) - still for part in parts]
            jacobian = np.concatenate([*by_shape, by_turn]).reshape(size + 9, -1)
            gram, right = jacobian @ jacobian.T, jacobian @ (mesh - posed).ravel()
            step = np.linalg.lstsq(gram, right, rcond=1e-13)[0]
            shape, turns = shape + step[:size], turns + step[size:]
            if np.abs(step).max() < _SMALL:
                break
        shaped = self._template + self._shape_basis @ shape
        return Identity(shape, turns, _middle(self._posed(shaped[None], turns[None])[0] - mesh))

    def fit_pose(self, mesh: FloatArray, shaped: FloatArray, known: FloatArray | None) -> Pose:
        """Jaw, eyes and eyelids of one mesh.

        Parameters
        ----------
        mesh : FloatArray
            (V, 3).
        shaped : FloatArray
            (V, 3) head with identity and expression, unposed.
        known : FloatArray | None
            (9,) jaw and eyes if they are known; only the eyelids are fitted then.
        """
        turns, lids = np.zeros(9) if known is None else known, np.zeros(self._lids.shape[2])
        rows = self._rows
        by_lids = self._lids[rows].reshape(3 * len(rows), -1)
        for _ in range(_MOST_STEPS):
            columns = [by_lids]
            if known is None:
                posed, by_turn = self._linearised(shaped, turns)
                columns.append(by_turn[:, rows].reshape(9, -1).T)
            else:
                posed = self._posed(shaped[None], turns[None])[0]
            left = (mesh - posed)[rows].ravel() - by_lids @ lids
            step = np.linalg.lstsq(np.hstack(columns), left, rcond=None)[0]
            lids = lids + step[: len(lids)]
            if known is None:
                turns = turns + step[len(lids) :]
            if np.abs(step).max(initial=0) < _SMALL:
                break
        left = mesh - self._posed(shaped[None], turns[None])[0] - self._lids @ lids
        return Pose(turns, lids, _middle(left), float(np.linalg.norm(left, axis=1).max()))

    def _linearised(self, shaped: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(V, 3) posed vertices and their (9, V, 3) derivatives by the turns, by forward differences."""
        posed = self._posed(shaped[None], turns + _STEP * np.eye(10, 9, -1))
        return posed[0], (posed[1:] - posed[0]) / _STEP

    @torch.no_grad()
    def _posed(self, shaped: FloatArray, turns: FloatArray) -> FloatArray:
        """(B, V, 3) vertices of (B or 1, V, 3) heads at rest with (B or 1, 9) turns of jaw and eyes."""
        moving, rest = torch.from_numpy(turns), torch.zeros(1, 3, dtype=torch.float64)
        still = dict.fromkeys(("rotation", "neck", "translation"), rest)
        expression = torch.zeros(1, self._model.expression_size, dtype=torch.float64)
        return self._model(
            **still,
            canonical=torch.from_numpy(shaped),
            expression=expression,
            jaw=moving[:, :3],
            eyes=moving[:, 3:],
        ).numpy()


def _middle(left: FloatArray) -> float:
    return float(np.median(np.linalg.norm(left, axis=1)))


def check_distance(file: Path, distance: float, version: str) -> None:
    """Raise `InputError` if a mesh is farther from the head than rounding explains."""
    if not distance <= WORST_DISTANCE:
        expected = (
            f"a mesh that head model {version} makes, its middle vertex within {1e3 * WORST_DISTANCE:g} mm"
        )
        remedy = (
            "Give the head model that the video was tracked with: Metrical Tracker's is FLAME 2020 "
            "(generic_model.pkl), whose coefficients are not those of FLAME 2023."
        )
        raise InputError(file, "v", expected, f"{1e3 * distance:.3g} mm", remedy)
