"""Occupied cells of canonical space with their maximum distance from each triangle, and rendering along rays.

Instant NGP's grid (Mueller et al. 2022, appendix E.2), limited to the cells near the canonical mesh.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, FloatArray
from ..shared.schedule import numpy_generator
from .field import EncodedCube, Parameters, RadianceField
from .marching import CanonicalSurface, PosedSurface, Rays, Space
from .spec import InstaConfig


@dataclass(frozen=True, eq=False)
class PosedRays:
    """One pose of the head and its rays."""

    surface: PosedSurface
    condition: Tensor  # (K,) leading expression coefficients
    rays: Rays


class Rendered(NamedTuple):
    """Results of the rays of all scenes, in the order of the scenes."""

    color: Tensor  # (R, 3) not composited on a background
    transmittance: Tensor  # (R,)
    distance: Tensor  # (R,) metres, weighted by opacity
    opacity_sum: Tensor  # scalar, sum of the opacities of all samples
    samples: int


class Marching(NamedTuple):
    """Sampling of rays; see `InstaConfig`."""

    step: float
    round_samples: int
    stop_transmittance: float


def render_rays(
    field: RadianceField,
    parameters: Parameters,
    scenes: Sequence[PosedRays],
    space: Space,
    mouth: Tensor,
    marching: Marching,
) -> Rendered:
    """March the rays of several poses together; differentiable in the parameters.

    The density depends on the expression if the nearest triangle is one of the (F,) bool ``mouth``.
    """
    device = parameters["table"].device
    counts = [len(scene.rays.origins) for scene in scenes]
    total = sum(counts)
    # The last row is the condition of the density network outside the mouth.
    width = field.architecture.conditions
    conditions = torch.ones(len(scenes) + 1, width, device=device, dtype=parameters["table"].dtype)
    for number, scene in enumerate(scenes):
        conditions[number] = scene.condition[:width].to(conditions)
    color, opacity_sum = conditions.new_zeros(total, 3), conditions.new_zeros(())
    transmittance, distance = conditions.new_ones(total), conditions.new_zeros(total)
    first = [np.zeros(count, np.int32) for count in counts]
    evaluated = 0
    while any((numbers >= 0).any() for numbers in first):
        gathered = []
        offset = 0
        for number, scene in enumerate(scenes):
            if (first[number] >= 0).any():
                samples = scene.surface.march(
                    scene.rays, first[number], marching.step, marching.round_samples, space
                )
                first[number] = samples.next
                gathered.append((number, offset, samples, scene.rays.jitter[samples.rays]))
            offset += counts[number]
        if not any(len(samples.rays) for _, _, samples, _ in gathered):
            continue
        positions = _joined([samples.positions for _, _, samples, _ in gathered], device)
        directions = _joined([samples.directions for _, _, samples, _ in gathered], device)
        rays = _joined([samples.rays.astype(np.int64) + start for _, start, samples, _ in gathered], device)
        triangles = _joined(
            [samples.triangles.astype(np.int64) for _, _, samples, _ in gathered], mouth.device
        )
        lengths = _joined(
            [(samples.indices + j) * np.float32(marching.step) for _, _, samples, j in gathered], device
        )
        owners = _joined([np.full(len(samples.rays), number) for number, _, samples, _ in gathered], device)
        rows = torch.where(mouth[triangles].to(device), owners, len(scenes))
        away = _joined([samples.distances for _, _, samples, _ in gathered], device)
        latent = field.latent(parameters, positions, conditions, rows)
        thickness = field.density(latent, away) * marching.step
        values = field.color(parameters, latent, directions)
        part = composite(thickness, values, lengths.to(thickness), rays, transmittance)
        color, distance = color + part.color, distance + part.distance
        transmittance = part.transmittance
        opacity_sum = opacity_sum - torch.expm1(-thickness).sum()
        evaluated += len(rays)
        finished = (transmittance.detach() < marching.stop_transmittance).cpu().numpy()
        offset = 0
        for number, count in enumerate(counts):
            first[number] = np.where(finished[offset : offset + count], np.int32(-1), first[number])
            offset += count
    return Rendered(color, transmittance, distance, opacity_sum, evaluated)


def _joined(parts: Sequence[np.ndarray], device: torch.device) -> Tensor:
    return torch.from_numpy(np.concatenate(parts)).to(device)


class Composite(NamedTuple):
    """Result of compositing along rays."""

    color: Tensor  # (R, C) weighted sums of the samples' values
    transmittance: Tensor  # (R,) transmittance behind the last sample
    distance: Tensor  # (R,) weighted sums of the samples' distances, metres


def composite(
    thickness: Tensor, values: Tensor, distances: Tensor, rays: Tensor, entering: Tensor
) -> Composite:
    """Sums over samples of ``T (1 - exp(-thickness)) value`` with the transmittance T in front of a sample.

    Optical depths are summed in float64, since those of a ray are differences of a sum over all rays.

    - ``thickness``: (N,) density times the length of each sample; samples ordered by ray, then by distance.
    - ``values``, ``distances``: (N, C) and (N,).
    - ``rays``: (N,) int64, ascending, with repetitions.
    - ``entering``: (R,) transmittance in front of the first of these samples.
    """
    count = len(entering)
    depth = thickness.double()
    total = depth.cumsum(0)
    before = total - depth
    firsts = torch.searchsorted(rays, torch.arange(count, device=rays.device))
    lasts = torch.searchsorted(rays, torch.arange(count, device=rays.device), right=True)
    bounds = torch.cat([total.new_zeros(1), total])
    ahead = (before - bounds[firsts[rays]]).to(thickness.dtype)
    weights = entering[rays] * torch.exp(-ahead) * -torch.expm1(-thickness)
    leaving = entering * torch.exp(bounds[firsts] - bounds[lasts]).to(thickness.dtype)
    rows = torch.cat([values, distances[:, None]], dim=1) * weights[:, None]
    summed = rows.new_zeros(count, rows.shape[1]).index_add(0, rays, rows)
    return Composite(summed[:, :-1], leaving, summed[:, -1])


Region = tuple[int, int, int, int]  # left, top, right, bottom; the last two excluded


def camera_rays(camera: Camera, columns: np.ndarray, rows: np.ndarray, jitter: np.ndarray | float) -> Rays:
    """Rays through the centres of (R,) pixels, from the camera's centre; ``jitter`` as in `Rays`."""
    K = np.asarray(camera.K, np.float64)
    y = (rows + 0.5 - K[1, 2]) / K[1, 1]
    x = (columns + 0.5 - K[0, 2] - K[0, 1] * y) / K[0, 0]
    towards = np.stack([x, y, np.ones_like(x)], axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    directions = towards @ camera.world_to_camera[:3, :3]
    origins = np.broadcast_to(camera.center, directions.shape)
    shift = np.broadcast_to(np.asarray(jitter, np.float32), len(directions))
    return Rays(origins.astype(np.float32), directions.astype(np.float32), np.ascontiguousarray(shift))


def pixels_of_hull(camera: Camera, points: FloatArray) -> Region:
    """Box of the pixels whose rays may hit the convex hull of (N, 3) points; the whole image if a point is behind the camera."""
    transform = np.asarray(camera.world_to_camera, np.float64)
    seen = np.asarray(points, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    if seen[:, 2].min() <= 1e-6:
        return 0, 0, camera.width, camera.height
    pixels = (seen @ np.asarray(camera.K, np.float64).T)[:, :2] / seen[:, 2:]
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(0) - 1), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0) + 1), 0, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


BLOCK = 4  # pixels on a side; a block has as many rays as the kernel marches together


def pixels_by_blocks(region: Region, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of a region's pixels by square blocks, up to about ``most`` (or a row of blocks) at a time.

    Blocks at the right and at the bottom are whole and may extend beyond the region.
    """
    left, top, right, bottom = region
    columns = left + np.arange(-(-max(right - left, 0) // BLOCK) * BLOCK)
    height = max(most // max(len(columns) * BLOCK, 1), 1) * BLOCK
    for start in range(top, bottom if len(columns) else top, height):
        rows = np.arange(start, start + -(-(min(start + height, bottom) - start) // BLOCK) * BLOCK)
        grid = np.stack(np.meshgrid(rows, columns, indexing="ij"))
        blocks = grid.reshape(2, len(rows) // BLOCK, BLOCK, len(columns) // BLOCK, BLOCK)
        at = blocks.transpose(0, 1, 3, 2, 4).reshape(2, -1)
        yield at[0], at[1]


def box_corners(points: FloatArray, padding: float) -> FloatArray:
    """(8, 3) corners of the box around points, grown by ``padding`` metres."""
    low, high = points.min(0) - padding, points.max(0) + padding
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


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
        block = numbers[start : start + CELLS_AT_ONCE]
        centers = low + cell * (np.stack(np.unravel_index(block, size), axis=1) + np.float32(0.5))
        nearest = surface.rest.nearest(centers)
        triangles, distances = nearest.triangles.numpy(), np.sqrt(nearest.values.numpy())
        way = centers - surface.rest.corners[triangles, 0].numpy()
        outside = (way * normals[triangles]).sum(1) >= 0
        near = distances <= half + np.where(outside, config.shell_outside, config.shell_inside)
        kept.append((block[near], triangles[near], distances[near]))
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
