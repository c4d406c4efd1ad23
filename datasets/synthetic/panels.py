"""Renderer for meshes lit by large panels: image and foreground mask for a camera.

Light is computed at the vertices once per pose for all cameras: from each of eight panels by rays to its whole area,
from dim surroundings, and from other surfaces (one bounce). The colour of a pixel is albedo times light plus
reflections of the panels; eyes reflect the hit of a traced ray. The compiled kernel uses only operations that IEEE 754
rounds exactly, so images have the same bytes on every processor and with any number of threads.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...bench.contracts import Camera, FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.native.dispatch import Kernel
from ..head.geometry import ANGLE_BITS, COEFFICIENT_BITS, LENGTH_BITS, on_grid
from .plan import CAMERA_DISTANCE

KERNEL = Kernel("headbench.datasets.synthetic._light", "The renderer of synthetic captures")

MOST_PANELS = 8
SURROUNDINGS = (0.25, 0.25, 0.25)
"""Radiance of the surroundings outside the panels."""

MIRRORS = ("eye",)
"""Materials with sharp reflections regardless of roughness."""

_MOST_SAMPLES = 289
_FILTER, _FILTER_REACH = 0.55, 2  # standard deviation and reach of the pixel filter, pixels
_RAYS, _PATTERNS = 8, 256  # rays from a vertex to its surroundings, and number of ray sets


@dataclass(frozen=True)
class Material:
    """Surface of a mesh; its colour comes with the vertices."""

    roughness: float
    specular: float


MATERIALS: Mapping[str, Material] = {
    "skin": Material(0.50, 0.40),  # lids and lips show their inner side too
    "lips": Material(0.35, 0.45),
    "eye": Material(0.20, 0.5),
    "hair": Material(0.46, 0.32),
    "lash": Material(0.6, 0.1),
    "teeth": Material(0.22, 0.5),
    "gums": Material(0.28, 0.5),
    "tongue": Material(0.35, 0.45),
    "mouth": Material(0.6, 0.2),
    "frame": Material(0.25, 0.5),
    "cloth": Material(0.9, 0.05),
}


@dataclass(frozen=True, eq=False)
class AreaLight:
    """A rectangular area light that emits evenly on one side.

    ``center``, ``half_width``, ``half_height``: (3,) metres, its corners are ``center ± half_width ± half_height``;
    ``normal`` (3,) unit, towards what it lights; ``radiance`` (3,) linear RGB.
    """

    center: FloatArray
    half_width: FloatArray
    half_height: FloatArray
    normal: FloatArray
    radiance: FloatArray


def sample_count(wanted: int) -> int:
    """The smallest square number that is at least ``wanted``."""
    if not 1 <= wanted <= _MOST_SAMPLES:
        raise InputError("--samples", "", f"1 to {_MOST_SAMPLES} samples per pixel", str(wanted))
    return (math.isqrt(wanted - 1) + 1) ** 2


def default_samples(width: int, height: int) -> int:
    """Number of samples for at least 43 dB between two renders of a frame; pixels of small images contain more detail.

    Measured on two subjects each, frontal and from the sides: 25 give 43 to 47 dB at 48x70, 16 give 43 to 47 dB at 144x208 and
    47 to 50 dB at 275x401, 9 give 46 to 49 dB at 550x802.
    """
    pixels = width * height
    return 25 if pixels < 20_000 else 16 if pixels < 300_000 else 9


def rig_middle(frontal: Camera) -> FloatArray:
    """(3,): the point that all cameras of a rig look at, from the frontal one."""
    rotation, shift = frontal.world_to_camera[:3, :3], frontal.world_to_camera[:3, 3]
    return rotation[2] * CAMERA_DISTANCE - (rotation * shift[:, None]).sum(axis=0)


def panels(middle: FloatArray) -> tuple[AreaLight, ...]:
    """Eight diffused panels around ``middle`` (3,): four above the cameras, two below them, two at the sides.

    NeRSemble's rig has eight LED panels with diffusers (Kirschstein et al. 2023, section 3); sizes and positions are
    chosen here.
    """
    placed = (
        # azimuth and elevation in degrees, distance, width and height in metres, strength, tint
        ((-24.0, 40.0), 1.20, (0.60, 0.40), 1.10, (1.00, 0.98, 0.95)),
        ((24.0, 40.0), 1.20, (0.60, 0.40), 0.90, (0.98, 0.99, 1.00)),
        ((-66.0, 34.0), 1.15, (0.50, 0.60), 1.15, (1.00, 0.98, 0.95)),
        ((66.0, 34.0), 1.15, (0.50, 0.60), 0.85, (0.97, 0.99, 1.00)),
        ((-105.0, 8.0), 1.10, (0.40, 0.80), 1.00, (1.00, 0.99, 0.97)),
        ((105.0, 8.0), 1.10, (0.40, 0.80), 1.00, (0.97, 0.99, 1.00)),
        ((-38.0, -36.0), 1.15, (0.60, 0.40), 0.75, (1.00, 0.99, 0.97)),
        ((38.0, -36.0), 1.15, (0.60, 0.40), 0.75, (0.99, 0.99, 1.00)),
    )
    return tuple(
        _panel(middle, np.radians(place), distance, size, _EXPOSURE * strength * np.array(tint))
        for place, distance, size, strength, tint in placed
    )


_EXPOSURE = 3.7


def _panel(
    middle: FloatArray,
    place: FloatArray,
    distance: float,
    size: tuple[float, float],
    radiance: FloatArray,
) -> AreaLight:
    (a, e), (width, height) = place, size
    outward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    up = np.cross(outward, right)
    outward, right, up = (on_grid(axis, ANGLE_BITS) for axis in (outward, right, up))
    center = on_grid(middle + distance * outward, LENGTH_BITS)
    return AreaLight(center, 0.5 * width * right, 0.5 * height * up, -outward, radiance)


def window(camera: Camera, points: FloatArray) -> tuple[slice, slice]:
    """Rows and columns of the image that contain all ``points`` (n, 3), with a margin for the pixel filter. The whole
    image if a point is beside or behind the camera; empty if all are outside."""
    # A row of all x, one of all y, one of all z: by columns this takes a sixth of the time of a whole render.
    seen = camera.world_to_camera[:3, :3] @ points.T + camera.world_to_camera[:3, 3:]
    size = np.array([camera.width, camera.height])
    low, high = np.zeros(2, int), size
    if seen[2].min() > 0.0:
        pixels = camera.K @ seen
        pixels = pixels[:2] / pixels[2]
        low = np.clip(np.floor(pixels.min(axis=1)).astype(int) - _FILTER_REACH, 0, size)
        high = np.clip(np.ceil(pixels.max(axis=1)).astype(int) + _FILTER_REACH, 0, size)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


class PanelTracer:
    """A scene lit by panels; meshes have constant triangles and may change positions and colours. ``samples``: Rays per
    pixel, rounded up to a square number. ``seed``: Seed of the points on the panels that each vertex samples."""

    def __init__(
        self,
        lights: Sequence[AreaLight],
        samples: int,
        threads: int = 1,
        seed: int = 0,
        surroundings: Sequence[float] = SURROUNDINGS,
        instruction_set: str | None = None,
    ) -> None:
        self._grid = math.isqrt(sample_count(samples))
        self._module: Any = KERNEL.load()
        self._instruction_set = instruction_set or KERNEL.instruction_sets[0]
        self._panels = np.zeros((MOST_PANELS, 5, 3), np.float32)
        self._panels[:, 0] = 1e3  # missing ones are placed far away, without area
        for row, light in zip(self._panels, lights):
            row[:] = light.center, light.half_width, light.half_height, light.normal, light.radiance
        self._surroundings = np.asarray(surroundings, np.float32)
        self._threads, self._seed = threads, seed
        self._vertices: dict[str, FloatArray] = {}
        self._albedo: dict[str, FloatArray] = {}
        self._gloss: dict[str, FloatArray] = {}
        self._faces: dict[str, IntArray] = {}
        self._materials: dict[str, str] = {}
        self._world: Any = None
        self._moved = False
        self._corners = np.zeros((8, 3))  # of a box around everything

    def add(
        self, name: str, vertices: FloatArray, faces: IntArray, albedo: FloatArray, material: str
    ) -> None:
        """Add a mesh: (n, 3) world positions, (m, 3) triangles, (n, 3) linear reflectance."""
        self._vertices[name], self._albedo[name] = vertices, albedo
        self._faces[name], self._materials[name] = faces, material
        self._gloss[name] = np.ones(len(vertices))
        self._world = None

    def move(
        self,
        name: str,
        vertices: FloatArray,
        albedo: FloatArray | None = None,
        gloss: FloatArray | None = None,
    ) -> None:
        """Set a mesh's positions and, if they changed, colours and ``gloss``. Takes effect with the next image.
        ``gloss`` (n,) are factors on the panels' reflections: 1 unless given; mirrors have none."""
        self._vertices[name] = vertices
        if albedo is not None:
            self._albedo[name] = albedo
        if gloss is not None:
            self._gloss[name] = gloss
        self._moved = True

    def image(self, camera: Camera, seed: int) -> tuple[FloatArray, FloatArray]:
        """Render linear light, straight (not premultiplied) rgb (H, W, 3), and coverage (H, W) in [0, 1]."""
        world = self._current()
        pixels = np.zeros((camera.height, camera.width, 4))
        rows, columns = window(camera, self._corners)
        if rows.start < rows.stop and columns.start < columns.stop:
            tile = np.zeros((rows.stop - rows.start, columns.stop - columns.start, 4), np.float32)
            world.render(
                _rays(camera),
                *(columns.start, rows.start, self._grid, _taps(self._grid), seed, tile, self._threads),
            )
            pixels[rows, columns] = tile
        alpha = np.clip(pixels[..., 3], 0.0, 1.0)
        return pixels[..., :3] / np.maximum(pixels[..., 3:], 1e-6) * (alpha[..., None] > 0), alpha

    def light(self, name: str, vertices: IntArray, back: bool = False) -> tuple[FloatArray, ...]:
        """Light on a side of ``vertices`` (n,) of a mesh, as the radiance of a white diffuse surface.

        From the panels alone (n, 3); with surroundings and bounce (n, 3); the share of each panel's light that
        arrives, of what faces the side, (n, 8).
        """
        world, first = self._current(), 0
        for other, points in self._vertices.items():
            if other == name:
                break
            first += len(points)
        sides = 2 * (first + np.asarray(vertices, np.int64)) + back
        rows = np.zeros((len(sides), 6 + MOST_PANELS), np.float32)
        world.light(sides, rows, self._threads)
        return rows[:, :3], rows[:, 3:6], rows[:, 6:]

    def _current(self) -> Any:
        if self._world is not None and not self._moved:
            return self._world
        vertices = np.concatenate(list(self._vertices.values())).astype(np.float32)
        box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        self._corners = box[_CORNERS, np.arange(3)]
        if self._world is None:
            self._world = self._build(vertices)
        else:
            self._world.move(vertices)
        painted = (np.concatenate(list(each.values())) for each in (self._albedo, self._gloss))
        self._world.paint(*(values.astype(np.float32) for values in painted))
        self._moved = False
        return self._world

    def _build(self, vertices: FloatArray) -> Any:
        used = sorted(set(self._materials.values()))
        faces, material_of, first = [], [], 0
        for name, triangles in self._faces.items():
            faces.append(triangles + first)
            material_of.append(np.full(len(triangles), used.index(self._materials[name]), np.uint8))
            first += len(self._vertices[name])
        # Normal incidence's reflectance and GGX's alpha, by the conventions of Disney's principled model.
        materials = [
            (0.08 * MATERIALS[name].specular, 0.0 if name in MIRRORS else MATERIALS[name].roughness ** 2)
            for name in used
        ]
        return self._module.World(
            vertices,
            np.concatenate(faces).astype(np.int32),
            np.concatenate(material_of),
            np.array(materials, np.float32),
            self._panels,
            self._surroundings,
            _hemisphere(),
            self._seed & 0xFFFFFFFF,
            self._instruction_set,
        )


_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T


def _rays(camera: Camera) -> FloatArray:
    """(4, 3): the camera's place, and what pixel positions (x, y, 1) are multiplied by to give directions. Of single
    operations in one order: these numbers must not depend on the machine."""
    K, rotation, shift = camera.K, camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    place = -(rotation * shift[:, None]).sum(axis=0)
    across = rotation[0] / K[0, 0]
    down = (rotation[1] - K[0, 1] * across) / K[1, 1]
    return np.stack([place, across, down, rotation[2] - K[0, 2] * across - K[1, 2] * down])


def _taps(grid: int) -> FloatArray:
    """Weights of ``grid`` samples a pixel over the pixel and its neighbours, summing to 1."""
    count = (2 * _FILTER_REACH + 1) * grid
    place = (np.arange(count) + 0.5) / grid - _FILTER_REACH - 0.5
    weights = on_grid(np.exp(-0.5 * (place / _FILTER) ** 2), COEFFICIENT_BITS)
    return (weights / weights.sum()).astype(np.float32)


@functools.cache
def _hemisphere() -> FloatArray:
    """(patterns, rays, 3) unit directions about +z, as dense as their cosine: sets of evenly scattered ones."""
    rng = np.random.default_rng(0)
    index = np.arange(_RAYS)
    shift = rng.random((_PATTERNS, 1, 2))
    # A rank-1 lattice, shifted around the torus.
    square = (np.stack([index / _RAYS, index * 3 / _RAYS % 1.0], axis=1) + 0.5 / _RAYS + shift) % 1.0
    radius, turn = np.sqrt(square[..., 0]), 2.0 * np.pi * square[..., 1]
    up = np.sqrt(np.maximum(1.0 - square[..., 0], 0.0))
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), up], axis=-1)
    return on_grid(directions, COEFFICIENT_BITS).astype(np.float32)
