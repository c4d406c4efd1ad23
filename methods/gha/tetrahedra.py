"""A grid of tetrahedra, and the surface in it where a signed distance changes sign (marching tetrahedra).

The surface is differentiable in the distances: Shen et al., "Deep Marching Tetrahedra", NeurIPS 2021, section 3.1.2.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Edges of a tetrahedron, by its corners."""


class TetGrid(NamedTuple):
    """Tetrahedra that fill a box.

    Attributes
    ----------
    vertices : (V, 3).
    tets : (T, 4) int64, of positive volume: det[v1 - v0, v2 - v0, v3 - v0] > 0.
    spacing : edge length of the cubic cells.
    """

    vertices: Tensor
    tets: Tensor
    spacing: float


class Crossings(NamedTuple):
    """The zero surface as places on edges; whatever the grid's vertices carry can be interpolated to it.

    Attributes
    ----------
    ends : (K, 2) int64 vertices of the grid, one edge per surface vertex.
    weights : (K,) of the second end, in [0, 1]; differentiable in the distances.
    faces : (F, 3) int64, counter-clockwise seen from where the distance is positive.
    """

    ends: Tensor
    weights: Tensor
    faces: Tensor

    def interpolate(self, values: Tensor) -> Tensor:
        """(K, C) values at the surface of (V, C) values at the grid's vertices."""
        first, second = values.index_select(0, self.ends[:, 0]), values.index_select(0, self.ends[:, 1])
        return first + self.weights[:, None] * (second - first)


def tet_grid(low: np.ndarray, high: np.ndarray, spacing: float, device: str = "cpu") -> TetGrid:
    """Fill a box with the tetrahedra of a body-centred cubic lattice.

    Inside, all are congruent, and their edges differ by a factor of 1.15 only, which makes the surface nearly as good
    as the grid is fine. At the box's sides pyramids are cut in two.

    Parameters
    ----------
    low, high : (3,) corners; the box grows at ``high`` to whole cells.
    spacing : edge length of the cubic cells.
    """
    cells = np.maximum(np.ceil((np.asarray(high) - low) / spacing - 1e-9), 1).astype(np.int64)
    corner_shape, total = cells + 1, int(np.prod(cells + 1))
    corners = np.stack(np.meshgrid(*(np.arange(n) for n in corner_shape), indexing="ij"), -1).reshape(-1, 3)
    centers = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), -1).reshape(-1, 3)
    vertices = np.asarray(low) + spacing * np.concatenate([corners, centers + 0.5])

    def corner_index(place: np.ndarray) -> np.ndarray:
        return np.ravel_multi_index(place.T, tuple(corner_shape))

    def center_index(place: np.ndarray) -> np.ndarray:
        return total + np.ravel_multi_index(place.T, tuple(cells))

    tets = []
    for axis in range(3):
        step, u, v = np.roll(np.eye(3, dtype=np.int64), axis, axis=1)
        for side, outward in ((0, -step), (1, step)):
            # The face of each cell towards `outward`, its corners in a cycle.
            cycle = [
                corner_index(centers + side * step + a * u + b * v)
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
            ]
            own, inside = (
                center_index(centers),
                np.all((centers + outward >= 0) & (centers + outward < cells), 1),
            )
            border = ~inside
            tets += [
                np.stack([own, *(cycle[k] for k in corner)], 1)[border] for corner in ((0, 1, 2), (0, 2, 3))
            ]
            if side == 1:
                other = center_index((centers + outward)[inside])
                for k in range(4):
                    pair = (own[inside], other, cycle[k][inside], cycle[(k + 1) % 4][inside])
                    tets.append(np.stack(pair, 1))
    joined = np.concatenate(tets)
    edges = vertices[joined[:, 1:]] - vertices[joined[:, :1]]
    turned = np.linalg.det(edges) < 0
    joined[turned, 2:] = joined[turned, :1:-1]
    return TetGrid(
        torch.as_tensor(vertices, dtype=torch.float32, device=device),
        torch.as_tensor(joined, device=device),
        float(spacing),
    )


def spacing_for(low: np.ndarray, high: np.ndarray, count: int) -> float:
    """Spacing at which a box holds about ``count`` vertices: two to a cell."""
    return float((2 * np.prod(np.asarray(high, np.float64) - low) / count) ** (1 / 3))


def marching_tetrahedra(distance: Tensor, tets: Tensor) -> Crossings:
    """The surface where a distance given at the vertices is zero, linear between them.

    Parameters
    ----------
    distance : (V,), positive outside.
    tets : (T, 4) int64, of positive volume.

    Returns
    -------
    `Crossings`; empty where nothing changes sign. A closed surface inside the grid is watertight: faces share the
    vertices of common edges.
    """
    inside = distance.detach() < 0
    codes = (inside[tets].to(torch.int64) << torch.arange(4, device=tets.device)).sum(1)
    table, counts = (part.to(tets.device) for part in _cases())
    crossed = counts[codes] > 0
    tets, codes = tets[crossed], codes[crossed]
    pairs = tets[:, torch.tensor(EDGES, device=tets.device)].sort(dim=2).values  # (T, 6, 2)
    keys = pairs[..., 0] * len(distance) + pairs[..., 1]
    wanted = []
    for face in range(2):
        rows = (counts[codes] > face).nonzero().squeeze(1)
        wanted.append(keys[rows].gather(1, table[codes[rows], face]))
    edges, faces = torch.unique(torch.cat(wanted), return_inverse=True)
    ends = torch.stack([edges // len(distance), edges % len(distance)], dim=1)
    first, second = distance.index_select(0, ends[:, 0]), distance.index_select(0, ends[:, 1])
    return Crossings(ends, first / (first - second), faces)


@lru_cache(maxsize=1)
def _cases() -> tuple[Tensor, Tensor]:
    """(16, 2, 3) edges of the triangles of each case and (16,) their number; bit k says that corner k is inside.

    Each polygon is laid through the middles of its edges in a tetrahedron of positive volume and turned so that its
    normal points away from the corners inside.
    """
    place = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
    table, counts = np.zeros((16, 2, 3), np.int64), np.zeros(16, np.int64)
    for case in range(1, 15):
        inside = [k for k in range(4) if case >> k & 1]
        outside = [k for k in range(4) if k not in inside]
        # Around the polygon, neighbours share a face of the tetrahedron.
        pairs = list(product(inside, outside))
        if len(pairs) == 4:
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        ring = [EDGES.index((min(pair), max(pair))) for pair in pairs]
        middle = [0.5 * (place[EDGES[edge][0]] + place[EDGES[edge][1]]) for edge in ring]
        normal = np.cross(middle[1] - middle[0], middle[2] - middle[0])
        if normal @ (place[outside].mean(0) - place[inside].mean(0)) < 0:
            ring.reverse()
        counts[case] = len(ring) - 2
        for face in range(counts[case]):
            table[case, face] = ring[0], ring[face + 1], ring[face + 2]
    return torch.from_numpy(table), torch.from_numpy(counts)
