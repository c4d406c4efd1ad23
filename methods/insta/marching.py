"""The warp to canonical space by the nearest triangle, and samples of rays near the mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from ...bench.contracts import HeadAsset, HeadPose, IntArray
from ..shared.surface_points import SubjectMesh
from ..shared.threads import threads
from . import kernel
from .spec import InstaConfig

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
        separate = touching(head, "lips") | touching(head, "left_ear") | touching(head, "right_ear")
        eyes = touching(head, "eye_region") & ~separate
        face = touching(head, "face") & ~separate & ~eyes
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
    nearest = []
    for part in points.split(chunk):
        squared = squared_distances(part, corners)
        least = squared.min(1).values
        tied = squared <= least[:, None] * (1 + TIE) + TIE_FLOOR
        plane = ((part[:, None] - corners[None, :, 0]) * normals).sum(-1).abs()
        nearest.append((torch.where(tied, plane, -torch.ones_like(plane)).argmax(1), least))
    if not nearest:
        return Found(points.new_empty(0, dtype=torch.int64), points.new_empty(0))
    return Found(torch.cat([one for one, _ in nearest]), torch.cat([other for _, other in nearest]))


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


Backend = Literal["auto", "kernel", "reference"]
FREE_MAX = 255
STRETCH_MAX = 2.0
"""Factor on the search distance for density, for poses that stretch the mesh."""


class Rays(NamedTuple):
    """Rays as float32 numpy arrays. Sample k of ray r lies at ``(k + jitter[r]) * step`` metres from its origin."""

    origins: np.ndarray  # (R, 3)
    directions: np.ndarray  # (R, 3) unit length
    jitter: np.ndarray  # (R,) in [0, 1)

    def contiguous(self) -> Rays:
        """The same rays, in the layout that the kernel takes."""
        return Rays(*map(np.ascontiguousarray, self))


class Samples(NamedTuple):
    """Samples of rays near the surface, ray by ray in order of distance."""

    positions: np.ndarray  # (N, 3) float32, canonical metres
    directions: np.ndarray  # (N, 3) float32, canonical, unit length
    distances: np.ndarray  # (N,) float32 metres from the posed surface
    rays: np.ndarray  # (N,) int32
    indices: np.ndarray  # (N,) int32 numbers k of the samples
    triangles: np.ndarray  # (N,) int32
    next: np.ndarray  # (R,) int32, next k; -1 for a ray that has passed the surface


@dataclass(frozen=True, eq=False)
class Space:
    """Region where density may be non-zero."""

    reach: np.ndarray  # (F,) float32 canonical metres from each triangle; negative for nowhere
    low: np.ndarray  # (3,) float32 corner of the occupancy grid, canonical metres
    cell: float  # size of its cubic cells, metres
    free: (
        np.ndarray
    )  # (X, Y, Z) uint8, Chebyshev distance to the nearest occupied cell, in cells; 0 in occupied ones

    @classmethod
    def of(cls, reach: np.ndarray, low: np.ndarray, cell: float, occupied: np.ndarray) -> Space:
        """The space for an (X, Y, Z) bool array of occupied cells."""
        away = distance_transform_cdt(np.logical_not(occupied), metric="chessboard")
        # Without occupied cells there is no distance.
        free = np.where(away < 0, FREE_MAX, away.clip(0, FREE_MAX)).astype(np.uint8)
        return cls(reach, low, cell, free)

    @property
    def occupied(self) -> np.ndarray:
        """(X, Y, Z) bool."""
        return self.free == 0


class CanonicalSurface:
    """The canonical mesh of a subject, (V, 3) metres, and data shared by all its poses.

    Backend "kernel" is compiled, "reference" tests every triangle in torch; "auto" selects the kernel if it is
    installed.
    """

    def __init__(
        self, head: HeadAsset, canonical: Tensor, variant: Variant = "paper", backend: Backend = "auto"
    ):
        self.canonical = canonical.detach().cpu()
        self.faces = torch.tensor(np.asarray(head.faces, dtype=np.int64))
        self.blend = Blend.of(head, variant)
        self.module: Any = None if backend == "reference" else kernel.load()
        if backend == "kernel" and self.module is None:
            raise ValueError("backend 'kernel': not installed; 'reference' is")
        self.tree: Any = None
        if self.module is not None:
            faces = np.ascontiguousarray(head.faces, dtype=np.int32)
            self.tree = self.module.tree(faces, _array(self.canonical.float()))
        self.rest = self.pose(self.canonical)

    def pose(self, vertices: Tensor) -> PosedSurface:
        """The surface in one pose, (V, 3) vertices in metres."""
        return PosedSurface(self, vertices.detach().cpu())


class PosedSurface:
    """One pose of the surface."""

    def __init__(self, surface: CanonicalSurface, vertices: Tensor):
        self.surface, self.vertices = surface, vertices
        self.matrices = canonical_from_posed(surface.canonical, vertices, surface.faces, surface.blend)
        self.corners = vertices[surface.faces]
        self.centroids = self.corners.mean(1)
        self._mesh: Any = None
        self._guide: tuple[Space, Any] | None = None
        if surface.module is not None:
            self._mesh = surface.module.posed(surface.tree, _array(vertices.float()))

    @property
    def bytes(self) -> int:
        """Approximate memory: matrices, corners (twice in the kernel), boxes."""
        return 4 * (self.matrices.numel() + 4 * self.corners.numel())

    def nearest(self, points: np.ndarray) -> Found:
        """Nearest triangle of (N, 3) float32 points, and its squared distance."""
        points = np.ascontiguousarray(points, dtype=np.float32)
        if self._mesh is None:
            return nearest_triangles(torch.from_numpy(points), self.corners.float())
        triangles, squared = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
        self.surface.module.nearest(self._mesh, points, triangles, squared, threads())
        return Found(torch.from_numpy(triangles).long(), torch.from_numpy(squared))

    def first_hit(self, rays: Rays) -> Found:
        """First triangle of each ray and its distance, metres."""
        origins, directions, _ = rays.contiguous()
        if self._mesh is None:
            return first_hits(torch.from_numpy(origins), torch.from_numpy(directions), self.corners.float())
        triangles, distances = np.empty(len(origins), np.int32), np.empty(len(origins), np.float32)
        hits = triangles, distances
        self.surface.module.first_hit(self._mesh, origins, directions, *hits, threads())
        return Found(torch.from_numpy(triangles).long(), torch.from_numpy(distances))

    def march(self, rays: Rays, first: np.ndarray, step: float, samples_max: int, space: Space) -> Samples:
        """Samples of rays that may have density, at most ``samples_max`` of each ray.

        ``first`` has (R,) int32 numbers of the samples to start at; -1 for rays that are done.
        """
        if self._mesh is None:
            return self._march_reference(rays, first, step, samples_max, space)
        how = (rays.contiguous(), first, step, samples_max, threads())
        return Samples(*self.surface.module.march(self.guide(space), *how))

    def reach(self, space: Space) -> np.ndarray:
        """(F,) float32 maximum distance of density from each triangle of this pose, metres; negative for none."""
        return np.asarray(space.reach / self._shrinking, dtype=np.float32)

    @cached_property
    def _shrinking(self) -> np.ndarray:
        """(F,) canonical metres per metre of this pose around a triangle: the smallest scale blended there, at most 1."""
        scale = (torch.linalg.vector_norm(self.matrices[:, :, :3], dim=(1, 2)) / math.sqrt(3)).numpy()
        neighbours = self.surface.blend.neighbours
        across = np.where(neighbours >= 0, neighbours, np.arange(len(scale))[:, None])
        return np.asarray(np.minimum(scale, scale[across].min(1)).clip(1 / STRETCH_MAX, 1))

    def guide(self, space: Space) -> Any:
        """The kernel's data of this pose and a space; the last one is cached. Needs the kernel."""
        if self._guide is None or self._guide[0] is not space:
            blend = self.surface.blend
            posed = (self.reach(space), _array(self.matrices.float()), _array(self.centroids.float()))
            falloffs = (blend.own_falloff, blend.neighbour_falloff)
            grid = (space.low, 1 / space.cell, space.free)
            made = self.surface.module.Guide(self._mesh, (*posed, blend.neighbours, *falloffs, *grid))
            self._guide = space, made
        return self._guide[1]

    def _march_reference(
        self, rays: Rays, first: np.ndarray, step: float, samples_max: int, space: Space
    ) -> Samples:
        """Reference implementation of the kernel: tests every triangle for every sample that is not behind the mesh."""
        low, high = self.vertices.min(0).values.numpy(), self.vertices.max(0).values.numpy()
        reach = self.reach(space)
        padding = max(float(reach.max()), 0.0)
        farthest = np.linalg.norm(0.5 * (low + high) - rays.origins, axis=1).max(initial=0.0)
        farthest += 0.5 * np.linalg.norm(high - low) + padding
        lattice = np.arange(int(farthest / step) + 2)
        parts, following = [], np.full(len(first), -1, np.int32)
        for ray in np.flatnonzero(first >= 0):
            indices = lattice[first[ray] :]
            distances = ((indices + rays.jitter[ray]) * np.float32(step)).astype(np.float32)
            points = rays.origins[ray] + distances[:, None] * rays.directions[ray]
            close = ((points >= low - padding) & (points <= high + padding)).all(1)
            indices, points = indices[close], points[close]
            nearest = self.nearest(points)
            triangles = nearest.triangles.numpy()
            near = nearest.values.numpy() <= np.maximum(reach[triangles], 0) ** 2
            near &= reach[triangles] >= 0
            away = np.sqrt(nearest.values.numpy()[near])
            indices, points, triangles = indices[near], points[near], triangles[near]
            positions, directions = self.to_canonical(points, triangles, rays.directions[ray])
            kept = np.flatnonzero(occupied_at(space, positions))
            if len(kept) > samples_max:
                following[ray] = indices[kept[samples_max]]
                kept = kept[:samples_max]
            owner = np.full(len(positions), ray)
            columns = (positions, directions, away, owner, indices, triangles)
            parts.append(tuple(column[kept] for column in columns))
        if not parts:
            parts = [(np.empty((0, 3)), np.empty((0, 3)), *[np.empty(0)] * 4)]
        kinds = [np.float32] * 3 + [np.int32] * 3
        joined = [np.concatenate(column).astype(kind) for column, kind in zip(zip(*parts), kinds)]
        return Samples._make([*joined, following])

    def to_canonical(
        self, points: np.ndarray, triangles: np.ndarray, direction: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Canonical positions of (N, 3) points by their nearest triangles, and of one direction at each of them."""
        own = torch.tensor(np.asarray(points)).to(self.matrices)
        matrices = blended(
            own, torch.from_numpy(triangles).long(), self.matrices, self.centroids, self.surface.blend
        )
        positions = (matrices[:, :, :3] @ own[:, :, None])[:, :, 0] + matrices[:, :, 3]
        turned = matrices[:, :, :3] @ torch.tensor(np.asarray(direction)).to(own)
        return positions.numpy(), torch.nn.functional.normalize(turned, dim=1).numpy()


def occupied_at(space: Space, positions: np.ndarray) -> np.ndarray:
    """(N,) bool: whether canonical positions lie in an occupied cell."""
    size = np.array(space.free.shape)
    cells = np.floor((positions - space.low) * np.float32(1 / space.cell)).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(1)
    x, y, z = np.clip(cells, 0, size - 1).T
    return inside & (space.free[x, y, z] == 0)


def _array(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.numpy())


@torch.no_grad()
def canonical_surface(head: HeadAsset, mesh: SubjectMesh, config: InstaConfig) -> CanonicalSurface:
    """The canonical surface of a subject; ``mesh`` is on the CPU."""
    still, jaw = np.zeros(3), np.array([config.jaw_opening, 0, 0])
    pose = HeadPose(mesh.version, np.zeros(mesh.model.expression_size), still, still, jaw, np.zeros(6), still)
    vertices = mesh.posed(mesh.arguments([pose]))
    return CanonicalSurface(head, vertices, config.warp_variant)
