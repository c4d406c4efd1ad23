"""Nearest triangles and first hits by trying all of them: the definition that the kernel is held to.

Works in any floating-point type on any device.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

PAIRS_AT_ONCE = 1 << 22
TIE, TIE_FLOOR = 2e-6, 1e-16  # squared distances that differ by no more than this are equal


class Found(NamedTuple):
    """(N,) int64 triangles, -1 for none, and (N,) squared distances or distances along rays; infinite for none."""

    triangles: Tensor
    values: Tensor


def nearest_triangles(points: Tensor, corners: Tensor) -> Found:
    """Nearest of (F, 3, 3) triangles to each of (N, 3) points, with its squared distance.

    Of equally near ones (a shared edge or corner) that whose plane is farthest is taken, which parts the space
    around a convex edge along its bisector.
    """
    normals = _unit(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
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
    """First triangle that each ray hits at a distance above 0, from either side (Moeller and Trumbore, 1997)."""
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


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=torch.finfo(vectors.dtype).tiny)
