"""The tracked mesh visible in the pixels of a frame, for masks that programs otherwise take from a network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadAsset, HeadPose, IntArray
from ...datasets.head.model import PosedSubject, pose_in_head_frame
from ..insta.marching import CanonicalSurface, PosedSurface
from ..insta.rendering import camera_rays
from ..shared.subject_mesh import pose_key


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """The surface in P covered pixels of a frame.

    Attributes
    ----------
    rows, columns : IntArray
        (P,) the pixels.
    triangles : IntArray
        (P,) first triangle of the head on the ray of each; -1 for pixels beside the mesh.
    depths : FloatArray
        (P,) metres along the camera's axis; not defined for pixels beside the mesh.
    vertices : FloatArray
        (V, 3) the posed mesh in the head's frame, metres.
    """

    rows: IntArray
    columns: IntArray
    triangles: IntArray
    depths: FloatArray
    vertices: FloatArray

    @property
    def hit(self) -> np.ndarray:
        """(P,) whether a pixel shows the mesh."""
        return np.asarray(self.triangles >= 0)


class VisibleMesh:
    """Casts rays at the mesh of a subject in the head's frame; the mesh of the last pose is cached."""

    def __init__(self, head: HeadAsset, posed: PosedSubject):
        self._posed = posed
        self._surface = CanonicalSurface(head, torch.from_numpy(posed.neutral))
        self._last: tuple[bytes, PosedSurface] | None = None

    def seen(self, pose: HeadPose, camera: Camera, coverage: ByteArray) -> VisibleSurface:
        """The surface in the pixels that an (H, W) mask covers, for a camera in the head's frame."""
        rows, columns = np.nonzero(coverage)
        rays = camera_rays(camera, columns, rows, 0.0)
        surface = self._of(pose)
        found = surface.first_hit(rays)
        along = rays.directions @ np.asarray(camera.world_to_camera[2, :3])
        vertices = np.asarray(surface.vertices.numpy(), np.float64)
        return VisibleSurface(rows, columns, found.triangles.numpy(), found.values.numpy() * along, vertices)

    def _of(self, pose: HeadPose) -> PosedSurface:
        still = pose_in_head_frame(pose)
        key = pose_key(still)
        if self._last is None or self._last[0] != key:
            self._last = key, self._surface.pose(torch.from_numpy(self._posed.meshes([still])[0]))
        return self._last[1]
