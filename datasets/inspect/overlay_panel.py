"""The tracked mesh on images: its outline on one copy, itself on another."""

from __future__ import annotations

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, IntArray
from ..clip import CaptureClip
from ..mesh_pictures import draw_mesh, rasterize_mesh
from .canvas import HELD_OUT
from .statistics import ExpressionSpace

MESH_OPACITY = 0.72
OUTLINE = HELD_OUT


def pick_cameras(clip: CaptureClip, count: int) -> list[str]:
    """Up to ``count`` camera ids: one held-out first, then evenly over the others in the order of the rig."""
    held_out = {key.camera for key in clip.splits.get("novel_view", ())}
    first = [name for name in clip.cameras if name in held_out][:1]
    others = [name for name in clip.cameras if name not in first]
    picks = np.unique(np.linspace(0, len(others) - 1, max(0, min(count - len(first), len(others)))).round())
    return (first + [others[int(i)] for i in picks])[:count]


def pick_timesteps(clip: CaptureClip, space: ExpressionSpace, count: int) -> list[tuple[int, str]]:
    """Up to ``count`` timesteps with the reason for each: the calmest, the widest jaw, the most unusual test
    face, then evenly spaced ones."""
    size = np.linalg.norm(space.scores_mm - space.scores_mm.mean(axis=0), axis=1)
    jaw = [float(np.linalg.norm(clip.poses[t].jaw)) for t in space.timesteps]
    calm = [float(np.linalg.norm(clip.poses[t].expression)) for t in space.timesteps]
    wanted = [
        (space.timesteps[int(np.argmin(calm))], "calmest face"),
        (space.timesteps[int(np.argmax(jaw))], "widest jaw"),
    ]
    if space.novelty_mm:
        newest = max(space.novelty_mm, key=lambda t: space.novelty_mm[t])
        wanted.append((newest, "test face farthest from training"))
    wanted.append((space.timesteps[int(np.argmax(size))], "strongest expression"))
    spread = np.linspace(0, len(space.timesteps) - 1, count + 2).round().astype(int)[1:-1]
    wanted += [(space.timesteps[i], "evenly spaced") for i in spread]
    chosen: dict[int, str] = {}
    for timestep, reason in wanted:
        chosen.setdefault(timestep, reason)
    return list(chosen.items())[:count]


def frame_of(clip: CaptureClip, timestep: int, camera: str) -> FrameKey | None:
    """Key of a frame of the clip, None where the camera did not record that timestep."""
    return next((k for k in clip.files if (k.timestep, k.camera) == (timestep, camera)), None)


def overlay(
    image: ByteArray, vertices: FloatArray, faces: IntArray, camera: Camera, height: int
) -> tuple[ByteArray, ByteArray]:
    """The image with the mesh's outline, and under the shaded mesh, both ``height`` pixels high."""
    width = max(1, round(camera.width * height / camera.height))
    smaller = height < camera.height
    scaled = cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    ).astype(np.uint8, copy=False)
    fitted = camera.resized(width, height)
    filled = (rasterize_mesh(vertices, faces, fitted).face >= 0).astype(np.uint8)
    contours, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = scaled.copy()
    cv2.drawContours(outlined, contours, -1, OUTLINE, max(1, round(height / 300)), cv2.LINE_AA)
    covered = draw_mesh(vertices, faces, fitted, background=scaled, opacity=MESH_OPACITY)
    return outlined, covered


def blank(width: int, height: int) -> ByteArray:
    """A light grey field for a frame that was not recorded."""
    return np.full((height, width, 3), 238, dtype=np.uint8)


def pair(one: ByteArray, other: ByteArray) -> ByteArray:
    """Two pictures side by side."""
    return np.concatenate([one, other], axis=1)
