"""HB3xx: backgrounds and masks. HB4xx: wrong colour conversions.

A check skips frames whose fault another check reports, so that an inverted mask is not also reported as a wrong
background.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...bench.progress import counted, some
from .checks_rig import blank_cameras, faulty_cameras
from .evidence import Evidence, first_entries
from .rules import Hit, rule
from .views import BACKGROUND_LEVELS, MaskFacts, ViewFacts

MOST = 0.5
"""Fraction of the inspected frames from which a fault is one of the export, not of single frames."""

DIRTY = 0.02
"""Fraction of pixels outside the mask that may differ from the background."""

FRINGES = (0.65, 1.5)
"""Fringes between these are a clean composite, see `MaskFacts.fringe`."""

LIMITED_LOW, LIMITED_HIGH = (14, 24), (231, 237)
"""Expected range of the minimum and maximum level of limited-range images; resizing softens the ends a
little."""


def unit_range(evidence: Evidence) -> bool:
    """Whether images contain only 0 and 1, as when floats in [0, 1] are cast to 8 bits."""
    views = [view for view in evidence.views if view.error is None]
    return bool(views) and max(view.high for view in views) == 1


def _masks(evidence: Evidence) -> list[tuple[ViewFacts, MaskFacts]]:
    blank = blank_cameras(evidence)
    return [(v, v.mask) for v in evidence.views if v.mask is not None and v.entry.camera_id not in blank]


def _faulty_masks(evidence: Evidence, fault: str, what: str) -> Iterator[Hit]:
    """One hit for the masks with a fault, a property of `MaskFacts`."""
    faulty = [view for view, mask in _masks(evidence) if getattr(mask, fault)]
    if faulty:
        path = faulty[0].entry.mask or faulty[0].entry.image
        yield Hit(f"{what} in {len(faulty)} of {counted(len(evidence.views), 'frame')} checked", path)


@rule("HB307", "error")
def _mask_levels(evidence: Evidence) -> Iterator[Hit]:
    """A mask has other levels than 0 to 255.

    Scale it before saving: masks of 0 and 1 by 255, of video's limited range from 16 and 235.
    """
    masks = [mask for _, mask in _masks(evidence) if mask.other_levels]
    if masks:
        low, high = min(mask.low for mask in masks), max(mask.high for mask in masks)
        what = f"the mask's levels lie from {low} to {high}, not from 0 to 255,"
        yield from _faulty_masks(evidence, "other_levels", what)


@rule("HB304", "error")
def _empty_masks(evidence: Evidence) -> Iterator[Hit]:
    """A mask is empty.

    Run the matting again for these frames, or exclude them with a reason.
    """
    yield from _faulty_masks(evidence, "empty", "the mask covers nothing")


@rule("HB305", "error")
def _full_masks(evidence: Evidence) -> Iterator[Hit]:
    """A mask is full.

    Run the matting again; failed matting gives a mask of 255 everywhere.
    """
    yield from _faulty_masks(evidence, "full", "the mask covers the whole image")


@rule("HB306", "error")
def _inverted_masks(evidence: Evidence) -> Iterator[Hit]:
    """A mask is inverted.

    Invert it: 255 is the subject.
    """
    yield from _faulty_masks(evidence, "inverted", "the mask covers the background and not the subject")


@rule("HB308", "error")
def _blank_images(evidence: Evidence) -> Iterator[Hit]:
    """An image has a single colour.

    Export the frame again, or exclude it with a reason; remove cameras with only such images.
    """
    if unit_range(evidence):
        return
    faulty = [view for view in evidence.views if view.blank]
    cameras = blank_cameras(evidence)
    if cameras:
        yield Hit(
            f"every checked image of {counted(len(cameras), 'camera')} is of one colour: "
            + some(f"{camera} (level {_level(evidence, camera):.0f})" for camera in cameras),
            first_entries(evidence)[cameras[0]].image,
        )
    single = [view for view in faulty if view.entry.camera_id not in cameras]
    if single:
        yield Hit(
            f"{len(single)} of {counted(len(evidence.views), 'frame')} checked are of one colour, level "
            f"{single[0].low}",
            single[0].entry.image,
        )


def _level(evidence: Evidence, camera: str) -> float:
    """Mean grey level of a camera."""
    if camera in evidence.cameras:
        return evidence.cameras[camera].level
    levels = [view.low for view in evidence.views if view.entry.camera_id == camera and view.error is None]
    return float(np.mean(levels))


def outside_colours(evidence: Evidence) -> list[tuple[ViewFacts, np.ndarray, float]]:
    """Frames with a visible background: its median colour, (3,), and the fraction of its pixels that differ from the
    declared one. Images with alpha have none."""
    colours = []
    for view in evidence.views:
        if view.error is not None or view.has_alpha or view.blank:
            continue
        if view.mask is None and view.corners is not None:
            colours.append((view, np.asarray(view.corners), view.corners_off))
        elif view.mask is not None and view.mask.sound and view.mask.outside is not None:
            colours.append((view, np.asarray(view.mask.outside), view.mask.outside_off))
    return colours


def _foreign(evidence: Evidence, colour: np.ndarray) -> bool:
    return bool(np.abs(colour - np.asarray(evidence.background) * 255).max() > BACKGROUND_LEVELS)


@rule("HB301", "error")
def _wrong_background(evidence: Evidence) -> Iterator[Hit]:
    """Images have another background than declared.

    Declare their background, or composite them on the declared one.
    """
    if unit_range(evidence) or limited_range(evidence):
        return
    seen = [entry for entry in outside_colours(evidence) if not _shows_room(entry[0])]
    wrong = [(view, colour) for view, colour, _ in seen if _foreign(evidence, colour)]
    if wrong:
        median = np.median([colour for _, colour in wrong], axis=0).round().astype(int)
        stated = np.round(np.asarray(evidence.background) * 255).astype(int)
        uniform = np.ptp([colour for _, colour in wrong], axis=0).max() <= BACKGROUND_LEVELS
        colour_text = f"level {tuple(median.tolist())}" if uniform else "no one colour"
        yield Hit(
            f"declared background is level {tuple(stated.tolist())}, outside the subject there is {colour_text} in "
            f"{len(wrong)} of {counted(len(seen), 'frame')} checked",
            wrong[0][0].entry.image,
        )


def _shows_room(view: ViewFacts) -> bool:
    """Whether a frame without a mask shows something behind the subject."""
    return view.mask is None and view.room


@rule("HB309", "warning")
def _room(evidence: Evidence) -> Iterator[Hit]:
    """The room is seen behind the subject.

    Make masks, unless the room is to count in every metric: avatars have no room.
    """
    seen = outside_colours(evidence)
    rooms = [view for view, colour, _ in seen if _shows_room(view) and _foreign(evidence, colour)]
    if rooms:
        yield Hit(
            f"{len(rooms)} of {counted(len(seen), 'frame')} checked have no mask and no background of one colour",
            rooms[0].entry.image,
        )


@rule("HB302", "warning")
def _dirty_background(evidence: Evidence) -> Iterator[Hit]:
    """The background is not clean outside the mask.

    Composite with the stored mask, or store the one that was used: masked metrics and alpha losses use pixels outside
    the mask.
    """
    if unit_range(evidence) or limited_range(evidence):
        return
    seen = [entry for entry in outside_colours(evidence) if entry[0].mask is not None]
    dirty = [(v, share) for v, colour, share in seen if share > DIRTY and not _foreign(evidence, colour)]
    if len(dirty) > MOST * len(seen):
        typical = float(np.median([share for _, share in dirty]))
        yield Hit(
            f"{typical:.0%} of the pixels outside the mask differ from the background, in {len(dirty)} of "
            f"{counted(len(seen), 'frame')} checked",
            dirty[0][0].entry.image,
        )


@rule("HB303", "warning")
def _fringes(evidence: Evidence) -> Iterator[Hit]:
    """Fringes along the mask.

    Composite once, straight alpha: a F + (1 - a) B with the unmultiplied colour F.
    """
    if unit_range(evidence) or any(_foreign(evidence, colour) for _, colour, _ in outside_colours(evidence)):
        return
    fringes = [
        (view, mask.fringe)
        for view, mask in _masks(evidence)
        if mask.fringe is not None and mask.sound and not view.has_alpha
    ]
    if len(fringes) < 4:
        return
    typical = float(np.median([fringe for _, fringe in fringes]))
    if not FRINGES[0] <= typical <= FRINGES[1]:
        what = (
            "dark fringes, as of colours premultiplied twice"
            if typical < FRINGES[0]
            else ("bright fringes, as of colours never multiplied by the mask")
        )
        yield Hit(
            f"{what}: where the mask is soft, the subject adds {typical:.2f} times the light it should (median "
            f"over {counted(len(fringes), 'frame')})",
            fringes[0][0].entry.image,
        )


def limited_range(evidence: Evidence) -> bool:
    """Whether levels are within video's limited range, 16 to 235, with evidence that this is not by chance.

    The evidence is that levels reach both ends, in whole images or (if the background was replaced) in the subject
    alone, or that the background has the limited-range level of the declared one.
    """
    views = [view for view in evidence.views if view.error is None and not view.blank]
    if not views:
        return False
    whole = (min(view.low for view in views), max(view.high for view in views))
    subject = (min(view.subject_low for view in views), max(view.subject_high for view in views))
    if _spans_limited(whole) or _spans_limited(subject):
        return True
    declared = np.asarray(evidence.background) * 255
    squeezed = 16 + declared * 219 / 255
    seen = [colour for _, colour, _ in outside_colours(evidence)]
    return (
        bool(seen)
        and whole[1] <= LIMITED_HIGH[1]
        and bool(np.abs(squeezed - declared).max() > BACKGROUND_LEVELS)
        and bool(np.abs(np.median(seen, axis=0) - squeezed).max() <= 2)
    )


def _spans_limited(levels: tuple[int, int]) -> bool:
    low, high = levels
    return LIMITED_LOW[0] <= low <= LIMITED_LOW[1] and LIMITED_HIGH[0] <= high <= LIMITED_HIGH[1]


SWAPPED_LEVELS = 10
"""Minimum excess of blue over red of skin that indicates swapped channels."""

BALANCE_LEVELS = 30
"""Difference between the skin colour of a camera and the others above which they are not calibrated to each other."""


@rule("HB401", "error")
def _limited(evidence: Evidence) -> Iterator[Hit]:
    """Colours are in video's limited range.

    Decode the video again with full range (for ffmpeg -vf scale=in_range=tv:out_range=pc): white is 255.
    """
    if limited_range(evidence):
        views = [view for view in evidence.views if view.error is None and not view.blank]
        low, high = min(view.subject_low for view in views), max(view.subject_high for view in views)
        text = f"the subject's levels lie from {low} to {high}, within the limited range of video, 16 to 235"
        yield Hit(text, views[0].entry.image)


@rule("HB402", "error")
def _unit(evidence: Evidence) -> Iterator[Hit]:
    """Images have only levels 0 and 1.

    Multiply by 255 and round before saving as 8 bits.
    """
    if unit_range(evidence):
        yield Hit("no level is above 1 of 255", evidence.views[0].entry.image)


@rule("HB403", "warning")
def _grey(evidence: Evidence) -> Iterator[Hit]:
    """Images have no colour.

    Export the colour images, if there are any.
    """
    views = [view for view in evidence.views if view.error is None and not view.blank and view.high > 1]
    grey = [view for view in views if view.grey]
    if grey:
        yield Hit(
            f"{len(grey)} of {counted(len(views), 'frame')} checked have no colour", grey[0].entry.image
        )


def skin_by_camera(evidence: Evidence) -> dict[str, np.ndarray]:
    """Median colour of the face's visible skin, (3,) levels, by camera, for cameras that see enough of the face."""
    colours: dict[str, list[np.ndarray]] = defaultdict(list)
    faulty = faulty_cameras(evidence)
    for view in (view for view in evidence.views if view.entry.camera_id not in faulty):
        outside = view.mesh.face_outside if view.mesh is not None else None
        if view.mesh is not None and view.mesh.skin is not None and (outside or 0.0) < 0.1 and not view.grey:
            colours[view.entry.camera_id].append(np.asarray(view.mesh.skin))
    return {camera: np.median(values, axis=0) for camera, values in colours.items()}


def _swapped_cameras(evidence: Evidence) -> list[str]:
    skin = skin_by_camera(evidence)
    return [camera for camera, colour in skin.items() if colour[2] - colour[0] > SWAPPED_LEVELS]


@rule("HB404", "warning")
def _swapped(evidence: Evidence) -> Iterator[Hit]:
    """Red and blue seem swapped.

    Convert between OpenCV's BGR and RGB once, where images are read or written.
    """
    cameras = _swapped_cameras(evidence)
    if cameras:
        red, _, blue = skin_by_camera(evidence)[cameras[0]].round().astype(int)
        first = next(view for view in evidence.views if view.entry.camera_id == cameras[0])
        yield Hit(
            f"skin is bluer than red in {counted(len(cameras), 'camera')} ({some(cameras)}): red {red}, blue {blue}",
            first.entry.image,
        )


@rule("HB405", "warning")
def _uncalibrated(evidence: Evidence) -> Iterator[Hit]:
    """Cameras are not calibrated to each other in colour.

    Apply the recording's colour calibration; some loaders compute it and return the uncorrected image.
    """
    # Brightness depends on the light's direction, so only the balance between channels is compared.
    skin = skin_by_camera(evidence)
    swapped = _swapped_cameras(evidence)
    balance = {c: v - v.mean() for c, v in skin.items() if c not in swapped}
    if len(balance) < 3:
        return
    middle = np.median([*balance.values()], axis=0)
    distances = {camera: float(np.abs(value - middle).max()) for camera, value in balance.items()}
    worst = [camera for camera, levels in distances.items() if levels > BALANCE_LEVELS]
    if worst:
        yield Hit(
            f"the skin's colour balance in {some(worst)} differs from the other cameras' by up to "
            f"{max(distances.values()):.0f} levels",
            evidence.folder,
        )


@rule("HB406", "note")
def _lossy(evidence: Evidence) -> Iterator[Hit]:
    """Ground truth is lossy.

    Export PNG: metrics against JPEG reward its artefacts, and renaming a JPEG does not make it a PNG.
    """
    lossy = [path for path in evidence.digests if _is_jpeg(path)]
    if lossy:
        named = [path for path in lossy if path.suffix.lower() == ".png"]
        more = f"; {len(named)} of them are named .png" if named else ""
        yield Hit(
            f"{len(lossy)} of {counted(len(evidence.digests), 'image')} are JPEG{more}", (named or lossy)[0]
        )


def _is_jpeg(path: Path) -> bool:
    """Key of an image: its content, or its name if it is no separate file."""
    try:
        with path.open("rb") as stream:
            return stream.read(2) == b"\xff\xd8"
    except (OSError, ValueError):
        return path.suffix.lower() in (".jpg", ".jpeg")
