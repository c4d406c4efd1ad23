"""Bring every frame's colours into the mouth's map: what each point of lips and chin looks like, when it shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray, FrameKey, Progress, no_progress
from ....bench.errors import InputError
from ....bench.machine import processor_count
from ...head.model import HeadModel
from ...mesh_pictures import rasterize_mesh
from .atlas import PITCH, MouthAtlas

FACING = np.cos(np.radians(62.0))
"""Cosine of the angle between surface and line of sight beyond which a pixel of the image says little."""

_MOUTH_FACING = np.cos(np.radians(55.0))
_HIDDEN = 0.0025  # metres behind the surface in front from which on a point counts as hidden
_MARGIN = 3  # pixels around the mouth
_MESHES = 32  # posed at once


@dataclass(frozen=True, eq=False)
class MouthColours:
    """Colours of T timesteps in up to C cameras, in the map's layout.

    Attributes
    ----------
    timesteps : sorted.
    cameras : ids by position.
    colours : (T, C, H, W, 3) 8-bit sRGB; 0 where not seen.
    seen : (T, C, H, W).
    """

    timesteps: Sequence[int]
    cameras: Sequence[str]
    colours: ByteArray
    seen: np.ndarray


def frames_by_timestep(clip: Clip) -> dict[int, dict[str, FrameKey]]:
    """Every frame of a clip, excluded ones too: key by camera, by timestep."""
    found: dict[int, dict[str, FrameKey]] = {}
    for key in sorted({*(k for keys in clip.splits.values() for k in keys), *clip.excluded}):
        found.setdefault(key.timestep, {})[key.camera] = key
    return dict(sorted(found.items()))


def facing_cameras(clip: Clip, atlas: MouthAtlas, count: int) -> list[str]:
    """Ids of the ``count`` cameras that the mouth faces most, over poses spread along the clip.

    Raises `InputError` where it faces none within 55 degrees.
    """
    timesteps = list(frames_by_timestep(clip))
    spread = [timesteps[i] for i in np.unique(np.linspace(0, len(timesteps) - 1, 15).round().astype(int))]
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
        raise InputError(
            "clip", "cameras", "a camera that sees the mouth within 55 degrees", f"{best:.0f} degrees"
        )
    return chosen[:count]


def posed_meshes(clip: Clip, timesteps: Sequence[int]) -> Iterator[tuple[int, FloatArray]]:
    """(timestep, (V, 3) tracked mesh in metres), a few posed at a time."""
    model = HeadModel(clip.head)
    shape, offset = (torch.from_numpy(np.asarray(a, np.float32)) for a in (clip.shape, clip.static_offset))
    canonical = model.canonical(shape, offset)
    for start in range(0, len(timesteps), _MESHES):
        part = timesteps[start : start + _MESHES]
        with torch.no_grad():
            meshes = model(canonical=canonical, **model.pose_arguments([clip.poses[t] for t in part])).numpy()
        yield from zip(part, meshes.astype(np.float64))


def sample_clip(
    clip: Clip, atlas: MouthAtlas, cameras: Sequence[str], progress: Progress = no_progress
) -> MouthColours:
    """Sample every timestep of a clip in the given cameras; each image is read once.

    Memory: the result (20 kB per timestep and camera for a map of 50 x 50) and a few images at a time.
    """
    frames = frames_by_timestep(clip)
    timesteps = [t for t, keys in frames.items() if any(camera in keys for camera in cameras)]
    height, width = atlas.shape
    colours = np.zeros((len(timesteps), len(cameras), height, width, 3), np.uint8)
    seen = np.zeros(colours.shape[:4], bool)

    def sample(row: int, vertices: FloatArray) -> None:
        keys = frames[timesteps[row]]
        for column, name in enumerate(cameras):
            if name in keys:
                picture, visible = sample_image(clip.image(keys[name]), clip.cameras[name], atlas, vertices)
                colours[row, column], seen[row, column] = picture, visible

    done = 0
    with ThreadPoolExecutor(min(processor_count(), 8)) as pool:
        batch: list[tuple[int, FloatArray]] = []
        for row, (_, vertices) in enumerate(posed_meshes(clip, timesteps)):
            batch.append((row, vertices))
            if len(batch) == _MESHES or row == len(timesteps) - 1:
                for _ in pool.map(lambda job: sample(*job), batch):
                    done += 1
                    progress(done, len(timesteps), "mouths")
                batch = []
    return MouthColours(timesteps, list(cameras), colours, seen)


def sample_image(
    image: ByteArray, camera: Camera, atlas: MouthAtlas, vertices: FloatArray
) -> tuple[ByteArray, np.ndarray]:
    """Colours (H, W, 3) of the map's points in one image, and where (H, W) they are seen.

    A point is seen where it faces the camera within 62 degrees, lies in the picture and no triangle of the
    tracked mesh is in front of it.
    """
    colours = np.zeros((*atlas.shape, 3), np.uint8)
    seen = np.zeros(atlas.shape, bool)
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
    """The image around points (N, 2), reduced by area to about the map's pitch, and the camera that took it.

    Finer images are reduced because noise and pores would be sampled otherwise.
    """
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
