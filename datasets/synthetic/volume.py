"""Static offset of hair, beard and sagging skin, like that of a tracker with vertex offsets such as VHAP.

VHAP fits one offset a vertex to all frames under a Laplacian penalty: the hair's volume without its locks. Here it is a part of
the mean thickness of hair over the head model's own vertices, smoothed over its edges.
"""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ..head.geometry import mesh_edges, vertex_normals
from ..rounding import LENGTH_BITS, on_grid
from .anatomy import Anatomy, Person
from .hair import STYLES, ear_share, hair_share
from .skin import beard_share, sagging

FOUND = 0.8
"""Fraction of the thickness in the offset, which penalties reduce."""
_ROUNDS = 6  # of averaging over neighbours
_LOCKS = 0.6  # mean height of locks over the cap, as a part of their rise
_BEARD = 0.35  # mean thickness of a beard, as a part of its length


def tracked_volume(person: Person, anatomy: Anatomy, head: HeadAsset, neutral: FloatArray) -> FloatArray:
    """(V, 3) offsets, metres, of a subject's neutral vertices (V, 3); 0 without skin. Joints do not move."""
    s, style = anatomy.scale, STYLES[person.style]
    named = np.zeros(len(neutral))
    for ear in ("left_ear", "right_ear"):
        named[head.regions.get(ear, [])] = 1.0
    thickness = (
        (style.cap + _LOCKS * style.rise)
        * s
        * hair_share(person, anatomy, neutral, ear_share(anatomy, neutral, named))
    )
    thickness = thickness + _BEARD * person.beard * s * beard_share(person, anatomy, neutral)
    thickness = thickness + sagging(person, anatomy, neutral)
    skin = np.zeros(len(neutral), bool)
    skin[anatomy.skin_faces] = True
    offset = FOUND * np.where(skin, thickness, 0.0)[:, None] * vertex_normals(neutral, anatomy.skin_faces)
    return without_joints(head, smoothed(offset, anatomy.skin_faces, _ROUNDS) * skin[:, None])


def smoothed(values: FloatArray, faces: IntArray, rounds: int) -> FloatArray:
    """(V, n) values at vertices, averaged ``rounds`` times with those of their neighbours."""
    edges = mesh_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    around = np.bincount(both[:, 0], minlength=len(values))
    for _ in range(rounds):
        mean = [np.bincount(both[:, 0], column[both[:, 1]], len(values)) for column in values.T]
        values = 0.5 * (values + np.stack(mean, axis=1) / np.maximum(around, 1)[:, None])
    return values


def without_joints(head: HeadAsset, offset: FloatArray) -> FloatArray:
    """(V, 3) offsets with the least change that leaves the joints, which are regressed from these vertices, in place."""
    regressor = np.asarray(head.joint_regressor, np.float64)
    return on_grid(offset - np.linalg.pinv(regressor) @ (regressor @ offset), LENGTH_BITS)
