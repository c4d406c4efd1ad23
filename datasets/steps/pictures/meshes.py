"""Unposed heads drawn alike, so that only the expression differs from picture to picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ....bench.contracts import ByteArray, Clip, FloatArray, HeadPose
from ...head.model import HeadModel
from ...mesh_pictures import draw_mesh, portrait_camera

_YAW, _PITCH = 0.35, 0.0  # radians; a little from the side, so that the jaw's depth shows
_FILL = 0.92


def unposed_meshes(clip: Clip, poses: Sequence[HeadPose]) -> FloatArray:
    """(N, V, 3) meshes that keep expression, jaw, eyes and eyelids and lose rotation, neck and translation."""
    model = HeadModel(clip.head)
    shape, offset = (torch.from_numpy(np.asarray(a, np.float32)) for a in (clip.shape, clip.static_offset))
    still = [replace(pose, rotation=np.zeros(3), neck=np.zeros(3), translation=np.zeros(3)) for pose in poses]
    with torch.no_grad():
        return model(canonical=model.canonical(shape, offset), **model.pose_arguments(still)).numpy()


def draw_meshes(clip: Clip, meshes: FloatArray, width: int, height: int) -> list[ByteArray]:
    """Draw each of (N, V, 3) meshes with one camera; the camera shows the faces of all of them."""
    face = meshes[:, clip.head.regions.get("face", np.arange(meshes.shape[1]))]
    camera = portrait_camera(
        face.reshape(-1, 3).astype(np.float64), width, height, yaw=_YAW, pitch=_PITCH, fill=_FILL
    )
    return [draw_mesh(mesh, np.asarray(clip.head.faces), camera) for mesh in meshes]
