"""HB4xx: colours that went through the wrong conversion."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from .checks_images import limited_range, unit_range
from .evidence import Evidence
from .rules import Hit, Rule, several, some

SWAPPED_LEVELS = 10
"""Skin is redder than blue in every light a capture is made in; by this much the other way round is a swap."""

APART_LEVELS = 30
"""Difference between a camera's skin colour and the others' from which they are not calibrated to each other."""


def _limited(evidence: Evidence) -> Iterator[Hit]:
    if limited_range(evidence):
        views = [view for view in evidence.views if view.error is None and view.low != view.high]
        low, high = min(view.subject_low for view in views), max(view.subject_high for view in views)
        yield Hit(
            f"the subject's levels lie from {low} to {high}, within the limited range of video, 16 to 235",
            views[0].entry.image,
        )


def _unit(evidence: Evidence) -> Iterator[Hit]:
    if unit_range(evidence):
        yield Hit("no level is above 1 of 255", evidence.views[0].entry.image)


def _grey(evidence: Evidence) -> Iterator[Hit]:
    views = [
        view for view in evidence.views if view.error is None and view.low != view.high and view.high > 1
    ]
    grey = [view for view in views if view.grey]
    if grey:
        yield Hit(
            f"{len(grey)} of {several(len(views), 'frame')} looked at have no colour", grey[0].entry.image
        )


def skin_by_camera(evidence: Evidence) -> dict[str, np.ndarray]:
    """Median colour of the face's visible skin, (3,) levels, by camera; cameras that see enough of the face."""
    colours: dict[str, list[np.ndarray]] = defaultdict(list)
    for view in evidence.views:
        outside = view.mesh.face_outside if view.mesh is not None else None
        if view.mesh is not None and view.mesh.skin is not None and (outside or 0.0) < 0.1 and not view.grey:
            colours[view.entry.camera_id].append(np.asarray(view.mesh.skin))
    return {camera: np.median(found, axis=0) for camera, found in colours.items()}


def _swapped_cameras(evidence: Evidence) -> list[str]:
    skin = skin_by_camera(evidence)
    return [camera for camera, colour in skin.items() if colour[2] - colour[0] > SWAPPED_LEVELS]


def _swapped(evidence: Evidence) -> Iterator[Hit]:
    cameras = _swapped_cameras(evidence)
    if cameras:
        red, _, blue = skin_by_camera(evidence)[cameras[0]].round().astype(int)
        first = next(view for view in evidence.views if view.entry.camera_id == cameras[0])
        yield Hit(
            f"skin is bluer than red in {several(len(cameras), 'camera')} ({some(cameras)}): red {red}, blue {blue}",
            first.entry.image,
        )


def _uncalibrated(evidence: Evidence) -> Iterator[Hit]:
    """Brightness differs with the light's direction, so only the balance between channels is compared."""
    skin = skin_by_camera(evidence)
    swapped = _swapped_cameras(evidence)
    balance = {c: v - v.mean() for c, v in skin.items() if c not in swapped}
    if len(balance) < 3:
        return
    middle = np.median([*balance.values()], axis=0)
    apart = {camera: float(np.abs(value - middle).max()) for camera, value in balance.items()}
    worst = [camera for camera, levels in apart.items() if levels > APART_LEVELS]
    if worst:
        yield Hit(
            f"the skin's colour balance in {some(worst)} differs from the other cameras' by up to "
            f"{max(apart.values()):.0f} levels",
            evidence.folder,
        )


def _lossy(evidence: Evidence) -> Iterator[Hit]:
    lossy = [path for path in evidence.digests if path.suffix.lower() in (".jpg", ".jpeg")]
    if lossy:
        yield Hit(f"{len(lossy)} of {several(len(evidence.digests), 'image')} are JPEG", lossy[0])


RULES = (
    Rule(
        "HB401",
        "error",
        "colours are in video's limited range",
        "Decode the video again with full range (for ffmpeg -vf scale=in_range=tv:out_range=pc): white is 255.",
        _limited,
    ),
    Rule(
        "HB402",
        "error",
        "images hold levels 0 and 1 alone",
        "Multiply by 255 and round before saving as 8 bits.",
        _unit,
    ),
    Rule("HB403", "warning", "images have no colour", "Export the colour images, if there are any.", _grey),
    Rule(
        "HB404",
        "warning",
        "red and blue seem swapped",
        "Convert between OpenCV's BGR and RGB once, where images are read or written.",
        _swapped,
    ),
    Rule(
        "HB405",
        "warning",
        "cameras are not calibrated to each other in colour",
        "Apply the recording's colour calibration; some loaders compute it and return the uncorrected image.",
        _uncalibrated,
    ),
    Rule(
        "HB406",
        "note",
        "ground truth is lossy",
        "Export PNG: metrics against JPEG reward its artefacts.",
        _lossy,
    ),
)
