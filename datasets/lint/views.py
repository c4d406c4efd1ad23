"""Decoded sample frames as a few numbers each: mattes, background, colours, and how the tracked mesh lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo
from ..ga.layout import CyConvention, extrinsics_from_json, intrinsics_from_json
from ..ga.transforms import FrameEntry
from ..images import read_image, read_mask
from .mesh_views import MeshFacts, lay_mesh
from .parameters import Parameters, Subject

BACKGROUND_LEVELS = 12
"""A pixel is of the background's colour where no channel differs by more; JPEG changes flat areas by less."""

FAR = 0.02
"""Distance from the foreground, as a share of the image's height, from which a pixel should be background."""

SOFT = (0.25, 0.75)
"""Coverage of the pixels that tell how a matte was composited."""

MIN_FRINGE_PIXELS = 12


@dataclass(frozen=True, eq=False)
class MatteFacts:
    """A frame's mask, and the image where the mask says there is none of the subject.

    Attributes
    ----------
    low, high : least and largest value of the mask.
    coverage : share of the image that it covers.
    outside : median colour (3,) far from the foreground, 8-bit levels; None where there is nothing outside.
    outside_off : share of those pixels that are not of the declared background's colour.
    inside_empty : share of the foreground that is of the background's colour.
    fringe : median over soft pixels of what the subject adds to the image over what it should add,
        (I - (1-a) B) / (a F), with F the mean colour of the covered pixels nearby; 1 for a clean straight-alpha
        composite, a (0.5) for one premultiplied twice. None where too few soft pixels tell.
    """

    low: int
    high: int
    coverage: float
    outside: FloatArray | None
    outside_off: float
    inside_empty: float
    fringe: float | None


@dataclass(frozen=True, eq=False)
class ViewFacts:
    """What one decoded frame says.

    Attributes
    ----------
    low, high : least and largest level of any pixel's channels.
    subject_low, subject_high : the same over pixels that the subject covers wholly.
    grey : whether no pixel has any colour.
    corners : median colour (3,) of the upper corners.
    corners_off : share of their pixels that are not of the declared background's colour.
    has_alpha : whether the image has an alpha channel, which then is its mask.
    matte : None without a mask, or where the mask does not decode or is of another size.
    mesh : None where the frame has no pose or no head.
    error : why the image does not decode; all else is then empty.
    """

    entry: FrameEntry
    low: int = 0
    high: int = 0
    subject_low: int = 0
    subject_high: int = 0
    grey: bool = False
    corners: FloatArray | None = None
    corners_off: float = 0.0
    has_alpha: bool = False
    matte: MatteFacts | None = None
    mesh: MeshFacts | None = None
    error: InputError | None = None


def pick_views(entries: Sequence[FrameEntry], count: int) -> list[FrameEntry]:
    """Up to ``count`` frames, evenly spaced over timesteps, the camera changing from one to the next."""
    groups: dict[int, list[FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.timestep, e.camera_index)):
        groups.setdefault(entry.timestep, []).append(entry)
    if not groups or count < 1:
        return []
    timesteps = sorted(groups)
    where = np.linspace(0, len(timesteps) - 1, count).round().astype(int)
    chosen = {id(e): e for i, t in enumerate(where) for e in [_turn(groups[timesteps[t]], i)]}
    return list(chosen.values())


def _turn(group: Sequence[FrameEntry], i: int) -> FrameEntry:
    return group[i % len(group)]


def entry_camera(entry: FrameEntry, info: ImageInfo, cy: CyConvention) -> Camera:
    """Camera of a frame as its own entry has it, in its own sequence's world."""
    intrinsics = intrinsics_from_json(entry.intrinsics, info.width, info.height, cy)
    return Camera(
        entry.camera_id, info.width, info.height, intrinsics, extrinsics_from_json(entry.camera_to_world)
    )


def look(
    entries: Sequence[FrameEntry],
    headers: Mapping[Path, ImageInfo],
    subject: Subject | None,
    parameters: Mapping[int, Parameters],
    background: Sequence[float],
    cy: CyConvention,
    *,
    progress: Progress = no_progress,
) -> list[ViewFacts]:
    """Decode frames and note what the checks need; the pixels themselves are let go."""
    found = []
    for done, entry in enumerate(entries, start=1):
        progress(done, len(entries), "looking at frames")
        info = headers[entry.image]
        try:
            image = read_image(entry.image, background)
            mask = _mask(entry, info, headers)
        except InputError as error:
            found.append(ViewFacts(entry, error=error))
            continue
        pose = parameters[entry.timestep].pose if entry.timestep in parameters else None
        found.append(_facts(entry, info, image, mask, subject, pose, background, cy))
    return found


def _mask(entry: FrameEntry, info: ImageInfo, headers: Mapping[Path, ImageInfo]) -> ByteArray | None:
    path = entry.mask if entry.mask is not None else (entry.image if info.has_alpha else None)
    header = headers.get(path) if path is not None else None
    if path is None or header is None or (header.width, header.height) != (info.width, info.height):
        return None
    return read_mask(path)


def _facts(
    entry: FrameEntry,
    info: ImageInfo,
    image: ByteArray,
    mask: ByteArray | None,
    subject: Subject | None,
    pose: HeadPose | None,
    background: Sequence[float],
    cy: CyConvention,
) -> ViewFacts:
    ground = np.round(np.asarray(background) * 255)
    off = np.abs(image.astype(np.int16) - ground).max(axis=2) > BACKGROUND_LEVELS
    shown = mask > 250 if mask is not None else off  # no mixture with the background
    pixels = image[shown] if shown.any() else image.reshape(-1, 3)
    width = max(1, info.width // 10)
    corners = np.zeros(off.shape, dtype=bool)
    corners[:width, :width] = corners[:width, -width:] = True
    mesh = None
    if subject is not None and pose is not None:
        mesh = lay_mesh(subject, pose, entry_camera(entry, info, cy), image, mask)
    return ViewFacts(
        entry=entry,
        low=int(image.min()),
        high=int(image.max()),
        subject_low=int(pixels.min()),
        subject_high=int(pixels.max()),
        grey=bool((np.ptp(image, axis=2) == 0).all()),
        corners=np.median(image[corners], axis=0),
        corners_off=float(off[corners].mean()),
        has_alpha=info.has_alpha,
        matte=None if mask is None else _matte(image, mask, off, ground),
        mesh=mesh,
    )


def _matte(image: ByteArray, mask: ByteArray, off: np.ndarray, ground: FloatArray) -> MatteFacts:
    covered = mask > 127
    distance = cv2.distanceTransform((mask == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    far = (mask == 0) & (distance > FAR * len(mask)) if (mask > 0).any() else mask == 0
    return MatteFacts(
        low=int(mask.min()),
        high=int(mask.max()),
        coverage=float(covered.mean()),
        outside=np.median(image[far], axis=0) if far.any() else None,
        outside_off=float(off[far].mean()) if far.any() else 0.0,
        inside_empty=float((~off)[covered].mean()) if covered.any() else 0.0,
        fringe=_fringe(image, mask, ground),
    )


def _fringe(image: ByteArray, mask: ByteArray, ground: FloatArray) -> float | None:
    """See `MatteFacts.fringe`."""
    alpha = mask.astype(np.float32) / 255
    inner = (alpha > 0.98).astype(np.float32)
    size = 2 * max(2, round(0.01 * len(mask))) + 1
    weight = cv2.blur(inner, (size, size))
    colours = image.astype(np.float32)
    nearby = cv2.blur(colours * inner[..., None], (size, size)) / np.maximum(weight, 1e-6)[..., None]
    expected = alpha * nearby.mean(axis=2)
    added = (colours - (1 - alpha)[..., None] * ground.astype(np.float32)).mean(axis=2)
    # A dark subject adds next to nothing, whatever was done to it.
    telling = (alpha > SOFT[0]) & (alpha < SOFT[1]) & (weight > 0.05) & (expected > 0.1 * 255 * alpha)
    if telling.sum() < MIN_FRINGE_PIXELS:
        return None
    return float(np.median(added[telling] / expected[telling]))
