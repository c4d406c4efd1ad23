"""From posed to canonical space by the frames of triangles: INSTA, section 3.2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset, IntArray

FALLOFF = 4.0  # per metre
OWN_FALLOFF_OF_CODE = 1.0
SCALE_LIMIT = 4.0  # a triangle that an extreme pose collapses must not throw its points out of the box
ALONE = -1.0

Compatibility = Literal["", "code"]


@dataclass(frozen=True, eq=False)
class Blend:
    """Whose transforms carry a point.

    Attributes
    ----------
    neighbours : (F, 3) int32 triangles across the edges, -1 at a border.
    own_falloff, neighbour_falloff : (F,) float32, per metre: weights exp(-falloff distance to the centroid). Where
        ``own_falloff`` is negative the nearest triangle's transform alone is taken.
    scaled : (F,) bool, whether the ratio of areas scales the transform.
    root : whether it is the root of that ratio.
    """

    neighbours: IntArray
    own_falloff: np.ndarray
    neighbour_falloff: np.ndarray
    scaled: np.ndarray
    root: bool

    @classmethod
    def of(cls, head: HeadAsset, compatibility: Compatibility) -> Blend:
        """The blend of a head, as the paper or as the authors' code has it."""
        faces = np.asarray(head.faces)
        count = len(faces)
        neighbours = edge_neighbours(faces)
        falloff = np.full(count, FALLOFF, np.float32)
        if not compatibility:
            return cls(neighbours, falloff, falloff, np.ones(count, bool), True)
        apart = touching(head, "lips") | touching(head, "left_ear") | touching(head, "right_ear")
        eyes = touching(head, "eye_region") & ~apart
        face = touching(head, "face") & ~apart & ~eyes
        own = np.where(face, OWN_FALLOFF_OF_CODE, ALONE).astype(np.float32)
        return cls(neighbours, own, falloff, eyes, False)


def touching(head: HeadAsset, region: str) -> np.ndarray:
    """(F,) bool: triangles with a vertex in a region; none where the head does not know the region."""
    inside = np.zeros(len(head.template), bool)
    inside[np.asarray(head.regions.get(region, ()), dtype=np.int64)] = True
    return np.asarray(inside[np.asarray(head.faces)].any(1))


def edge_neighbours(faces: IntArray) -> IntArray:
    """(F, 3) int32: the triangle across each edge (corners 0-1, 1-2, 2-0), -1 at a border.

    Where more than two triangles share an edge, each has the next of them in order as its neighbour.
    """
    faces = np.asarray(faces, dtype=np.int64)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort((np.arange(len(edges)), edges[:, 1], edges[:, 0]))
    ordered = edges[order]
    begins = np.ones(len(edges), bool)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(1)
    group = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    size = np.diff(np.append(first, len(edges)))[group]
    following = first[group] + (np.arange(len(edges)) - first[group] + 1) % size
    across = np.full(len(edges), -1, np.int64)
    across[order] = np.where(size > 1, order[following] // 3, -1)
    return across.reshape(-1, 3).astype(np.int32)


def triangle_bases(vertices: Tensor, faces: Tensor) -> Tensor:
    """(F, 3, 4) rigid frames: tangent, bitangent, normal and the first corner, as columns.

    The tangent is opposite to the first edge; a triangle without area has a frame of zeros with its corner.
    """
    corners = vertices.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    edge = corners[:, 1] - corners[:, 0]
    normal = _unit(torch.linalg.cross(edge, corners[:, 2] - corners[:, 0]))
    bitangent = _unit(torch.linalg.cross(edge, normal))
    tangent = torch.linalg.cross(bitangent, normal)
    return torch.stack([tangent, bitangent, normal, corners[:, 0]], dim=2)


def areas(vertices: Tensor, faces: Tensor) -> Tensor:
    """(F,) areas of triangles."""
    corners = vertices.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * torch.linalg.vector_norm(normal, dim=1)


def canonical_from_posed(canonical: Tensor, posed: Tensor, faces: Tensor, blend: Blend) -> Tensor:
    """(F, 3, 4) transforms that carry each posed triangle's surroundings to its canonical place.

    Parameters
    ----------
    canonical, posed : (V, 3) vertices, metres.
    """
    target, source = triangle_bases(canonical, faces), triangle_bases(posed, faces)
    ratio = areas(canonical, faces) / areas(posed, faces).clamp_min(1e-12)
    scale = (ratio.sqrt() if blend.root else ratio).clamp(1 / SCALE_LIMIT, SCALE_LIMIT)
    scale = torch.where(torch.as_tensor(blend.scaled, device=scale.device), scale, 1.0)
    turn = scale[:, None, None] * (target[:, :, :3] @ source[:, :, :3].mT)
    shift = target[:, :, 3:] - turn @ source[:, :, 3:]
    return torch.cat([turn, shift], dim=2)


def blended(points: Tensor, triangles: Tensor, matrices: Tensor, centroids: Tensor, blend: Blend) -> Tensor:
    """(N, 3, 4) transform of each point by its (N,) nearest triangle and that one's neighbours."""
    neighbours = torch.as_tensor(blend.neighbours, device=points.device).long()[triangles]
    own_falloff = torch.as_tensor(blend.own_falloff, device=points.device)[triangles].to(points)
    falloff = torch.as_tensor(blend.neighbour_falloff, device=points.device)[triangles].to(points)
    others = neighbours.clamp_min(0)
    away = torch.linalg.vector_norm(points[:, None] - centroids[others], dim=2)
    weights = torch.exp(-falloff[:, None] * away)
    weights = torch.where((neighbours >= 0) & (own_falloff >= 0)[:, None], weights, 0.0)
    away = torch.linalg.vector_norm(points - centroids[triangles], dim=1)
    own = torch.where(own_falloff >= 0, torch.exp(-own_falloff * away), 1.0)
    total = own + weights.sum(1)
    summed = own[:, None, None] * matrices[triangles]
    summed = summed + (weights[..., None, None] * matrices[others]).sum(1)
    return summed / total[:, None, None]


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-12)
