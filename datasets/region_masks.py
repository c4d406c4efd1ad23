"""Masks of the parts of the tracked head in a frame: from the posed mesh by a z-buffer, and from the mask.

* ``foreground``: pixels that the mask covers by half or more.
* ``face``: the mesh's face, lips, eyes and the opening of the mouth, where the mesh does not hide them.
* ``mouth``: the convex hull of the visible lips, so that teeth, tongue and the dark between them belong to it.
* ``eyes``: eyeballs and the skin about them.
* ``neck`` and ``ears``: those of the mesh, where it does not hide them.
* ``hair``: the mesh's scalp, and foreground beyond the mesh whose nearest pixel of the mesh is scalp: hair extends
  beyond the head. Hair beside the neck is included.

Mouth and hair are limited to the foreground, if there is a mask. Regions are as accurate as the tracking.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import cv2
import numpy as np

from ..bench.contracts import BoolArray, ByteArray, Camera, FloatArray, HeadPose, IntArray
from .head.arrays import HeadArrays
from .head.subject import PosedSubject
from .mesh_pictures import rasterize_mesh

FOREGROUND = "foreground"
PARTS: Mapping[str, tuple[str, ...]] = {
    "face": ("face", "lips", "eye_region", "left_eyeball", "right_eyeball"),
    "mouth": ("lips",),
    "eyes": ("eye_region", "left_eyeball", "right_eyeball"),
    "hair": ("scalp",),
    "neck": ("neck", "boundary"),
    "ears": ("left_ear", "right_ear"),
}
"""Regions of the head model that form each part; missing ones are skipped."""

_NEEDED = {name: regions[0] for name, regions in PARTS.items()}
_BITS = {name: 1 << bit for bit, name in enumerate((FOREGROUND, *PARTS))}


class HeadRegions:
    """The parts of one subject's head, for masks of frames. Thread-safe."""

    def __init__(self, head: HeadArrays, shape: FloatArray, static_offset: FloatArray) -> None:
        self._head, self._shape, self._offset = head, shape, static_offset

    @property
    def names(self) -> tuple[str, ...]:
        """The parts that the head model has the regions for."""
        return tuple(name for name in PARTS if _NEEDED[name] in self._head.regions)

    def labels(self, camera: Camera, pose: HeadPose, mask: ByteArray | None) -> ByteArray:
        """(H, W) 8-bit, one bit for each region that a pixel is in; see `select`.

        ``mask`` is the (H, W) 8-bit coverage; with None nothing is foreground.
        """
        front = rasterize_mesh(self._subject.meshes([pose])[0], self._head.faces, camera).face
        covered = front >= 0
        labels = np.where(covered, self._bits_of_faces[np.maximum(front, 0)], 0).astype(np.uint8)
        foreground = np.ones(front.shape, bool) if mask is None else mask >= 128
        mouth = _hull(labels & _BITS["mouth"] != 0) & foreground
        labels[mouth] |= _BITS["mouth"] | _BITS["face"]
        if mask is not None:
            labels[foreground] |= _BITS[FOREGROUND]
            labels[_beyond(covered, labels & _BITS["hair"] != 0) & foreground] |= _BITS["hair"]
        return labels

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W) distance of the mesh along the camera's axis, metres; infinity beside it."""
        return rasterize_mesh(self._subject.meshes([pose])[0], self._head.faces, camera).depth

    @cached_property
    def _subject(self) -> PosedSubject:
        return PosedSubject(self._head, self._shape, self._offset)

    @cached_property
    def _bits_of_faces(self) -> IntArray:
        """(F,) bits of the parts that contain at least two corners of a triangle, so that seams have no gaps."""
        regions, faces = self._head.regions, self._head.faces
        bits = np.zeros(len(faces), dtype=np.uint8)
        for name in self.names:
            inside = np.zeros(len(self._head.template), dtype=bool)
            for region in regions.keys() & set(PARTS[name]):
                inside[regions[region]] = True
            if name == "hair":
                # The scalp of FLAME's masks runs into face and neck.
                for region in regions.keys() & {"face", "neck"}:
                    inside[regions[region]] = False
            bits[inside[faces].sum(axis=1) >= 2] |= _BITS[name]
        return bits


def select(labels: ByteArray, name: str) -> BoolArray:
    """(H, W) mask of one region from the bits of `HeadRegions.labels`."""
    return (labels & _BITS[name]) != 0


def _hull(seen: BoolArray) -> BoolArray:
    """Fill the convex hull of some pixels."""
    points = cv2.findNonZero(seen.astype(np.uint8))
    if points is None:
        return seen
    filled = np.zeros(seen.shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled != 0


def _beyond(covered: BoolArray, part: BoolArray) -> BoolArray:
    """Pixels that are not covered and whose nearest covered pixel is in a part."""
    if not part.any():
        return part
    _, nearest = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    is_part = np.zeros(int(nearest.max()) + 1, dtype=bool)
    is_part[nearest[part]] = True
    return np.asarray(is_part[nearest] & ~covered)
