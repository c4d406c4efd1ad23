"""Occupied cells of canonical space, and their maximum distance from each triangle.

Instant NGP's grid (Mueller et al. 2022, appendix E.2), limited to the cells near the canonical mesh.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..shared.schedule import numpy_generator
from .config import InstaConfig
from .field import EncodedCube, Parameters, RadianceField
from .marching import CanonicalSurface, Space

CELLS_AT_ONCE = 1 << 16


class Occupancy:
    """A grid over the box around the canonical mesh and its shell.

    Only cells near the mesh (``candidates``) can be occupied; initially all of them are.
    """

    def __init__(self, surface: CanonicalSurface, config: InstaConfig):
        self._config, self._surface = config, surface
        vertices = surface.canonical.numpy().astype(np.float64)
        low, high = vertices.min(0) - config.shell_outside, vertices.max(0) + config.shell_outside
        self.cell = float((high - low).max() / config.occupancy_resolution)
        self.size = np.maximum(np.ceil((high - low) / self.cell - 1e-6).astype(int), 1)
        self.low = low.astype(np.float32)
        near = _cells_near(surface, self.low, self.cell, self.size, config)
        self.candidates, self.triangles, self._distances = near
        self._probes = _probes(surface, self.low, self.cell, self.size, self.candidates)
        self.values = np.full(len(self.candidates), np.inf, np.float32)
        self._rounds = _dilation_rounds(surface, self.cell)
        self._neighbours = surface.blend.neighbours

    def box(self, device: str) -> EncodedCube:
        """The cube covered by the encoding."""
        return EncodedCube(torch.from_numpy(self.low).to(device), float(self.cell * self.size.max()))

    @property
    def occupied(self) -> np.ndarray:
        """(N,) bool by candidate."""
        finite = self.values[np.isfinite(self.values)]
        mean = float(finite.mean()) if len(finite) else math.inf
        return self.values > min(self._config.occupancy_threshold, mean)

    def space(self) -> Space:
        """Currently sampled cells."""
        return occupied_space(self, self.candidates[self.occupied])

    def refresh(
        self,
        field: RadianceField,
        parameters: Parameters,
        condition: Tensor,
        mouth: Tensor,
        seed: int,
        iteration: int,
        *,
        whole: bool,
    ) -> None:
        """Replace values by the maximum of the decayed value and the density at a random point of the cell.

        - ``condition``: (K,) coefficients for the evaluation of cells of the mouth.
        - ``whole``: whether to refresh all cells; otherwise a random quarter of all and of the occupied ones.
        """
        generator = numpy_generator(seed, "occupancy", iteration)
        chosen = np.arange(len(self.candidates))
        if not whole:
            drawn = generator.random(len(chosen)) < 0.25
            drawn |= self.occupied & (generator.random(len(chosen)) < 0.25)
            chosen = np.flatnonzero(drawn)
        cells = np.stack(np.unravel_index(self.candidates[chosen], self.size), axis=1)
        points = self.low + self.cell * (cells + generator.random(cells.shape))
        fresh = self._thickness(field, parameters, points, chosen, condition, mouth)
        old = self.values[chosen]
        kept = np.where(np.isfinite(old), self._config.occupancy_decay * old, 0)
        self.values[chosen] = np.maximum(kept, fresh)

    @torch.no_grad()
    def _thickness(
        self,
        field: RadianceField,
        parameters: Parameters,
        points: np.ndarray,
        chosen: np.ndarray,
        condition: Tensor,
        mouth: Tensor,
    ) -> np.ndarray:
        table = parameters["table"]
        width = field.architecture.conditions
        conditions = torch.stack([condition[:width].to(table), table.new_ones(width)])
        parts = []
        for start in range(0, len(points), CELLS_AT_ONCE):
            rows = slice(start, start + CELLS_AT_ONCE)
            positions = torch.from_numpy(points[rows].astype(np.float32)).to(table.device)
            inside = mouth[torch.from_numpy(self.triangles[chosen[rows]])]
            which = torch.where(inside, 0, 1).to(table.device)
            away = torch.from_numpy(self._distances[chosen[rows]]).to(table.device)
            latent = field.latent(parameters, positions, conditions, which)
            density = field.density(latent, away)
            parts.append((density * self._config.step).cpu().numpy())
        return np.concatenate(parts) if parts else np.empty(0, np.float32)

    def reach(self, chosen: np.ndarray) -> np.ndarray:
        """(F,) maximum distance of cells of the (n,) ``chosen`` candidates from each triangle, metres.

        A cell counts for the triangles nearest to its centre and to its corners, and for those around them within the
        cell's diagonal. Negative without such cells.
        """
        reach = np.full(len(self._neighbours), -1.0, np.float32)
        farthest = self._distances[chosen] + 0.5 * math.sqrt(3) * self.cell
        for triangles in (self.triangles, *self._probes):
            np.maximum.at(reach, triangles[chosen], farthest)
        across = np.where(self._neighbours >= 0, self._neighbours, np.arange(len(reach))[:, None])
        for _ in range(self._rounds):
            reach = np.maximum(reach, reach[across].max(1))
        return reach

    def state(self) -> dict[str, Any]:
        """Tensors that training changes."""
        return {"values": torch.from_numpy(self.values.copy())}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.values = state["values"].cpu().numpy().copy()


def occupied_space(occupancy: Occupancy, cells: np.ndarray) -> Space:
    """The space for (n,) flat indices of occupied cells; only candidates count."""
    chosen = np.flatnonzero(np.isin(occupancy.candidates, cells))
    grid = np.zeros(int(np.prod(occupancy.size)), bool)
    grid[occupancy.candidates[chosen]] = True
    return Space.of(occupancy.reach(chosen), occupancy.low, occupancy.cell, grid.reshape(occupancy.size))


def _cells_near(
    surface: CanonicalSurface, low: np.ndarray, cell: float, size: np.ndarray, config: InstaConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat indices, nearest triangles and distances of the cells with their centres in the shell."""
    numbers = np.arange(int(np.prod(size)))
    normals = np.cross(
        surface.rest.corners[:, 1] - surface.rest.corners[:, 0],
        surface.rest.corners[:, 2] - surface.rest.corners[:, 0],
    )
    half = 0.5 * math.sqrt(3) * cell
    kept = []
    for start in range(0, len(numbers), CELLS_AT_ONCE):
        part = numbers[start : start + CELLS_AT_ONCE]
        centers = low + cell * (np.stack(np.unravel_index(part, size), axis=1) + np.float32(0.5))
        found = surface.rest.nearest(centers)
        triangles, distances = found.triangles.numpy(), np.sqrt(found.values.numpy())
        way = centers - surface.rest.corners[triangles, 0].numpy()
        outside = (way * normals[triangles]).sum(1) >= 0
        near = distances <= half + np.where(outside, config.shell_outside, config.shell_inside)
        kept.append((part[near], triangles[near], distances[near]))
    flat, triangles, distances = (np.concatenate(column) for column in zip(*kept))
    return flat, triangles, distances.astype(np.float32)


def _probes(
    surface: CanonicalSurface, low: np.ndarray, cell: float, size: np.ndarray, candidates: np.ndarray
) -> list[np.ndarray]:
    """(8,) arrays: the nearest triangles of the eight corners of each candidate."""
    cells = np.stack(np.unravel_index(candidates, size), axis=1)
    lattice = size + 1
    flat = [
        np.ravel_multi_index((cells + np.array(np.unravel_index(corner, (2, 2, 2)))).T, lattice)
        for corner in range(8)
    ]
    used, inverse = np.unique(np.concatenate(flat), return_inverse=True)
    points = low + np.float32(cell) * np.stack(np.unravel_index(used, lattice), axis=1)
    parts = [
        surface.rest.nearest(points[start : start + CELLS_AT_ONCE]).triangles.numpy()
        for start in range(0, len(points), CELLS_AT_ONCE)
    ]
    return list(np.concatenate(parts)[inverse].reshape(8, -1).astype(np.int32))


def _dilation_rounds(surface: CanonicalSurface, cell: float) -> int:
    """Number of steps across edges, half an edge each, that cover a cell's diagonal."""
    corners = surface.rest.corners.numpy()
    edge = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    return 1 + math.ceil(2 * math.sqrt(3) * cell / max(edge, 1e-6))
