"""HB513 to HB517: each camera compared with the others of its capture, with limits based on the spread over the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ...bench.progress import counted, some
from .camera_table import FEWEST_CAMERAS, STILL_SHARE, CameraFacts, frozen
from .evidence import Evidence, first_entries
from .rules import Hit, at, rule
from .views import BLANK_LEVELS

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
