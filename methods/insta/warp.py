"""From posed to canonical space by the frames of triangles: INSTA, section 3.2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset, IntArray

FALLOFF = 4.0  # per metre
OFFICIAL_OWN_FALLOFF = 1.0
SCALE_LIMIT = 4.0  # limits points at triangles that an extreme pose collapses
ALONE = -1.0

Variant = Literal["paper", "official"]


@dataclass(frozen=True, eq=False)
class Blend:
    """Triangles whose transforms are blended at a point, with weights exp(-falloff distance to the centroid)."""

    neighbours: IntArray  # (F, 3) int32 triangles across the edges, -1 at a border
    own_falloff: np.ndarray  # (F,) float32 per metre; negative: the nearest triangle's transform alone
    neighbour_falloff: np.ndarray  # (F,) float32 per metre
    scaled: np.ndarray  # (F,) bool, whether the ratio of areas scales the transform
    root: bool  # whether the scale is the square root of that ratio

    @classmethod
    def of(cls, head: HeadAsset, variant: Variant) -> Blend:
        """The blend of a head, according to the paper or to the authors' code."""
        faces = np.asarray(head.faces)
        count = len(faces)
        neighbours = edge_neighbours(faces)
        falloff = np.full(count, FALLOFF, np.float32)
        if variant == "paper":
            return cls(neighbours, falloff, falloff, np.ones(count, bool), True)
        apart = touching(head, "lips") | touching(head, "left_ear") | touching(head, "right_ear")
        eyes = touching(head, "eye_region") & ~apart
        face = touching(head, "face") & ~apart & ~eyes
        own = np.where(face, OFFICIAL_OWN_FALLOFF, ALONE).astype(np.float32)
        return cls(neighbours, own, falloff, eyes, False)


def touching(head: HeadAsset, region: str) -> np.ndarray:
    """(F,) bool: triangles with a vertex in a region; none if the head lacks the region."""
    inside = np.zeros(len(head.template), bool)
    inside[np.asarray(head.regions.get(region, ()), dtype=np.int64)] = True
    return np.asarray(inside[np.asarray(head.faces)].any(1))


def edge_neighbours(faces: IntArray) -> IntArray:
    """(F, 3) int32: the triangle across each edge (corners 0-1, 1-2, 2-0), -1 at a border.

    If more than two triangles share an edge, the neighbour of each is the next one in order.
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
    """(F, 3, 4) transforms from the surroundings of each posed triangle to canonical space; (V, 3) metres."""
    target, source = triangle_bases(canonical, faces), triangle_bases(posed, faces)
    ratio = areas(canonical, faces) / areas(posed, faces).clamp_min(1e-12)
    scale = (ratio.sqrt() if blend.root else ratio).clamp(1 / SCALE_LIMIT, SCALE_LIMIT)
    scale = torch.where(torch.as_tensor(blend.scaled, device=scale.device), scale, 1.0)
    turn = scale[:, None, None] * (target[:, :, :3] @ source[:, :, :3].mT)
    shift = target[:, :, 3:] - turn @ source[:, :, 3:]
    return torch.cat([turn, shift], dim=2)


def blended(points: Tensor, triangles: Tensor, matrices: Tensor, centroids: Tensor, blend: Blend) -> Tensor:
    """(N, 3, 4) transform of each point, blended over its (N,) nearest triangle and the neighbours of that triangle."""
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


PAIRS_AT_ONCE = 1 << 22
TIE, TIE_FLOOR = 2e-6, 1e-16  # squared distances within this are equal


class Found(NamedTuple):
    """(N,) int64 triangles, -1 for none, and (N,) squared distances or distances along rays; infinite for none."""

    triangles: Tensor
    values: Tensor


def nearest_triangles(points: Tensor, corners: Tensor) -> Found:
    """Nearest of (F, 3, 3) triangles to each of (N, 3) points, with its squared distance.

    Of equally near triangles (a shared edge or corner) the one whose plane is farthest is selected, which divides the
    space around a convex edge along its bisector.
    """
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1, eps=torch.finfo(normals.dtype).tiny)
    chunk = max(1, PAIRS_AT_ONCE // max(len(corners), 1))
    found = []
    for part in points.split(chunk):
        squared = squared_distances(part, corners)
        least = squared.min(1).values
        tied = squared <= least[:, None] * (1 + TIE) + TIE_FLOOR
        plane = ((part[:, None] - corners[None, :, 0]) * normals).sum(-1).abs()
        found.append((torch.where(tied, plane, -torch.ones_like(plane)).argmax(1), least))
    if not found:
        return Found(points.new_empty(0, dtype=torch.int64), points.new_empty(0))
    return Found(torch.cat([one for one, _ in found]), torch.cat([other for _, other in found]))


def squared_distances(points: Tensor, corners: Tensor) -> Tensor:
    """(N, F) squared distances of points to triangles: to the plane where the foot lies inside, else to an edge."""
    p = points[:, None]
    a, b, c = corners[None].unbind(2)
    squared = torch.minimum(torch.minimum(_to_segment(p, a, b), _to_segment(p, b, c)), _to_segment(p, c, a))
    normal = torch.linalg.cross(b - a, c - a)
    area = (normal * normal).sum(-1)
    over = torch.ones_like(squared, dtype=torch.bool)
    for start, end in ((a, b), (b, c), (c, a)):
        over &= (torch.linalg.cross((end - start).expand_as(p - start), p - start) * normal).sum(-1) >= 0
    height = ((p - a) * normal).sum(-1)
    plane = height * height / area.clamp_min(torch.finfo(area.dtype).tiny)
    return torch.where(over & (area > 0), torch.minimum(plane, squared), squared)


def first_hits(origins: Tensor, directions: Tensor, corners: Tensor) -> Found:
    """First triangle hit by each ray at a distance above 0, from either side (Moeller and Trumbore, 1997)."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    triangles = torch.full((len(origins),), -1, dtype=torch.int64, device=origins.device)
    values = torch.full((len(origins),), torch.inf, dtype=origins.dtype, device=origins.device)
    chunk = max(1, PAIRS_AT_ONCE // max(len(corners), 1))
    for start in range(0, len(origins), chunk):
        rows = slice(start, start + chunk)
        d = directions[rows, None].expand(-1, len(corners), 3)
        across = torch.linalg.cross(d, ac.expand_as(d))
        determinant = (ab * across).sum(-1)
        inverse = torch.where(determinant == 0, torch.nan, 1 / determinant)
        from_a = origins[rows, None] - corners[:, 0]
        u = (from_a * across).sum(-1) * inverse
        q = torch.linalg.cross(from_a, ab.expand_as(from_a))
        v, distance = (d * q).sum(-1) * inverse, (ac * q).sum(-1) * inverse
        hit = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (distance > 0)
        least, which = torch.where(hit, distance, torch.inf).min(1)
        values[rows] = least
        triangles[rows] = torch.where(least.isfinite(), which, -1)
    return Found(triangles, values)


def _to_segment(p: Tensor, start: Tensor, end: Tensor) -> Tensor:
    along = end - start
    length = (along * along).sum(-1)
    part = ((p - start) * along).sum(-1) / length.clamp_min(torch.finfo(length.dtype).tiny)
    way = p - start - part.clamp(0, 1)[..., None] * along
    return (way * way).sum(-1)


MOUTH = ("lips", "teeth", "mouth_socket")
HAIR = ("hair", "scalp", "boundary")


def mouth_triangles(head: HeadAsset) -> Tensor:
    """(F,) bool: lips and the inside of the mouth."""
    return torch.from_numpy(np.logical_or.reduce([touching(head, region) for region in MOUTH]))


def bare_triangles(head: HeadAsset) -> Tensor:
    """(F,) bool: triangles that are the visible surface, without hair, neck and boundary."""
    hair = np.logical_or.reduce([touching(head, region) for region in HAIR])
    return torch.from_numpy(~hair | touching(head, "face"))
