"""Infer from the images whether ``cy`` is measured from the top or the bottom edge.

VHAP changed the convention in November 2024, and its files do not state it. The two conventions differ by h - 2 cy
pixels in every projection, so the outline of the tracked mesh matches the outline of the foreground for only one of
them. Hair and clothes hide parts of the outline; the visible ones (brow, nose, chin, cheeks, ears) are decisive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.protocol import evenly_with_ends
from ..head.geometry import project
from ..head.subject import PosedSubject
from ..images import read_image, read_mask
from .cameras import CaptureCameras
from .layout import CyConvention
from .tracking import Tracking
from .transforms import FrameEntry

OUTLINE_SIGMA = 0.004
"""Tolerance of the agreement of outlines, as a fraction of the image height."""

MARGIN = 0.05
"""Minimum relative difference between the two agreements for a decision."""

VOTES = 0.75
"""Minimum fraction of the frames with the same result."""

FRAMES = 24
"""Frames to judge by."""

FOREGROUND_LEVELS = 8
"""Minimum difference from the background of foreground pixels without a mask, 8-bit levels."""

_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class CyEvidence:
    """Agreement of outlines for each convention, means over frames in [0, 1], and the fraction of frames in favour of
    the top. ``decision`` is None without a clear result."""

    top: float
    bottom: float
    votes_for_top: float

    @property
    def decision(self) -> Literal["top", "bottom"] | None:
        best = max(self.top, self.bottom)
        if best <= 0 or abs(self.top - self.bottom) < MARGIN * best:
            return None
        if self.top > self.bottom:
            return "top" if self.votes_for_top >= VOTES else None
        return "bottom" if self.votes_for_top <= 1 - VOTES else None


@dataclass(frozen=True, eq=False)
class OutlineView:
    """A sample frame: the posed mesh (V, 3) in the world, the camera with cy from the top, the mask."""

    vertices: FloatArray
    camera: Camera
    mask: Callable[[], ByteArray]


def settle_cy(
    folder: Path,
    asked: CyConvention | Literal["auto"],
    declared: CyConvention | None,
    rig: CaptureCameras,
    tracking: Tracking,
    poses: Mapping[int, HeadPose],
    entries: Sequence[FrameEntry],
    background: Sequence[float],
) -> tuple[CyConvention, dict[str, Any]]:
    """Choose the convention of ``cy``: as requested, else as declared, else inferred from the images.

    Returns the convention and its reason, for the step record. Raises `InputError` if it makes a difference (some |cy
    - h/2| > 0.5 px) and the images are inconclusive.
    """
    if asked != "auto":
        return asked, {"source": "argument"}
    if declared is not None:
        return declared, {"source": "declaration"}
    if not rig.cy_matters():
        return "top", {"source": "immaterial, within 0.5 px of the centre"}
    evidence = weigh_cy(_pick_views(rig, tracking, poses, entries, background), tracking.head.faces)
    if evidence.decision is None:
        expected = "outlines of the tracked mesh and the foreground that agree better under one reading of cy"
        found = f"agreement {evidence.top:.3f} with cy from the top, {evidence.bottom:.3f} from the bottom"
        remedy = (
            'State the convention: cy="bottom" for VHAP exports since November 2024, "top" for older ones, '
            '"centre" to ignore the principal point as GaussianAvatars does.'
        )
        raise InputError(folder, "cy", expected, found, remedy)
    return evidence.decision, {"source": "outlines", **asdict(evidence)}


def _pick_views(
    rig: CaptureCameras,
    tracking: Tracking,
    poses: Mapping[int, HeadPose],
    entries: Sequence[FrameEntry],
    background: Sequence[float],
) -> list[OutlineView]:
    """Up to `FRAMES` frames, spread over timesteps and cameras (by a stride coprime to most rig sizes)."""
    cameras = rig.resolve("top")
    ordered = sorted(entries, key=lambda e: (e.timestep, e.camera_index))
    chosen = evenly_with_ends(ordered, FRAMES)
    subject = PosedSubject(tracking.head, tracking.shape, tracking.static_offset)
    return [
        OutlineView(mesh, cameras[entry.camera_id], partial(_foreground, entry, background))
        for entry, mesh in zip(chosen, subject.meshes([poses[entry.timestep] for entry in chosen]))
    ]


def _foreground(entry: FrameEntry, background: Sequence[float]) -> ByteArray:
    """The frame's mask, or without one the pixels that differ from the background."""
    if entry.mask is not None:
        return read_mask(entry.mask)
    levels = np.round(np.asarray(background) * 255)
    different = np.abs(read_image(entry.image, background) - levels).max(axis=2) > FOREGROUND_LEVELS
    return (different * 255).astype(np.uint8)


def weigh_cy(views: Sequence[OutlineView], faces: IntArray) -> CyEvidence:
    """Compare both conventions of ``cy`` over some frames.

    For each frame: the mesh is projected and filled; agreement is the mean over its outline's pixels of
    exp(-(d / sigma)^2) with d the distance to the foreground's outline. The image border is not part of the outline.
    """
    top, bottom = [], []
    for view in views:
        foreground = (view.mask() > 127).astype(np.uint8)
        distance = _distance_to_outline(foreground)
        flipped = view.camera.height - 2 * float(view.camera.K[1, 2])
        projected = project(view.vertices, view.camera)
        top.append(_agreement(projected, faces, distance))
        bottom.append(_agreement(projected + np.array([0.0, flipped]), faces, distance))
    favour = np.sign(np.array(top) - np.array(bottom))
    return CyEvidence(float(np.mean(top)), float(np.mean(bottom)), float(np.mean((favour + 1) / 2)))


def _agreement(pixels: FloatArray, faces: IntArray, distance: FloatArray) -> float:
    height, width = distance.shape
    filled = np.zeros((height, width), dtype=np.uint8)
    # Pixel centres are at half-integers here and at integers in OpenCV.
    corners = np.round((pixels - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)
    limit = 2**20  # far outside any image, near enough for fixed-point arithmetic
    triangles = np.clip(corners, -limit, limit)[faces]
    for triangle in triangles:
        cv2.fillConvexPoly(filled, triangle, 1, shift=_SUBPIXEL_BITS)
    outline = _outline(filled)
    if not outline.any():
        return 0.0
    scale = max(1.0, OUTLINE_SIGMA * height)
    return float(np.exp(-((distance[outline] / scale) ** 2)).mean())


def _outline(filled: ByteArray) -> np.ndarray:
    """Pixels of a filled shape next to unfilled ones; none where the image border cuts the shape."""
    eroded = cv2.erode(filled, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return (filled > 0) & (eroded == 0)


def _distance_to_outline(foreground: ByteArray) -> FloatArray:
    """(H, W) distance in pixels to the foreground's outline; a large value everywhere without one."""
    outline = _outline(foreground)
    if not outline.any():
        return np.full(foreground.shape, np.inf)
    distance = cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance.astype(np.float64)
