"""Rays through the field, marched in rounds so that hidden samples are not evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, FloatArray
from .field import Parameters, RadianceField
from .marching import PosedSurface, Rays, Space


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
                found = scene.surface.march(
                    scene.rays, first[number], marching.step, marching.round_samples, space
                )
                first[number] = found.next
                gathered.append((number, offset, found, scene.rays.jitter[found.rays]))
            offset += counts[number]
        if not any(len(found.rays) for _, _, found, _ in gathered):
            continue
        positions = _joined([found.positions for _, _, found, _ in gathered], device)
        directions = _joined([found.directions for _, _, found, _ in gathered], device)
        rays = _joined([found.rays.astype(np.int64) + start for _, start, found, _ in gathered], device)
        triangles = _joined([found.triangles.astype(np.int64) for _, _, found, _ in gathered], mouth.device)
        lengths = _joined(
            [(found.indices + j) * np.float32(marching.step) for _, _, found, j in gathered], device
        )
        owners = _joined([np.full(len(found.rays), number) for number, _, found, _ in gathered], device)
        rows = torch.where(mouth[triangles].to(device), owners, len(scenes))
        away = _joined([found.distances for _, _, found, _ in gathered], device)
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
