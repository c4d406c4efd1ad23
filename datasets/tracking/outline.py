"""Outlines of the subject in images, and the outline of the mesh: distances between them, and a static offset that removes them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from ...bench.contracts import ByteArray, FloatArray, HeadAsset, IntArray
from ..head.geometry import mesh_edges, unique_pairs, vertex_normals
from .rig import MeshInViews

REGIONS = ("face", "ears", "scalp", "neck")
"""Regions whose outline is compared; the lower half of the neck is left out, since masks contain shoulders."""
ALIGNED = 0.7
"""Minimum cosine between the normals of corresponding points of both outlines."""
BORDER = 3.0  # points of a mask's outline nearer to the border of the image are left out, pixels
_SMOOTH = 1.5  # blur of masks before their normals are computed, pixels


class Outline(NamedTuple):
    """Outline of a mask."""

    pixels: FloatArray
    """(n, 2)."""
    normals: FloatArray
    """(n, 2) outward unit normals."""
    tree: cKDTree
    """Of the pixels, and of the normals times `REACH`."""


REACH = 8.0
"""Distance in pixels that counts as much as a difference of the normals of 1."""


def outline_of(mask: ByteArray) -> Outline | None:
    """The outline of the largest connected part of an (H, W) 8-bit mask, without its holes; None without one. It consists of
    several contours where borders of the image cut the part."""
    inside = mask > 127
    borders = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    part = np.zeros_like(mask)
    if borders:
        cv2.drawContours(part, [max(borders, key=cv2.contourArea)], -1, 255, cv2.FILLED)
    levels = np.where(inside == (part > 0), mask, part).astype(np.float32)
    contours = find_contours(levels, 127.5)
    if not contours:
        return None
    pixels = np.concatenate(contours)[:, ::-1] + 0.5
    size = np.array(mask.shape[::-1])
    pixels = pixels[((pixels > BORDER) & (pixels < size - BORDER)).all(axis=1)]
    blurred = cv2.GaussianBlur(levels, (0, 0), _SMOOTH)
    slopes = [
        cv2.Sobel(blurred, cv2.CV_32F, *axes)[*np.floor(pixels[:, ::-1]).astype(int).T]
        for axes in ((1, 0), (0, 1))
    ]
    normals = -np.stack(slopes, axis=1).astype(np.float64)
    length = np.linalg.norm(normals, axis=1)
    pixels, normals = pixels[length > 0], (normals / np.maximum(length, 1e-9)[:, None])[length > 0]
    if not len(pixels):
        return None
    return Outline(pixels, normals, cKDTree(np.concatenate([pixels, REACH * normals], axis=1)))


class OutlinePoints(NamedTuple):
    """Points of a posed mesh on its outline in a camera: n points on edges."""

    corners: IntArray
    """(n, 2) vertices of the edge."""
    weights: FloatArray
    """(n, 2) their shares."""


class MeshOutline:
    """Finds the outline of posed meshes of a head model. ``scalp``: Whether the scalp is compared."""

    def __init__(self, head: HeadAsset, scalp: bool):
        height = np.asarray(head.template)[:, 1]
        used = np.zeros(len(height), bool)
        for name in REGIONS:
            used[np.asarray(head.regions.get(name, ()), np.int64)] = True
        neck = np.asarray(head.regions.get("neck", ()), np.int64)
        low = neck[height[neck] < np.median(height[neck])] if len(neck) else neck
        left_out = ("boundary", "mouth_socket") if scalp else ("boundary", "mouth_socket", "scalp")
        for members in (low, *(head.regions.get(name, ()) for name in left_out)):
            used[np.asarray(members, np.int64)] = False
        edges = unique_pairs(np.sort(mesh_edges(np.asarray(head.faces)), axis=1))[0]
        self._edges = edges[used[edges].all(axis=1)]

    def points(self, surface: MeshInViews) -> list[OutlinePoints]:
        """Of a posed mesh, for each camera."""
        ends = surface.cosines(self._edges.ravel()).reshape(-1, *self._edges.shape)
        cameras, edges = np.nonzero((ends > 0).sum(axis=2) == 1)
        corners, shares = self._edges[edges], _zero(ends[cameras, edges])
        border = surface.at_border(np.einsum("nk,nki->ni", shares, surface.mesh[corners]))
        kept = border[cameras, np.arange(len(cameras))]
        return [
            OutlinePoints(corners[kept & (cameras == camera)], shares[kept & (cameras == camera)])
            for camera in range(len(ends))
        ]


def _zero(values: FloatArray) -> FloatArray:
    """(n, 2) shares of the ends of edges with which values (n, 2) of opposite signs become 0."""
    share = values[:, 1] / (values[:, 1] - values[:, 0])
    return np.stack([share, 1 - share], axis=1)


class Gaps(NamedTuple):
    """Distances of n points from an outline."""

    distance: FloatArray
    """(n,) signed distances along the outline's normals, pixels; positive where the outline is outside of the point."""
    normals: FloatArray
    """(n, 2) of the outline."""
    aligned: FloatArray
    """(n,) 1 where the outlines are about parallel, else 0."""


def gaps(outline: Outline, pixels: FloatArray, normals: FloatArray) -> Gaps:
    """Distances of points (n, 2) on an outline with normals (n, 2) from the nearest points of another one."""
    _, nearest = outline.tree.query(np.concatenate([pixels, REACH * normals], axis=1))
    towards = outline.normals[nearest]
    distance = ((outline.pixels[nearest] - pixels) * towards).sum(axis=1)
    return Gaps(distance, towards, ((towards * normals).sum(axis=1) > ALIGNED).astype(np.float64))


SPREADS = (("boundary", 10.0), ("neck", 10.0), ("face", 4.0), ("ears", 6.0), ("scalp", 30.0))
"""Standard deviation of the offset of a region, millimetres; 0 elsewhere, and at eyes, lips and mouth."""
FIXED = ("lips", "eye_region", "left_eyeball", "right_eyeball", "mouth_socket", "teeth")
SMOOTH_MM = 0.4
"""Standard deviation of the difference between the offset of a vertex and the mean of its neighbours."""
OFFSET_MM, OFFSET_ROBUST = 3.0, 8.0
"""Expected error of an outline, millimetres, and the multiple of it at which the weight of a point is a quarter."""
OFFSET_WEIGHT = 0.05
"""Weight of a point of an outline, since errors of neighbouring points and timesteps are correlated."""
_ITERATIONS = 4


def static_offset(
    head: HeadAsset, neutral: FloatArray, points: OutlinePoints, distances: FloatArray
) -> FloatArray:
    """(V, 3) offset along the normals of a neutral mesh (V, 3) that moves points on outlines by distances (n,), metres, as far
    as a smooth offset can."""
    count = len(neutral)
    spread = np.zeros(count)
    for name, value in SPREADS:
        spread[np.asarray(head.regions.get(name, ()), np.int64)] = 1e-3 * value
    for name in FIXED:
        spread[np.asarray(head.regions.get(name, ()), np.int64)] = 0
    free = np.flatnonzero(spread)
    edges = mesh_edges(np.asarray(head.faces))
    adjacency = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count)).tocsr()
    adjacency = adjacency + adjacency.T
    adjacency.data[:] = 1
    degree = np.maximum(np.asarray(adjacency.sum(axis=1)), 1)
    laplacian = (diags_array(np.ones(count)) - diags_array(1 / degree) @ adjacency).tocsr()[:, free]
    prior = laplacian.T @ laplacian / (1e-3 * SMOOTH_MM) ** 2 + diags_array(1 / spread[free] ** 2)
    rows = np.repeat(np.arange(len(distances)), 2)
    design = coo_array(
        (points.weights.ravel(), (rows, points.corners.ravel())), shape=(len(distances), count)
    ).tocsr()[:, free]
    moved = np.zeros(len(free))
    sigma = 1e-3 * OFFSET_MM
    for _ in range(_ITERATIONS):
        left = distances - design @ moved
        weight = OFFSET_WEIGHT / (sigma * (1 + (left / (OFFSET_ROBUST * sigma)) ** 2)) ** 2
        moved = spsolve(
            (design.T @ diags_array(weight) @ design + prior).tocsc(), design.T @ (weight * distances)
        )
    offset = np.zeros(count)
    offset[free] = moved
    return np.asarray(offset[:, None] * vertex_normals(neutral, np.asarray(head.faces)))
