"""Rendering of meshes in numpy: an exact scanline z-buffer with Lambert shading.

For figures, overlays and visibility tests, not for training. A head of 10,000 triangles at 400x600, supersampled
twice, takes about a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..bench.contracts import ByteArray, Camera, FloatArray, IntArray
from ..bench.errors import InputError
from .head.geometry import vertex_normals

PAPER = (1.0, 1.0, 1.0)
CLAY = (0.78, 0.76, 0.74)
"""Default colour of a mesh."""

NEAR = 1e-3
"""Near plane, metres; triangles that cross it are not drawn."""

MAX_LAYERS = 32
"""Maximum ratio of the total area of the triangles' bounding boxes to the image; for a head it is about four."""
_AT_ONCE = 2**21  # pixels

_LIGHT = (-0.30, -0.45, -0.84)  # camera axes: from the upper left, mostly from the viewer
_AMBIENT = 0.25
_BACK_FACE = 0.45  # brightness of the inside of a surface


class Fragments(NamedTuple):
    """The visible surface of a mesh at the centre of each pixel."""

    face: IntArray
    """(H, W) int32 index of the triangle in front, -1 without one."""
    weights: FloatArray
    """(H, W, 3) float32 perspective-correct barycentric weights of its corners; 0 without a triangle."""
    depth: FloatArray
    """(H, W) float32 camera-space z, metres; infinity without a triangle."""


def draw_mesh(
    vertices: FloatArray,
    faces: IntArray,
    camera: Camera,
    colors: FloatArray | None = None,
    *,
    background: Sequence[float] | FloatArray | ByteArray = PAPER,
    opacity: float = 1.0,
    shading: float = 1.0,
    supersampling: int = 2,
) -> ByteArray:
    """Draw a shaded mesh; (H, W, 3) 8-bit sRGB of the camera's size.

    ``vertices``: (V, 3) in the world, metres. Triangles with a non-finite corner are skipped. ``faces``: (F, 3),
    counter-clockwise from outside; the inside is drawn too, darker. ``colors``: (V, 3) display-referred colours in [0, 1];
    default: `CLAY`. ``background``: (3,) colour in [0, 1], or an (H, W, 3) image, 8-bit or in [0, 1], to draw on.
    ``opacity``: Opacity of the mesh over the background. ``shading``: 1 for Lambert shading, 0 for the plain colours, or a
    mixture.
    """
    fine = camera.resized(supersampling * camera.width, supersampling * camera.height)
    fragments = rasterize_mesh(vertices, faces, fine)
    hit = fragments.face >= 0
    tint = np.broadcast_to(
        np.asarray(CLAY if colors is None else colors, dtype=np.float32), (len(vertices), 3)
    )
    light = 1 - shading + shading * _brightness(vertices, faces, camera)
    lit = (light[..., None] * tint).reshape(-1, 3)
    # One row of colours for the outside of each vertex, one for its inside.
    corners = faces + len(vertices) * _seen_from_inside(vertices, faces, camera)[:, None]
    shaded = _blend(lit, corners[fragments.face[hit]], fragments.weights[hit])
    layer = np.zeros((*hit.shape, 4), dtype=np.float32)
    layer[hit, :3] = np.clip(shaded, 0, 1)
    layer[hit, 3] = 1
    layer = cv2.resize(layer, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    # The layer is premultiplied: colours are 0 outside the mesh, so the average needs no division.
    ground = np.asarray(background)
    ground = ground.astype(np.float32) / (255 if ground.dtype == np.uint8 else 1)
    picture = opacity * layer[..., :3] + (1 - opacity * layer[..., 3:]) * ground
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def rasterize_mesh(vertices: FloatArray, faces: IntArray, camera: Camera) -> Fragments:
    """Find the triangle in front at each pixel's centre, exactly and without gaps along shared edges.

    A pixel centre on an edge belongs to one of its two triangles. Among triangles at one depth (to float32) the one of
    lowest index is in front. See `draw_mesh` for ``vertices`` and ``faces``; `NEAR` bounds the depth.
    """
    width, height = camera.width, camera.height
    points, usable = _project(vertices, camera)
    kept = np.flatnonzero(usable[faces].all(axis=1))
    corners = points[faces[kept]]  # (n, 3, 3): x, y in pixels, 1/z
    front = np.zeros(height * width, dtype=np.uint64)
    for start, end in _parts(corners, width, height):
        place, inverse, which = _fragments(corners[start:end], width, height)
        # Positive floats sort like their bits: with depth in the high and triangle in the low bits, the largest key is
        # in front.
        order = np.uint64(len(kept) - start) - which.astype(np.uint64)
        keys = (np.maximum(inverse, 0).view(np.uint32).astype(np.uint64) << np.uint64(32)) | order
        np.maximum.at(front, place, keys)
    pixels = np.flatnonzero(front)
    local = len(kept) - (front[pixels] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    weights = _weights(corners, local, pixels % width + 0.5, pixels // width + 0.5)
    result = Fragments(
        np.full(height * width, -1, dtype=np.int32),
        np.zeros((height * width, 3), dtype=np.float32),
        np.full(height * width, np.inf, dtype=np.float32),
    )
    result.face[pixels] = kept[local]
    result.weights[pixels] = weights
    result.depth[pixels] = 1 / (front[pixels] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    shape = (height, width)
    return Fragments(
        result.face.reshape(shape), result.weights.reshape(*shape, 3), result.depth.reshape(shape)
    )


def portrait_camera(
    vertices: FloatArray,
    width: int,
    height: int,
    *,
    yaw: float = 0.0,
    pitch: float = 0.0,
    fill: float = 0.92,
    distance: float = 1.2,
) -> Camera:
    """Place a camera in front of a head that looks along +z with +y up, so that all of it is visible.

    ``vertices``: (V, 3) points that must be visible, metres; for pictures that are compared, all of their vertices.
    ``yaw``, ``pitch``: Radians; the camera moves to the head's left, and up. ``fill``: Fraction of the picture that the
    head's projection spans along its longer side. ``distance``: Distance from the middle of the vertices' bounding box,
    metres.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    outward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    forward = -outward
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ ((low + high) / 2 + distance * outward)
    seen = vertices @ rotation.T + world_to_camera[:3, 3]
    slopes = seen[:, :2] / seen[:, 2:]
    least, most = slopes.min(axis=0), slopes.max(axis=0)
    focal = fill * float((np.array([width, height]) / (most - least)).min())
    centre = np.array([width, height]) / 2 - focal * (least + most) / 2
    intrinsics = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    return Camera("portrait", width, height, intrinsics, world_to_camera)


def _project(vertices: FloatArray, camera: Camera) -> tuple[FloatArray, np.ndarray]:
    """(V, 3) pixel x, pixel y and 1/z; and which vertices may be drawn."""
    world = np.asarray(vertices, dtype=np.float64)
    usable = np.asarray(np.isfinite(world).all(axis=1))
    points = np.where(usable[:, None], world, 0.0) @ camera.world_to_camera[:3, :3].T
    points += camera.world_to_camera[:3, 3]
    usable &= points[:, 2] > NEAR
    inverse = 1 / np.where(usable, points[:, 2], 1.0)
    pixels = (points * inverse[:, None]) @ camera.K[:2].T
    return np.column_stack([pixels, inverse]), usable


def _parts(corners: FloatArray, width: int, height: int) -> Iterator[tuple[int, int]]:
    """First and end of runs of triangles whose bounding boxes have together about `_AT_ONCE` pixels of the picture."""
    low = np.clip(corners[:, :, :2].min(axis=1), 0, (width, height))
    high = np.clip(corners[:, :, :2].max(axis=1), 0, (width, height))
    size = high - low
    covered = np.cumsum((size[:, 0] + 1) * size[:, 1])  # a row costs something, however narrow
    layers = covered[-1] / (width * height) if len(covered) else 0.0
    if layers > MAX_LAYERS:
        expected = f"triangles that cover the picture {MAX_LAYERS} times at most"
        raise InputError("mesh", "vertices", expected, f"{layers:.0f} times", "Is the tracking right?")
    start = 0
    while start < len(corners):
        before = covered[start - 1] if start else 0.0
        end = max(start + 1, int(np.searchsorted(covered, before + _AT_ONCE)))
        yield start, end
        start = end


def _fragments(corners: FloatArray, width: int, height: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Pixel index, 1/z and triangle of each pixel centre inside a triangle."""
    which, row, left, right = _spans(corners, width, height)
    counts = right - left
    # Fragments are ordered by span; values of a span are repeated over its fragments.
    first = np.repeat(np.cumsum(counts) - counts, counts)
    along = np.arange(len(first)) - first
    # 1/z is linear over the image of a triangle, so along a span it takes a start and a slope.
    slope, start = _inverse_depth(corners[which], row, left)
    inverse = (np.repeat(start, counts) + np.repeat(slope, counts) * along).astype(np.float32)
    return np.repeat(row * width + left, counts) + along, inverse, np.repeat(which, counts)


def _spans(corners: FloatArray, width: int, height: int) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Triangle, row, first column and end column of every non-empty run of pixel centres inside a triangle.

    A centre on the left or upper border is inside, one on the right or lower border is not. Each edge is intersected
    from its upper to its lower end, so that two triangles that share it get bit-identical results.
    """
    order = np.argsort(corners[:, :, 1], axis=1, kind="stable")
    top, middle, bottom = (
        np.take_along_axis(corners, order[:, i, None, None], axis=1)[:, 0] for i in range(3)
    )
    first = np.clip(np.ceil(top[:, 1] - 0.5), 0, height).astype(np.int64)
    end = np.clip(np.ceil(bottom[:, 1] - 0.5), 0, height).astype(np.int64)
    counts = np.maximum(end - first, 0)
    which = np.repeat(np.arange(len(corners)), counts)
    row = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts) + first[which]
    y = row + 0.5
    long_edge = _cut(top[which], bottom[which], y)
    upper = y < middle[which, 1]
    start = np.where(upper[:, None], top[which], middle[which])
    stop = np.where(upper[:, None], middle[which], bottom[which])
    short_edge = _cut(start, stop, y)
    low, high = np.minimum(long_edge, short_edge), np.maximum(long_edge, short_edge)
    left = np.clip(np.ceil(low - 0.5), 0, width).astype(np.int64)
    right = np.clip(np.ceil(high - 0.5), 0, width).astype(np.int64)
    full = right > left
    return which[full], row[full], left[full], right[full]


def _cut(start: FloatArray, stop: FloatArray, y: FloatArray) -> FloatArray:
    """x where the edges from ``start`` down to ``stop`` cross the heights ``y``."""
    rise = stop[:, 1] - start[:, 1]
    share = (y - start[:, 1]) / np.where(rise > 0, rise, 1.0)
    return start[:, 0] + share * (stop[:, 0] - start[:, 0])


def _inverse_depth(corners: FloatArray, row: IntArray, left: IntArray) -> tuple[FloatArray, FloatArray]:
    """Slope along x of 1/z of each span's triangle, and its value in the middle of the span's first pixel."""
    edges = corners[:, 1:] - corners[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    area = np.where(area == 0, 1.0, area)
    along_x = (edges[:, 0, 2] * edges[:, 1, 1] - edges[:, 1, 2] * edges[:, 0, 1]) / area
    along_y = (edges[:, 1, 2] * edges[:, 0, 0] - edges[:, 0, 2] * edges[:, 1, 0]) / area
    x, y = left + 0.5 - corners[:, 0, 0], row + 0.5 - corners[:, 0, 1]
    return along_x, corners[:, 0, 2] + along_x * x + along_y * y


def _weights(corners: FloatArray, which: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(n, 3) perspective-correct barycentric weights of points, each in triangle ``which`` of ``corners``."""
    px, py, inverse = np.moveaxis(corners, 2, 0)
    after, before = [1, 2, 0], [2, 0, 1]
    # Twice the area of point and opposite edge, over the depth: linear in x and y.
    along_x = (py[:, after] - py[:, before]) * inverse
    along_y = (px[:, before] - px[:, after]) * inverse
    constant = (px[:, after] * py[:, before] - px[:, before] * py[:, after]) * inverse
    weights = along_x[which] * x[:, None]
    weights += along_y[which] * y[:, None]
    weights += constant[which]
    np.abs(weights, out=weights)
    total = weights[:, 0] + weights[:, 1] + weights[:, 2]
    weights *= (1 / np.maximum(total, np.finfo(np.float64).tiny))[:, None]
    return weights.astype(np.float32)


def _blend(values: FloatArray, corners: IntArray, weights: FloatArray) -> FloatArray:
    """(n, C) values at the fragments."""
    result = weights[:, :1] * values[corners[:, 0]]
    for corner in (1, 2):
        result += weights[:, corner : corner + 1] * values[corners[:, corner]]
    return result


def _brightness(vertices: FloatArray, faces: IntArray, camera: Camera) -> FloatArray:
    """(2, V) float32 brightness in [0, 1] of the surface at each vertex: seen from outside, from inside."""
    normals = vertex_normals(vertices, faces) @ camera.world_to_camera[:3, :3].T
    light = np.array(_LIGHT) / np.linalg.norm(_LIGHT)
    facing = normals @ light
    bright = _AMBIENT + (1 - _AMBIENT) * np.maximum([facing, -facing], 0)
    return (np.array([[1.0], [_BACK_FACE]]) * bright).astype(np.float32)


def _seen_from_inside(vertices: FloatArray, faces: IntArray, camera: Camera) -> np.ndarray:
    """(F,) whether triangles face away from the camera."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.einsum("ij,ij->i", normals, corners[:, 0] - camera.center) > 0
