"""Cameras of a capture from per-frame JSON entries, with all sequences in one world.

VHAP shifts the world of each sequence by the mean of its tracked translation and does not store the shift.
A union of sequences therefore states each camera once per sequence, in worlds that differ by a translation.
Here that translation is recovered from the cameras, so that a clip has one position per camera; the poses of shifted
sequences must be moved accordingly.

Infer from the images whether ``cy`` is measured from the top or the bottom edge. VHAP changed the convention in
November 2024, and its files do not state it. The two conventions differ by h - 2 cy pixels in every projection, so the
outline of the tracked mesh matches the outline of the foreground for only one of them. Hair and clothes hide parts of
the outline; the visible ones (brow, nose, chin, cheeks, ears) are decisive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo
from ...bench.protocol import evenly_with_ends
from ..head.geometry import project
from ..head.model import PosedSubject
from ..images import read_image, read_mask
from .layout import CyConvention, extrinsics_from_json, intrinsics_from_json
from .tracking import Tracking
from .transforms import FrameEntry

ROTATION_TOLERANCE = 1e-5
POSITION_TOLERANCE = 2e-5  # metres; 0.04 px at a focal length of 2,000 px and a distance of 1 m
FOCAL_TOLERANCE = 0.01  # relative, between fl_x and camera_angle_x


@dataclass(frozen=True, eq=False)
class CaptureCameras:
    """Cameras of a capture and the shift of each sequence."""

    views: Mapping[str, FrameEntry]
    """Representative frame entry by camera id, in the first sequence's world."""
    sizes: Mapping[str, tuple[int, int]]
    """(width, height) by camera id."""
    shifts: Mapping[str, FloatArray]
    """(3,) metres to add to positions of a sequence, by sequence folder; zero for the first."""

    def resolve(self, cy: CyConvention) -> dict[str, Camera]:
        """`Camera` by id, with the given convention of the principal point."""
        return {
            name: Camera(
                id=name,
                width=self.sizes[name][0],
                height=self.sizes[name][1],
                K=intrinsics_from_json(view.intrinsics, *self.sizes[name], cy),
                world_to_camera=extrinsics_from_json(view.camera_to_world),
            )
            for name, view in self.views.items()
        }

    def cy_matters(self) -> bool:
        """Whether measuring cy from the top or the bottom makes a difference: some cy is off-centre by > 0.5 px."""
        return any(
            abs(view.intrinsics.get("cy", self.sizes[name][1] / 2) - self.sizes[name][1] / 2) > 0.5
            for name, view in self.views.items()
        )


def collect_cameras(entries: Sequence[FrameEntry], infos: Mapping[Path, ImageInfo]) -> CaptureCameras:
    """Gather the cameras of all frames."""
    _check_ids(entries)
    sizes = {entry.image: (infos[entry.image].width, infos[entry.image].height) for entry in entries}
    groups: dict[str, dict[str, FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.timestep, e.camera_index)):
        first = groups.setdefault(entry.sequence_folder, {}).setdefault(entry.camera_id, entry)
        _check_same_optics(first, entry, sizes)
        moved = np.abs(first.camera_to_world - entry.camera_to_world).max()
        if moved > ROTATION_TOLERANCE:
            expected = f"camera {entry.camera_id} where {first.where} has it, since cameras are static"
            key = f"{entry.where}.transform_matrix"
            raise InputError(entry.file, key, expected, f"entries that differ by {moved:.3g}")
    views: dict[str, FrameEntry] = {}
    shifts: dict[str, FloatArray] = {}
    for folder, group in groups.items():
        shifts[folder] = _shift(views, group, sizes) if views else np.zeros(3)
        for name, entry in group.items():
            matrix = entry.camera_to_world.copy()
            matrix[:3, 3] += shifts[folder]
            views.setdefault(name, replace(entry, camera_to_world=matrix))
    for entry in views.values():
        _check_focal(entry, sizes[entry.image][0])
    ordered = dict(sorted(views.items(), key=lambda item: item[1].camera_index))
    return CaptureCameras(ordered, {name: sizes[entry.image] for name, entry in ordered.items()}, shifts)


def _check_ids(entries: Sequence[FrameEntry]) -> None:
    by_index: dict[int, FrameEntry] = {}
    by_id: dict[str, FrameEntry] = {}
    for entry in entries:
        pair = (entry.camera_id, entry.camera_index)
        same = by_index.setdefault(entry.camera_index, entry), by_id.setdefault(entry.camera_id, entry)
        for other in same:
            if (other.camera_id, other.camera_index) != pair:
                known = f"{other.where} with index {other.camera_index} has {other.camera_id}"
                expected, found = (
                    f"one camera_id per camera_index, as {known}",
                    f"index {pair[1]} with {pair[0]}",
                )
                raise InputError(entry.file, f"{entry.where}.camera_id", expected, found)


def _check_same_optics(first: FrameEntry, entry: FrameEntry, sizes: Mapping[Path, tuple[int, int]]) -> None:
    if not same_intrinsics(first, entry):
        key = f"{entry.where}.{'/'.join(entry.intrinsics)}"
        expected = f"intrinsics of camera {entry.camera_id} as in {first.where}, {dict(first.intrinsics)}"
        raise InputError(entry.file, key, expected, f"{dict(entry.intrinsics)}")
    (width, height), found = sizes[first.image], sizes[entry.image]
    if (width, height) != found:
        expected = f"{width}x{height} pixels, as other images of camera {entry.camera_id}"
        raise InputError(entry.image, "", expected, f"{found[0]}x{found[1]}")


def same_intrinsics(one: FrameEntry, other: FrameEntry) -> bool:
    """Whether two frames have the same intrinsics up to rounding."""
    return one.intrinsics.keys() == other.intrinsics.keys() and all(
        math.isclose(value, other.intrinsics[key], rel_tol=1e-6, abs_tol=1e-9)
        for key, value in one.intrinsics.items()
    )


def _shift(
    views: Mapping[str, FrameEntry], group: Mapping[str, FrameEntry], sizes: Mapping[Path, tuple[int, int]]
) -> FloatArray:
    """Translation from a sequence's world to that of the first, from their common cameras."""
    shared = [name for name in group if name in views]
    any_entry = next(iter(group.values()))
    if not shared:
        expected = "a camera that the first sequence also has, to align both worlds"
        raise InputError(any_entry.file, any_entry.where, expected, f"cameras {', '.join(group)} only")
    for name in shared:
        _check_same_optics(views[name], group[name], sizes)
    differences = np.array([views[n].camera_to_world - group[n].camera_to_world for n in shared])
    shift = differences[:, :3, 3].mean(axis=0)
    turn = np.abs(differences[:, :3, :3]).max()
    spread = np.abs(differences[:, :3, 3] - shift).max()
    if turn > ROTATION_TOLERANCE or spread > POSITION_TOLERANCE:
        folder = any_entry.sequence_folder
        expected = f"cameras of {folder} that equal those of the first sequence up to one shift"
        found = f"rotations that differ by {turn:.3g} and shifts by {spread:.3g} m"
        raise InputError(any_entry.file, f"{any_entry.where}.transform_matrix", expected, found)
    # A difference within the stored precision is ignored, so that cameras are unchanged.
    return shift if np.abs(shift).max() > 1e-9 else np.zeros(3)


def contradicted_focal(entry: FrameEntry, width: int) -> float | None:
    """Focal length implied by ``camera_angle_x``, pixels, if ``fl_x`` differs."""
    if not {"fl_x", "camera_angle_x"} <= entry.intrinsics.keys():
        return None
    implied = width / (2 * math.tan(entry.intrinsics["camera_angle_x"] / 2))
    return implied if abs(entry.intrinsics["fl_x"] / implied - 1) > FOCAL_TOLERANCE else None


def _check_focal(entry: FrameEntry, width: int) -> None:
    implied = contradicted_focal(entry, width)
    if implied is not None:
        expected = f"{implied:.6g} px, which camera_angle_x and a width of {width} px imply"
        remedy = "The intrinsics were probably not scaled with the images."
        found = f"{entry.intrinsics['fl_x']:.6g}"
        raise InputError(entry.file, f"{entry.where}.fl_x", expected, found, remedy)


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
