"""HB501 to HB512: positions, orientations and pixel coordinates of cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import cast

import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from ...bench.progress import counted, some
from ..ga import layout
from ..ga.cameras import ROTATION_TOLERANCE, OutlineView, contradicted_focal, same_intrinsics, weigh_cy
from ..ga.transforms import FrameEntry
from .evidence import Evidence, first_entries
from .rules import Hit, at, rule

SAME_PLACE_M = 1e-3
SAME_TURN = 2e-3
"""Cameras closer than this in position (metres) and in every rotation entry are identical."""

NEAR_M, FAR_M = 0.15, 10.0
"""Range of plausible distances of a head from a camera, metres."""

OFF_CENTRE = 0.25
"""Fraction of the image's side above which the offset of a principal point is suspicious."""

TELLING_PX = 1.0
"""Minimum offset of cy for the comparison of outlines; the two conventions differ by twice as much."""

TELLING_AGREEMENT = 0.1
"""Minimum agreement of outlines; below it for both conventions of cy, there is another fault."""

EXACT = 1e-4
"""Pixels; a principal point this close to (w - 1) / 2 is assumed to be computed as such."""


@rule("HB501", "error", of_layout=True, refused=True)
def _not_rigid(evidence: Evidence) -> Iterator[Hit]:
    """A camera's matrix is not a rigid motion.

    Write camera-to-world with a right-handed rotation and no scale; put scale into the world instead.
    """
    errors = evidence.faults.errors("frame")
    broken = [error for error in errors if error.key.endswith(".transform_matrix")]
    if broken:
        text = (
            f"{counted(len(broken), 'frame')} with a transform_matrix that is not a rigid motion: "
            f"{broken[0].found}"
        )
        yield Hit(text, broken[0].file, broken[0].key)


@rule("HB502", "error")
def _same_camera(evidence: Evidence) -> Iterator[Hit]:
    """Two cameras are identical.

    Correct the calibration, or drop one: with one held out, a novel view is a training view.
    """
    groups: dict[str, dict[str, FrameEntry]] = {}
    for entry in evidence.entries:
        groups.setdefault(entry.sequence_folder, {}).setdefault(entry.camera_id, entry)
    seen: set[tuple[str, str]] = set()
    for views in groups.values():
        for one, other in combinations(sorted(views), 2):
            difference = np.abs(views[one].camera_to_world - views[other].camera_to_world)
            same = difference[:3, 3].max() < SAME_PLACE_M and difference[:3, :3].max() < SAME_TURN
            if same and (one, other) not in seen:
                seen.add((one, other))
                text = f"cameras {one} and {other} have the same position and orientation"
                yield Hit(text, *at(views[other], "transform_matrix"))


@rule("HB512", "error")
def _moving(evidence: Evidence) -> Iterator[Hit]:
    """A camera moves within a sequence.

    Cameras of the layout are static; for a moving camera move the head instead.
    """
    first: dict[tuple[str, str], FrameEntry] = {}
    moved: dict[str, FrameEntry] = {}
    changed: dict[str, FrameEntry] = {}
    for entry in evidence.entries:
        other = first.setdefault((entry.sequence_folder, entry.camera_id), entry)
        if np.abs(entry.camera_to_world - other.camera_to_world).max() > ROTATION_TOLERANCE:
            moved.setdefault(entry.camera_id, entry)
        if not same_intrinsics(entry, other):
            changed.setdefault(entry.camera_id, entry)
    for entries, what in ((moved, "moves"), (changed, "changes its intrinsics")):
        for camera, entry in list(entries.items())[:1]:
            others = f" (and {len(entries) - 1} more)" if len(entries) > 1 else ""
            yield Hit(f"camera {camera}{others} {what} within a sequence", entry.file, entry.where)


def behind(evidence: Evidence) -> list[str]:
    """Cameras that have the head behind them."""
    return sorted({v.entry.camera_id for v in evidence.views if v.mesh is not None and v.mesh.depth <= 0})


def upside_down(evidence: Evidence) -> list[str]:
    """Cameras that show the head upside down in most of their frames."""
    seen: dict[str, list[float]] = {}
    for view in evidence.views:
        if view.mesh is not None and view.mesh.depth > 0:
            seen.setdefault(view.entry.camera_id, []).append(view.mesh.upright)
    return sorted(camera for camera, values in seen.items() if np.median(values) < -0.3)


@rule("HB503", "error")
def _behind(evidence: Evidence) -> Iterator[Hit]:
    """The head is behind a camera.

    Write camera-to-world with OpenGL axes (looking along -z); OpenCV's matrix needs its columns 2 and 3
    negated, world-to-camera needs inverting.
    """
    yield from _cameras(evidence, behind(evidence), "have the head behind them")


@rule("HB504", "error")
def _upside_down(evidence: Evidence) -> Iterator[Hit]:
    """A camera sees the head upside down.

    Negate the y axis once, not twice: the layout's cameras have y up, OpenCV's y down.
    """
    yield from _cameras(evidence, upside_down(evidence), "see the head upside down")


def _cameras(evidence: Evidence, cameras: Iterable[str], what: str) -> Iterator[Hit]:
    names = list(cameras)
    if names:
        entry = first_entries(evidence)[names[0]]
        key = f"{entry.where}.transform_matrix"
        yield Hit(f"{counted(len(names), 'camera')} {what}: {some(names)}", entry.file, key)


def implausible_distance(evidence: Evidence) -> float | None:
    """Median distance of the head from the cameras, metres, if it is implausible."""
    distances = [view.mesh.distance for view in evidence.views if view.mesh is not None]
    median = float(np.median(distances)) if distances else NEAR_M
    return None if NEAR_M <= median <= FAR_M else median


def misplaced(evidence: Evidence) -> bool:
    """Whether errors of cameras prevent a comparison of images and mesh."""
    return bool(behind(evidence) or upside_down(evidence) or implausible_distance(evidence) is not None)


@rule("HB505", "error")
def _distance(evidence: Evidence) -> Iterator[Hit]:
    """The head's distance is not in metres.

    Bring translations of cameras and tracking to metres; recordings are often in millimetres.
    """
    median = implausible_distance(evidence)
    if median is not None:
        entry = evidence.entries[0]
        yield Hit(f"the head is {median:.3g} m from the cameras (median)", *at(entry, "transform_matrix"))


def _size(evidence: Evidence, entry: FrameEntry) -> tuple[int, int] | None:
    info = evidence.headers.get(entry.image)
    return (info.width, info.height) if info else None


def _contradicted(evidence: Evidence) -> list[tuple[str, FrameEntry, float]]:
    """Cameras whose focal length differs from that implied by their angle of view, and the latter in pixels."""
    wrong = []
    for camera, entry in first_entries(evidence).items():
        size = _size(evidence, entry)
        implied = contradicted_focal(entry, size[0]) if size else None
        if implied is not None:
            wrong.append((camera, entry, implied))
    return wrong


@rule("HB506", "error", of_layout=True, refused=True)
def _focal(evidence: Evidence) -> Iterator[Hit]:
    """Focal length and angle of view disagree.

    Scale fl_x with the images; codes that read only camera_angle_x would see another camera.
    """
    wrong = _contradicted(evidence)
    if wrong:
        camera, entry, implied = wrong[0]
        yield Hit(
            f"in {counted(len(wrong), 'camera')} fl_x and camera_angle_x disagree: {camera} has fl_x "
            f"{entry.intrinsics['fl_x']:.6g} px where its angle and the image's width imply {implied:.6g}",
            *at(entry, "fl_x"),
        )


def principal_offsets(evidence: Evidence) -> dict[str, FloatArray]:
    """(2,) pixels from the image's centre to the stated principal point, by camera; cameras that state one. The
    vertical offset is as stated: if cy is measured from the bottom, positive is up."""
    offsets: dict[str, FloatArray] = {}
    for camera, entry in first_entries(evidence).items():
        size = _size(evidence, entry)
        if size is not None and {"cx", "cy"} <= entry.intrinsics.keys():
            stated = np.array([entry.intrinsics["cx"], entry.intrinsics["cy"]])
            offsets[camera] = stated - np.array(size) / 2
    return offsets


@rule("HB507", "warning")
def _far_principal_point(evidence: Evidence) -> Iterator[Hit]:
    """A principal point is far from the centre.

    Scale and crop cx, cy with the images, or make sure that the crop is intended.
    """
    entries = first_entries(evidence)
    for camera, offset in principal_offsets(evidence).items():
        size = _size(evidence, entries[camera])
        if size is not None and (np.abs(offset) > OFF_CENTRE * np.array(size)).any():
            entry = entries[camera]
            yield Hit(
                f"the principal point of camera {camera} is ({entry.intrinsics['cx']:.6g}, "
                f"{entry.intrinsics['cy']:.6g}) in an image of {size[0]}x{size[1]}",
                *at(entry, "cx"),
            )
            return


@rule("HB508", "warning")
def _half_pixel(evidence: Evidence) -> Iterator[Hit]:
    """Principal points are off by half a pixel.

    Use w / 2, h / 2 for a centred camera: here the centre of the first pixel is at 0.5, not at 0.
    """
    offsets = principal_offsets(evidence)
    if offsets and all(np.abs(np.abs(offset) - 0.5).max() < EXACT for offset in offsets.values()):
        entry = next(iter(first_entries(evidence).values()))
        yield Hit("every principal point is exactly half a pixel from the image's centre", *at(entry, "cx"))


@rule("HB509", "warning", of_layout=True)
def _centred(evidence: Evidence) -> Iterator[Hit]:
    """The stated principal point is ignored.

    Declare "top" or "bottom", unless the loss of GaussianAvatars' centred camera is to be reproduced.
    """
    offsets = principal_offsets(evidence)
    worst = max((float(np.linalg.norm(o)) for o in offsets.values()), default=0.0)
    if evidence.convention == "centre" and worst > 0.5:
        yield Hit(
            f"the principal point is assumed at the image's centre, the JSONs state it up to {worst:.2f} px off",
            evidence.folder / layout.DECLARATION_FILE,
            "cy",
        )


@rule("HB510", "note")
def _ignored(evidence: Evidence) -> Iterator[Hit]:
    """Official code would centre the principal point.

    GaussianAvatars and derived code ignore cx, cy: their renders are shifted by this offset.
    """
    offsets = principal_offsets(evidence)
    worst = max((float(np.linalg.norm(o)) for o in offsets.values()), default=0.0)
    if evidence.convention != "centre" and worst > 1.0:
        camera = max(offsets, key=lambda name: float(np.linalg.norm(offsets[name])))
        entry = first_entries(evidence)[camera]
        yield Hit(
            f"the principal point is up to {worst:.1f} px off the centre (camera {camera})", *at(entry, "cx")
        )


def cy_evidence_views(evidence: Evidence) -> list[OutlineView]:
    """Views for comparing outlines, with cameras whose cy is measured from the top."""
    views = []
    mask = cast("Callable[[FrameEntry], ByteArray]", evidence.pixels.mask)  # of frames that have one
    for view in evidence.views:
        mesh = view.mesh
        if mesh is None or mesh.depth <= 0 or not view.has_sound_mask or "cy" not in view.entry.intrinsics:
            continue
        K = mesh.camera.K.copy()
        K[:2, 2] = view.entry.intrinsics.get("cx", 0), view.entry.intrinsics["cy"]
        views.append(OutlineView(mesh.vertices, replace(mesh.camera, K=K), partial(mask, view.entry)))
    return views


@rule("HB511", "error", of_layout=True)
def _other_edge(evidence: Evidence) -> Iterator[Hit]:
    """Cy is measured from the other edge.

    Declare the other convention: VHAP measures from the bottom since November 2024, from the top before.
    """
    matters = any(abs(offset[1]) > TELLING_PX for offset in principal_offsets(evidence).values())
    if evidence.convention not in ("top", "bottom") or not matters or evidence.subject is None:
        return
    if misplaced(evidence) or _contradicted(evidence):
        return
    views = cy_evidence_views(evidence)
    if not views:
        return
    agreement = weigh_cy(views, evidence.subject.head.faces)
    if max(agreement.top, agreement.bottom) < TELLING_AGREEMENT:
        return
    if agreement.decision is not None and agreement.decision != evidence.convention:
        text = (
            f"cy is read from the {evidence.convention}; outlines of mesh and foreground agree better with the "
            f"{agreement.decision} ({agreement.top:.2f} with the top, {agreement.bottom:.2f} with the bottom)"
        )
        yield Hit(text, evidence.folder / layout.DECLARATION_FILE, "cy")
