"""HB5xx: positions, orientations and pixel coordinates of cameras; from HB513, each camera compared with the others of its
capture, with limits based on the spread over the cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import cast

import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from ...bench.progress import counted
from ..ga import layout
from ..ga.cameras import ROTATION_TOLERANCE, OutlineView, contradicted_focal, same_intrinsics, weigh_cy
from ..ga.transforms import FrameEntry
from .camera_table import FEWEST_CAMERAS, STILL_SHARE, CameraFacts, frozen
from .evidence import Evidence, first_entries
from .rules import Hit, at, rule, some
from .views import BLANK_LEVELS

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

TELLING_MATCH = 0.4
"""Minimum median correlation over the cameras for comparing their images."""

BETTER = 0.05
"""Margin of the correlation by which another camera's calibration must match better."""

LEAST_OFFSET = (1.5, 0.01)
"""Minimum limit of an offset: working pixels, and fraction of the image's height."""

LEAST_POOR, LEAST_SOFT, LEAST_UNSTEADY = 0.3, 0.6, 0.5
"""Minimum distances of the limits from the median: correlation, factors of two in contrast, pixels over time."""

SYNCHRONOUS = 0.6
"""Maximum ratio of the change of the offsets over time with and without a lag."""

OFFSET_SPREADS, SPREADS = 4, 6
"""Limits in median absolute deviations, of offsets in the plane and of single numbers."""


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


def blank_cameras(evidence: Evidence) -> list[str]:
    """Cameras whose inspected images all have a single colour."""
    seen: dict[str, list[bool]] = {}
    for view in evidence.views:
        if view.error is None:
            seen.setdefault(view.entry.camera_id, []).append(view.blank)
    for camera, facts in evidence.cameras.items():
        seen.setdefault(camera, []).append(facts.contrast < BLANK_LEVELS)
    return sorted(camera for camera, blank in seen.items() if all(blank) and len(blank) > 1)


def frozen_cameras(evidence: Evidence) -> list[str]:
    """Cameras whose image never changes while the others' images change."""
    blank = blank_cameras(evidence)
    return [camera for camera in frozen(evidence.cameras) if camera not in blank]


def dead_cameras(evidence: Evidence) -> set[str]:
    """Cameras whose images do not change with the performance."""
    return {*blank_cameras(evidence), *frozen_cameras(evidence)}


def _compared(evidence: Evidence) -> Mapping[str, CameraFacts]:
    """Cameras that can be compared with each other; none if their images do not match at any offset."""
    dead = dead_cameras(evidence)
    facts = {c: f for c, f in evidence.cameras.items() if c not in dead and np.isfinite(f.match)}
    if len(facts) < FEWEST_CAMERAS or np.median([f.match for f in facts.values()]) < TELLING_MATCH:
        return {}
    return facts


def _misaligned(evidence: Evidence) -> dict[str, tuple[float, float]]:
    """Cameras that show the face at another offset than the others, or not at its projection: distance of their offset
    from the others' in pixels, and its limit."""
    facts = _compared(evidence)
    if not facts:
        return {}
    middle, distance = _spread({c: f.match for c, f in facts.items()}, LEAST_POOR)
    distances = _offset_distances(facts)
    spread = OFFSET_SPREADS * float(np.median([*distances.values()]))
    limits = {c: max(spread, LEAST_OFFSET[0] * f.scale, LEAST_OFFSET[1] * f.height) for c, f in facts.items()}
    return {
        c: (distances[c], limits[c])
        for c, f in facts.items()
        if distances[c] > limits[c] or f.match < middle - distance
    }


def exchanged_cameras(evidence: Evidence) -> dict[str, str]:
    """The other camera whose calibration fits the images, by camera."""
    facts = _compared(evidence)
    return {
        c: facts[c].fits
        for c in _misaligned(evidence)
        if facts[c].fits and facts[c].fits_match > facts[c].match + BETTER
    }


def _spread(values: Mapping[str, float], least: float) -> tuple[float, float]:
    """Median, and distance of the limit from it."""
    numbers = np.array([*values.values()])
    middle = float(np.median(numbers))
    return middle, max(least, SPREADS * float(np.median(np.abs(numbers - middle))))


def blurred_cameras(evidence: Evidence) -> dict[str, float]:
    """The limit below which sharpness is reported, by camera."""
    explained = exchanged_cameras(evidence)
    values = {c: f.sharpness for c, f in _compared(evidence).items() if np.isfinite(f.sharpness)}
    if len(values) < FEWEST_CAMERAS:
        return {}
    middle, distance = _spread(values, LEAST_SOFT)
    return {
        c: middle - distance
        for c, value in values.items()
        if value < middle - distance and c not in explained
    }


def late_cameras(evidence: Evidence) -> dict[str, float]:
    """The exceeded limit of the offset's change over time in pixels, by camera."""
    facts = _compared(evidence)
    explained = {*exchanged_cameras(evidence), *blurred_cameras(evidence)}
    values = {c: f.unsteady for c, f in facts.items()}
    if not values:
        return {}
    middle, distance = _spread(values, LEAST_UNSTEADY)
    usual = float(np.median([f.lag for f in facts.values()]))
    return {
        c: middle + distance
        for c, f in facts.items()
        if f.lag != usual
        and f.lag
        and f.match > TELLING_MATCH
        and f.unsteady > middle + distance
        and f.unsteady_at_lag < SYNCHRONOUS * f.unsteady
        and c not in explained
    }


def shifted_cameras(evidence: Evidence) -> dict[str, tuple[float, float]]:
    """Displaced cameras without another fault: distance of their offset from the others' in pixels, and its limit."""
    explained = {*exchanged_cameras(evidence), *blurred_cameras(evidence), *late_cameras(evidence)}
    return {c: distance for c, distance in _misaligned(evidence).items() if c not in explained}


def _offset_distances(facts: Mapping[str, CameraFacts]) -> dict[str, float]:
    usual = np.median([f.offset for f in facts.values()], axis=0)
    return {c: float(np.linalg.norm(np.array(f.offset) - usual)) for c, f in facts.items()}


def faulty_cameras(evidence: Evidence) -> set[str]:
    """Cameras named by a rule on single cameras; other findings of their images are consequences."""
    return {
        *dead_cameras(evidence),
        *exchanged_cameras(evidence),
        *blurred_cameras(evidence),
        *late_cameras(evidence),
        *shifted_cameras(evidence),
    }


def _range(values: Mapping[str, float], without: Mapping[str, object], digits: int) -> str:
    """The other cameras' values: "0.12 to 0.34"."""
    others = [value for camera, value in values.items() if camera not in without]
    return f"{min(others):.{digits}f} to {max(others):.{digits}f}" if others else "none"


def _place(evidence: Evidence, camera: str) -> tuple[Path, str]:
    return at(first_entries(evidence)[camera], "transform_matrix")


@rule("HB513", "error")
def _exchanged(evidence: Evidence) -> Iterator[Hit]:
    """A camera's images fit another camera's calibration.

    Check which serial number belongs to which images, and exchange the calibrations of these cameras.
    """
    exchanged = exchanged_cameras(evidence)
    pairs = {tuple(sorted((c, other))) for c, other in exchanged.items() if exchanged.get(other) == c}
    single = [c for c in exchanged if not any(c in pair for pair in pairs)]
    facts = evidence.cameras
    texts = [
        f"cameras {one} and {other} are exchanged: the face's brightness correlates with the other cameras' by "
        f"{facts[one].match:.2f} and {facts[other].match:.2f} under their own calibration, by "
        f"{facts[one].fits_match:.2f} and {facts[other].fits_match:.2f} under each other's"
        for one, other in sorted(pairs)
    ] + [
        f"the images of camera {c} fit the calibration of camera {exchanged[c]}: the face's brightness correlates with the "
        f"other cameras' by {facts[c].match:.2f} under its own calibration, by {facts[c].fits_match:.2f} under that"
        for c in single
    ]
    if texts:
        usual = _range({c: f.match for c, f in _compared(evidence).items()}, exchanged, 2)
        first = min(exchanged)
        yield Hit(
            f"{'; '.join(texts)} (other cameras {usual}, limit {BETTER} more)", *_place(evidence, first)
        )


@rule("HB514", "warning")
def _shifted(evidence: Evidence) -> Iterator[Hit]:
    """A camera's calibration does not fit its images.

    Calibrate this camera again, or remove it: it was moved or rotated after the calibration, or its matrix belongs to
    another recording.
    """
    facts, shifted = _compared(evidence), shifted_cameras(evidence)
    if not shifted:
        return
    texts = []
    for camera, (distance, limit) in shifted.items():
        f = facts[camera]
        if distance > limit:
            texts.append(
                f"camera {camera} shows the face {distance:.1f} px off ({f.offset[0]:+.1f} right, {f.offset[1]:+.1f} "
                f"down) from where its calibration projects the tracked mesh, as if it stood "
                f"{100 * distance * f.metres_per_pixel:.1f} cm aside or were turned by {distance * f.degrees_per_pixel:.2f} "
                f"degrees (limit {limit:.1f} px)"
            )
        else:
            texts.append(
                f"camera {camera} does not show the face where its calibration projects it (correlation with the other cameras {f.match:.2f}, theirs {_range({c: g.match for c, g in facts.items()}, shifted, 2)})"
            )
    yield Hit(
        f"{'; '.join(texts)}; other cameras {_range(_offset_distances(facts), shifted, 1)} px",
        *_place(evidence, min(shifted)),
    )


@rule("HB515", "warning")
def _late(evidence: Evidence) -> Iterator[Hit]:
    """A camera is not synchronous with the others.

    Shift this camera's images by these frames (its trigger or its video's start differs), or remove the camera.
    """
    facts, late = _compared(evidence), late_cameras(evidence)
    if late:
        texts = [
            f"camera {c} is {counted(abs(facts[c].lag), 'frame')} {'late' if facts[c].lag > 0 else 'early'}: between "
            f"image and tracked mesh the offset changes by {facts[c].unsteady:.1f} px over time, by "
            f"{facts[c].unsteady_at_lag:.1f} px with that lag (limit {limit:.1f} px)"
            for c, limit in late.items()
        ]
        usual = _range({c: f.unsteady for c, f in facts.items()}, late, 1)
        yield Hit(f"{'; '.join(texts)}; other cameras {usual} px", _first_image(evidence, min(late)))


@rule("HB516", "error")
def _frozen_camera(evidence: Evidence) -> Iterator[Hit]:
    """A camera is frozen.

    Export this camera's images again, or remove the camera: it has the same image at every timestep.
    """
    still = frozen_cameras(evidence)
    if still:
        motion = {c: f.motion for c, f in evidence.cameras.items() if np.isfinite(f.motion)}
        live = {c: levels for c, levels in motion.items() if c not in dead_cameras(evidence)}
        limit = STILL_SHARE * float(np.median([*live.values(), *(motion[c] for c in still)]))
        yield Hit(
            f"the picture of {counted(len(still), 'camera')} never changes: {some(still)} (largest change "
            f"{max(motion[c] for c in still):.2f} levels, other cameras {_range(live, {}, 1)}, limit {limit:.1f})",
            _first_image(evidence, still[0]),
        )


@rule("HB517", "warning")
def _blurred(evidence: Evidence) -> Iterator[Hit]:
    """A camera is blurred.

    Remove the camera, or do not hold it out: it is out of focus or upscaled, which blurs results trained on it or
    measured against it.
    """
    facts, blurred = _compared(evidence), blurred_cameras(evidence)
    if blurred:
        texts = [
            f"camera {c} shows fine details of the face with {2 ** facts[c].sharpness:.2f} times the contrast that the "
            f"other cameras show (limit {2**limit:.2f})"
            for c, limit in blurred.items()
        ]
        usual = _range({c: 2**f.sharpness for c, f in facts.items()}, blurred, 2)
        yield Hit(f"{'; '.join(texts)}; the others {usual}", _first_image(evidence, min(blurred)))


def _first_image(evidence: Evidence, camera: str) -> Path:
    return first_entries(evidence)[camera].image
