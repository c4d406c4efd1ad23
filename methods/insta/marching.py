"""Samples of rays near the mesh, and their positions in canonical space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from ...bench.contracts import HeadAsset, HeadPose
from ..shared.subject_mesh import SubjectMesh
from ..shared.threads import threads
from . import kernel
from .config import InstaConfig
from .warp import Blend, Found, Variant, blended, canonical_from_posed, first_hits, nearest_triangles

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
        found = triangles, distances
        self.surface.module.first_hit(self._mesh, origins, directions, *found, threads())
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
            found = self.nearest(points)
            triangles = found.triangles.numpy()
            near = found.values.numpy() <= np.maximum(reach[triangles], 0) ** 2
            near &= reach[triangles] >= 0
            away = np.sqrt(found.values.numpy()[near])
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
