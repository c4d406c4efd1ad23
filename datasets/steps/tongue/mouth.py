"""A map of lips and chin to which every frame is resampled.

The map looks at the subject's neutral mesh from straight ahead. Each pixel is a point on the surface (a triangle and
barycentric weights), the same point of the skin for any pose and camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ....bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    HeadAsset,
    IntArray,
    Progress,
    no_progress,
)
from ....bench.errors import InputError
from ....bench.machine import processor_count
from ....bench.protocol import evenly_with_ends
from ...head.arrays import JOINT_NAMES, region
from ...head.geometry import vertex_normals
from ...head.model import PosedSubject
from ...mesh_pictures import rasterize_mesh

PITCH = 0.0015
"""Edge length of a pixel of the map, metres: about half the height of the first visible part of a tongue."""

_SIDE, _ABOVE, _BELOW = 0.75, 0.30, 1.0  # of the mouth's width, from its middle
_REACH = 2.4  # widths of the mouth; farther triangles cannot hide it from a camera in front
_FRONT = 0.25  # minimum z of the neutral normal of front-facing surface
_INNER = ("mouth_socket", "teeth", "gums_and_tongue")  # regions that are behind the lips, seen from outside
_FAR = 50.0  # metres; from there perspective is below a tenth of a millimetre


@dataclass(frozen=True, eq=False)
class MouthAtlas:
    """A frontal map of the surface around a subject's mouth, H x W pixels of `PITCH`, row 0 on top."""

    inside: np.ndarray
    """(H, W) whether the map has surface: the face's outside, facing front."""
    corners: IntArray
    """(N, 3) vertices of the triangle behind each pixel of ``inside``, in row-major order."""
    weights: FloatArray
    """(N, 3) barycentric weights on them."""
    lips: np.ndarray
    """(H, W) pixels of the lips."""
    below: np.ndarray
    """(H, W) pixels below the line where the lips meet: lower lip and chin."""
    height: FloatArray
    """(H, W) millimetres above the line where the lips meet, negative below."""
    occluders: IntArray
    """(F', 3) triangles that can hide the mouth from a camera in front of it."""

    def points(self, vertices: FloatArray) -> FloatArray:
        """(N, 3) places of the map's pixels on a posed mesh (V, 3), metres."""
        return np.einsum("nk,nkd->nd", self.weights, vertices[self.corners])

    def normals(self, vertices: FloatArray) -> FloatArray:
        """(N, 3) unit normals of the posed triangles behind the map's pixels; 0 where one has no area."""
        a, b, c = np.moveaxis(vertices[self.corners], 1, 0)
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def mouth_atlas(clip: Clip) -> MouthAtlas:
    """Create the map for a clip's subject."""
    head = clip.head
    where = f"head model {head.version!r}"
    lip_region, face = (region(head, name) for name in ("lips", "face"))
    neutral = PosedSubject.of(clip).neutral
    lips = np.intersect1d(lip_region, face)
    lips = lips if len(lips) else lip_region
    on_jaw = head.skinning_weights[:, JOINT_NAMES.index("jaw")]
    span = on_jaw[lips]
    if np.ptp(span) < 0.2:
        expected = "a lower lip that follows the jaw and an upper that does not"
        found = f"jaw weights from {span.min():.2f} to {span.max():.2f}"
        raise InputError(where, "skinning_weights", expected, found)
    middle = 0.5 * float(span.min() + span.max())
    width = float(np.ptp(neutral[lips, 0]))
    upper, lower = lips[span < middle], lips[span >= middle]
    near = np.abs(neutral[:, 0] - neutral[lips, 0].mean()) < 0.2 * width
    if not near[upper].any() or not near[lower].any():
        raise InputError(where, "regions[lips]", "an upper and a lower lip about the middle", "none of one")
    line = 0.5 * (neutral[upper[near[upper]], 1].min() + neutral[lower[near[lower]], 1].max())
    centre = np.array([neutral[lips, 0].mean(), line, neutral[lips, 2].max()])

    camera = _map_camera(centre, width)
    outer = _outer_faces(head, neutral)
    seen = rasterize_mesh(neutral, head.faces[outer], camera)
    inside = seen.face >= 0
    corners = head.faces[outer][seen.face[inside]]
    weights = seen.weights[inside].astype(np.float64)

    def spread(values: FloatArray) -> FloatArray:
        picture = np.zeros(inside.shape)
        picture[inside] = np.einsum("nk,nk->n", weights, values[corners])
        return picture

    on_lips = np.zeros(len(neutral))
    on_lips[lip_region] = 1.0
    lip_map = inside & (spread(on_lips) > 0.5)
    row_line = _lip_line(lip_map, spread(on_jaw) >= middle, camera)
    rows = np.arange(camera.height)[:, None] + 0.5
    height = (row_line[None] - rows) * PITCH * 1e3
    close = np.linalg.norm(neutral[head.faces].mean(axis=1) - centre, axis=1) < _REACH * width
    close &= ~_in_regions(head, _INNER)[head.faces].all(axis=1)
    return MouthAtlas(
        inside, corners, weights, lip_map, inside & (height < 0), height, head.faces[np.flatnonzero(close)]
    )


def _map_camera(centre: FloatArray, mouth: float) -> Camera:
    """Camera along -z at the middle of the mouth, far enough for a parallel projection."""
    columns = 2 * int(np.ceil(_SIDE * mouth / PITCH))
    above, below = (int(np.ceil(share * mouth / PITCH)) for share in (_ABOVE, _BELOW))
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[:3, 3] = [-centre[0], centre[1], centre[2] + _FAR]
    K = np.array([[_FAR / PITCH, 0, columns / 2], [0, _FAR / PITCH, above], [0, 0, 1.0]])
    return Camera("mouth", columns, above + below, K, world_to_camera)


def _outer_faces(head: HeadAsset, neutral: FloatArray) -> IntArray:
    """Triangles of the face's outside that face front, without the mouth's wall."""
    skin = _in_regions(head, ("face", "lips")) & ~_in_regions(head, _INNER)
    skin &= vertex_normals(neutral, head.faces)[:, 2] > _FRONT
    return np.flatnonzero(skin[head.faces].all(axis=1))


def _in_regions(head: HeadAsset, names: Iterable[str]) -> np.ndarray:
    """(V,) vertices that are in one of the regions; a region that the head does not have is empty."""
    inside = np.zeros(len(head.template), dtype=bool)
    for name in names:
        inside[head.regions.get(name, np.array([], dtype=int))] = True
    return inside


def _lip_line(lips: np.ndarray, lower: np.ndarray, camera: Camera) -> FloatArray:
    """(W,) row of the line between the lips in each column; beyond the corners it continues horizontally."""
    rows = np.arange(camera.height) + 0.5
    line = np.full(camera.width, np.nan)
    for column in range(camera.width):
        top = rows[lips[:, column] & ~lower[:, column]]
        bottom = rows[lips[:, column] & lower[:, column]]
        if len(top) and len(bottom):
            line[column] = 0.5 * (top.max() + bottom.min())
    finite = np.flatnonzero(np.isfinite(line))
    if not len(finite):
        return np.full(camera.width, camera.K[1, 2])
    return np.interp(np.arange(camera.width), finite, line[finite])


FACING = np.cos(np.radians(62.0))
"""Minimum cosine of the angle between normal and line of sight for a reliable pixel."""

_MOUTH_FACING = np.cos(np.radians(55.0))
_HIDDEN = 0.0025  # minimum distance of hidden points behind the front surface, metres
_MARGIN = 3  # pixels around the mouth
_MESHES = 32  # posed at once


@dataclass(frozen=True, eq=False)
class MouthColours:
    """Colours of T timesteps in up to C cameras, in the map's layout."""

    timesteps: Sequence[int]
    """Sorted timesteps."""
    cameras: Sequence[str]
    """Camera ids by position."""
    colours: ByteArray
    """(T, C, H, W, 3) 8-bit sRGB; 0 if not seen."""
    seen: np.ndarray
    """(T, C, H, W)."""


def frames_by_timestep(clip: Clip) -> dict[int, dict[str, FrameKey]]:
    """Every frame of a clip, including excluded ones: key by camera, by timestep."""
    found: dict[int, dict[str, FrameKey]] = {}
    for key in sorted({*(k for keys in clip.splits.values() for k in keys), *clip.excluded}):
        found.setdefault(key.timestep, {})[key.camera] = key
    return dict(sorted(found.items()))


def facing_cameras(clip: Clip, atlas: MouthAtlas, count: int) -> list[str]:
    """Ids of the ``count`` cameras that the mouth faces most, over poses spread along the clip."""
    timesteps = list(frames_by_timestep(clip))
    spread = evenly_with_ends(timesteps, 15)
    cosines: dict[str, list[float]] = {camera: [] for camera in clip.cameras}
    for _, vertices in posed_meshes(clip, spread):
        centre = atlas.points(vertices).mean(axis=0)
        normal = atlas.normals(vertices).mean(axis=0)
        for name, camera in clip.cameras.items():
            sight = camera.center - centre
            cosines[name].append(float(sight @ normal / np.linalg.norm(sight) / np.linalg.norm(normal)))
    typical = {name: float(np.median(values)) for name, values in cosines.items()}
    chosen = sorted((name for name in typical if typical[name] > _MOUTH_FACING), key=lambda n: -typical[n])
    if not chosen:
        best = np.degrees(np.arccos(max(typical.values())))
        expected = "a camera that sees the mouth within 55 degrees"
        raise InputError("clip", "cameras", expected, f"{best:.0f} degrees")
    return chosen[:count]


def posed_meshes(clip: Clip, timesteps: Sequence[int]) -> Iterator[tuple[int, FloatArray]]:
    """(timestep, (V, 3) tracked mesh in metres), a few posed at a time."""
    for timestep, mesh in PosedSubject.of(clip, torch.float32).each(clip, timesteps, _MESHES):
        yield timestep, mesh.astype(np.float64)


def sample_clip(
    clip: Clip, atlas: MouthAtlas, cameras: Sequence[str], progress: Progress = no_progress
) -> MouthColours:
    """Sample every timestep of a clip in the given cameras; each image is read once. Memory: the result (20 kB per
    timestep and camera for a map of 50 x 50) and a few images at a time."""
    frames = frames_by_timestep(clip)
    timesteps = [t for t, keys in frames.items() if any(camera in keys for camera in cameras)]
    height, width = atlas.inside.shape
    colours = np.zeros((len(timesteps), len(cameras), height, width, 3), np.uint8)
    seen = np.zeros(colours.shape[:4], bool)

    def sample(row: int, vertices: FloatArray) -> None:
        keys = frames[timesteps[row]]
        for column, name in enumerate(cameras):
            if name in keys:
                picture, visible = sample_image(clip.image(keys[name]), clip.cameras[name], atlas, vertices)
                colours[row, column], seen[row, column] = picture, visible

    subject = PosedSubject.of(clip, torch.float32)
    with ThreadPoolExecutor(min(processor_count(), 8)) as pool:
        for start in range(0, len(timesteps), _MESHES):  # a pool would take all jobs and their meshes at once
            block = timesteps[start : start + _MESHES]
            meshes = subject.meshes([clip.poses[t] for t in block]).astype(np.float64)
            rows = range(start, start + len(block))
            for row, _ in zip(rows, pool.map(sample, rows, meshes)):
                progress(row + 1, len(timesteps), "mouths")
    return MouthColours(timesteps, list(cameras), colours, seen)


def sample_image(
    image: ByteArray, camera: Camera, atlas: MouthAtlas, vertices: FloatArray
) -> tuple[ByteArray, np.ndarray]:
    """Colours (H, W, 3) of the map's points in one image, and where (H, W) they are seen. A point is seen where it
    faces the camera within 62 degrees, lies in the picture and no triangle of the tracked mesh is in front of it."""
    colours = np.zeros((*atlas.inside.shape, 3), np.uint8)
    seen = np.zeros(atlas.inside.shape, bool)
    points = atlas.points(vertices)
    sight = camera.center - points
    cosine = np.einsum("nd,nd->n", atlas.normals(vertices), sight) / np.linalg.norm(sight, axis=1)
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = local[:, 2]
    if depth.min() <= 0:
        return colours, seen
    pixels = (local @ camera.K.T)[:, :2] / depth[:, None]
    crop, view = _crop(image, camera, pixels, float(np.median(depth)))
    if not crop.size:
        return colours, seen
    places = (local @ view.K.T)[:, :2] / depth[:, None]
    # OpenCV counts from pixel centres.
    columns, rows = ((places[:, None, i] - 0.5).astype(np.float32) for i in (0, 1))
    buffer = rasterize_mesh(vertices, atlas.occluders, view).depth
    # The farthest of the neighbouring depths: at an outline the nearest pixel's own may be the other side's.
    farthest = cv2.dilate(np.where(np.isfinite(buffer), buffer, 0), np.ones((3, 3)))
    front = cv2.remap(farthest, columns, rows, cv2.INTER_NEAREST)[:, 0]
    inside = ((places > 0.5) & (places < [view.width - 0.5, view.height - 0.5])).all(axis=1)
    visible = inside & (cosine > FACING) & (depth < front + _HIDDEN)
    values = cv2.remap(crop, columns, rows, cv2.INTER_LINEAR)[:, 0]
    colours[atlas.inside] = np.where(visible[:, None], values, 0)
    seen[atlas.inside] = visible
    return colours, seen


def _crop(image: ByteArray, camera: Camera, pixels: FloatArray, depth: float) -> tuple[ByteArray, Camera]:
    """The image around points (N, 2), reduced by area to about the map's pitch, and the camera that took it. Finer
    images are reduced to avoid sampling noise and pores."""
    factor = max(1, round(float(PITCH * camera.K[0, 0] / depth)))
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - _MARGIN * factor, 0, size)
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + _MARGIN * factor, low, size)
    width, height = (high - low) // factor
    crop = image[low[1] : low[1] + height * factor, low[0] : low[0] + width * factor]
    if factor > 1 and crop.size:
        crop = np.asarray(cv2.resize(crop, (int(width), int(height)), interpolation=cv2.INTER_AREA), np.uint8)
    K = np.array(camera.K, np.float64)
    K[:2, 2] -= low
    K[:2] /= factor
    return crop, Camera(camera.id, int(width), int(height), K, camera.world_to_camera)
