"""Cameras of a capture from per-frame JSON entries, with all sequences in one world.

VHAP shifts the world of each sequence by the mean of its tracked translation and does not store the shift.
A union of sequences therefore states each camera once per sequence, in worlds that differ by a translation.
Here that translation is recovered from the cameras, so that a clip has one position per camera; the poses of shifted
sequences must be moved accordingly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...bench.contracts import Camera, FloatArray
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo
from .layout import CyConvention, extrinsics_from_json, intrinsics_from_json
from .transforms import FrameEntry

ROTATION_TOLERANCE = 1e-5
POSITION_TOLERANCE = 2e-5  # metres; 0.04 px at a focal length of 2,000 px and a distance of 1 m
FOCAL_TOLERANCE = 0.01  # relative, between fl_x and camera_angle_x


@dataclass(frozen=True, eq=False)
class CaptureCameras:
    """Cameras of a capture and the shift of each sequence.

    Attributes
    ----------
    views : Mapping[str, FrameEntry]
        Representative frame entry by camera id, in the first sequence's world.
    sizes : Mapping[str, tuple[int, int]]
        (width, height) by camera id.
    shifts : Mapping[str, FloatArray]
        (3,) metres to add to positions of a sequence, by sequence folder; zero for the first.
    """

    views: Mapping[str, FrameEntry]
    sizes: Mapping[str, tuple[int, int]]
    shifts: Mapping[str, FloatArray]

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
    """Gather the cameras of all frames.

    Raises `InputError` if a camera moves or changes within a sequence, sequences differ by more than a translation, or
    ``camera_index`` and ``camera_id`` do not match.
    """
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
