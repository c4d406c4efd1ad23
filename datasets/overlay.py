"""Overlays of the tracked mesh on images, for visual inspection of the tracking."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..bench.contracts import ByteArray
from .clip import CaptureClip
from .head.subject import PosedSubject
from .mesh_pictures import draw_mesh


def draw_overlay(clip: CaptureClip, timesteps: Sequence[int], cameras: Sequence[str]) -> ByteArray:
    """Images of some timesteps (rows) and cameras, and beside each one the mesh over it.

    Returns (H, W, 3) 8-bit sRGB. Images of another size than the first are left out.
    """
    subject, rows = PosedSubject.of(clip), []
    height, width = clip.image(clip.frame_at[timesteps[0], cameras[0]]).shape[:2]
    for timestep, mesh in subject.each(clip, timesteps):
        row = []
        for name in cameras:
            camera = clip.cameras[name].resized(width, height)
            image = clip.image(clip.frame_at[timestep, name])
            if image.shape[:2] != (height, width):
                continue
            row += [image, draw_mesh(mesh, clip.head.faces, camera, background=image, opacity=0.6)]
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)
