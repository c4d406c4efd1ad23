"""Statistics of decoded sample frames, and search for near-duplicate images.

Frames of one camera are similar, so a perceptual hash alone gives false positives. The hash is a difference hash
(signs of horizontal steps of brightness); a candidate pair counts if the thumbnails differ by less than re-saving an
image changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo
from ..ga.transforms import FrameEntry
from .mesh import MeshFacts, compare_mesh

if TYPE_CHECKING:
    from .evidence import Evidence

BACKGROUND_LEVELS = 12
"""Maximum difference of any channel of background pixels; JPEG changes flat areas by less."""

FLAT_LEVELS, ROOM = 3, 0.02
"""Maximum difference from the median in corners of one colour, and maximum fraction of other pixels in them."""

BLANK_LEVELS = 2.0
"""Images with less `structure` have a single colour."""

SENSOR_NOISE = 20.0
"""Levels; larger variation from pixel to pixel is texture."""

FAR = 0.02
"""Minimum distance of background pixels from the foreground, as a fraction of the image's height."""

SOFT = (0.25, 0.75)
"""Range of coverage of soft pixels, which show how a mask was composited."""

MIN_FRINGE_PIXELS = 12

BLANK_COVERAGE = 0.001

MASK_LEVELS = (12, 240)
"""Maximum level of what is outside a mask, and minimum level of what is inside."""


@dataclass(frozen=True, eq=False)
class MaskFacts:
    """Facts on a frame's mask, and on the image outside of the subject."""

    low: int
    high: int
    coverage: float
    outside: FloatArray | None
    """Median colour (3,) far from the foreground, 8-bit levels; None if there are no such pixels."""
    outside_off: float
    """Fraction of those pixels that differ from the declared background."""
    inside_empty: float
    """Fraction of the foreground that has the background's colour."""
    fringe: float | None
    """Median over soft pixels of (I - (1-a) B) / (a F), the subject's measured contribution to the image over the
    expected one, with F the mean colour of the covered pixels nearby; 1 for a clean straight-alpha composite, a (0.5) for
    one premultiplied twice. None with too few soft pixels."""

    @property
    def other_levels(self) -> bool:
        """Whether nothing is covered fully, or everything a little."""
        return 0 < self.high < MASK_LEVELS[1] or MASK_LEVELS[0] < self.low <= 127

    @property
    def empty(self) -> bool:
        """Whether nothing is covered."""
        return self.coverage < BLANK_COVERAGE and not self.other_levels

    @property
    def full(self) -> bool:
        """Whether everything is covered."""
        return self.low > 127

    @property
    def inverted(self) -> bool:
        """Whether the background is covered."""
        return not self.full and self.inside_empty > 0.5 and self.outside_off > 0.3

    @property
    def sound(self) -> bool:
        """Whether it has none of these faults."""
        return not (self.other_levels or self.empty or self.full or self.inverted)


@dataclass(frozen=True, eq=False)
class ViewFacts:
    """Facts on one decoded frame."""

    entry: FrameEntry
    low: int = 0
    high: int = 0
    """Minimum and maximum level of any pixel's channels."""
    subject_low: int = 0
    subject_high: int = 0
    """Minimum and maximum over pixels fully covered by the subject."""
    grey: bool = False
    corners: FloatArray | None = None
    """Median colour (3,) of the upper corners."""
    corners_off: float = 0.0
    """Fraction of their pixels that differ from the declared background."""
    room: bool = False
    """Whether these pixels have several colours, as if a room is shown and no background was set."""
    blank: bool = False
    """Whether its pixels (the subject's if there is a mask) have no more contrast than noise."""
    has_alpha: bool = False
    """Whether the image has an alpha channel, which then is its mask."""
    mask: MaskFacts | None = None
    """None without a mask, or if it cannot be decoded or has another size."""
    mesh: MeshFacts | None = None
    """None if the frame has no pose or no head."""
    error: InputError | None = None
    """Why the image cannot be decoded; all other fields are then empty."""

    @property
    def has_sound_mask(self) -> bool:
        """Whether it has a mask that the geometry can be compared with."""
        return self.mask is not None and self.mask.sound


def pick_views(entries: Sequence[FrameEntry], count: int) -> list[FrameEntry]:
    """Up to ``count`` frames, evenly spaced over timesteps, with alternating cameras."""
    groups: dict[int, list[FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.timestep, e.camera_index)):
        groups.setdefault(entry.timestep, []).append(entry)
    if not groups or count < 1:
        return []
    timesteps = sorted(groups)
    where = np.linspace(0, len(timesteps) - 1, count).round().astype(int)
    spread = (groups[timesteps[t]] for t in where)
    chosen = [group[i % len(group)] for i, group in enumerate(spread)]
    return list({id(entry): entry for entry in chosen}.values())


def inspect_views(evidence: Evidence, entries: Sequence[FrameEntry]) -> list[ViewFacts]:
    """Decode frames and keep the facts needed by the checks, without the pixels."""
    views = []
    for done, entry in enumerate(entries, start=1):
        evidence.progress(done, len(entries), "looking at frames")
        try:
            image, mask = evidence.pixels.image(entry), evidence.pixels.mask(entry)
        except InputError as error:
            views.append(ViewFacts(entry, error=error))
            continue
        subject, pose = evidence.subject, evidence.pose(entry.timestep)
        mesh = None
        if subject is not None and pose is not None:
            mesh = compare_mesh(subject, pose, evidence.camera(entry), image, mask)
        info = evidence.headers[entry.image]
        views.append(_facts(entry, info, image, mask, mesh, evidence.background))
    return views


def _facts(
    entry: FrameEntry,
    info: ImageInfo,
    image: ByteArray,
    mask: ByteArray | None,
    mesh: MeshFacts | None,
    background: Sequence[float],
) -> ViewFacts:
    ground = np.round(np.asarray(background) * 255).astype(np.int16)
    off = np.abs(image.astype(np.int16) - ground).max(axis=2) > BACKGROUND_LEVELS
    shown = mask > 250 if mask is not None else off  # no mixture with the background
    pixels = image[shown] if shown.any() else image.reshape(-1, 3)
    width = max(1, info.width // 10)
    corners = np.zeros(off.shape, dtype=bool)
    corners[:width, :width] = corners[:width, -width:] = True
    colour = np.median(image[corners], axis=0)
    return ViewFacts(
        entry=entry,
        low=int(image.min()),
        high=int(image.max()),
        subject_low=int(pixels.min()),
        subject_high=int(pixels.max()),
        grey=bool((image == image[..., :1]).all()),
        corners=colour,
        room=float((np.abs(image[corners] - colour).max(axis=1) > FLAT_LEVELS).mean()) > ROOM,
        corners_off=float(off[corners].mean()),
        blank=_blank(image, shown, off),
        has_alpha=info.has_alpha,
        mask=None if mask is None else _mask_facts(image, mask, off, ground),
        mesh=mesh,
    )


def _blank(image: ByteArray, shown: np.ndarray, off: np.ndarray) -> bool:
    """Whether the subject's pixels have a single colour other than the background's (which indicates a wrong mask)."""
    grey = image.astype(np.float32).mean(axis=2)
    if structure(grey, np.ones_like(shown)) < BLANK_LEVELS:
        return True
    return bool(shown.any() and off[shown].mean() > 0.5 and structure(grey, shown) < BLANK_LEVELS)


def _mask_facts(image: ByteArray, mask: ByteArray, off: np.ndarray, ground: np.ndarray) -> MaskFacts:
    covered = mask > 127
    distance = cv2.distanceTransform((mask == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    far = (mask == 0) & (distance > FAR * len(mask)) if (mask > 0).any() else mask == 0
    return MaskFacts(
        low=int(mask.min()),
        high=int(mask.max()),
        coverage=float(covered.mean()),
        outside=np.median(image[far], axis=0) if far.any() else None,
        outside_off=float(off[far].mean()) if far.any() else 0.0,
        inside_empty=float((~off)[covered].mean()) if covered.any() else 0.0,
        fringe=_fringe(image, mask, ground),
    )


def _fringe(image: ByteArray, mask: ByteArray, ground: np.ndarray) -> float | None:
    """See `MaskFacts.fringe`."""
    alpha = mask.astype(np.float32) / 255
    inner = (alpha > 0.98).astype(np.float32)
    size = 2 * max(2, round(0.01 * len(mask))) + 1
    weight = cv2.blur(inner, (size, size))
    colours = image.astype(np.float32)
    nearby = cv2.blur(colours * inner[..., None], (size, size)) / np.maximum(weight, 1e-6)[..., None]
    expected = alpha * nearby.mean(axis=2)
    added = (colours - (1 - alpha)[..., None] * ground.astype(np.float32)).mean(axis=2)
    # A dark subject adds almost nothing to soft pixels.
    telling = (alpha > SOFT[0]) & (alpha < SOFT[1]) & (weight > 0.05) & (expected > 0.1 * 255 * alpha)
    if telling.sum() < MIN_FRINGE_PIXELS:
        return None
    return float(np.median(added[telling] / expected[telling]))


SIDE = 32
"""Thumbnails are square with this many pixels a side."""

HASH_DISTANCE = 0.1
"""Maximum fraction of different hash bits of near-duplicates."""

LEVELS = 2.0
"""Largest `difference` between two thumbnails of near-duplicates, 8-bit levels."""

SUBJECT_LEVELS = 4.0
"""Minimum difference of a thumbnail's pixel from the upper corners for the subject."""

_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Thumbnail of a frame."""

    split: str
    entry: FrameEntry
    grey: FloatArray
    """(SIDE, SIDE) float32 levels."""
    bits: FloatArray
    """(SIDE * (SIDE - 1),) float32, +1 where brightness increases to the right by more than a level, else -1."""
    shown: np.ndarray
    """(SIDE, SIDE) bool, whether it differs from the upper corners."""


def make_thumbnails(evidence: Evidence, limit: int) -> list[Thumbnail]:
    """Thumbnails of up to ``limit`` frames, an equal share of every split, evenly spaced in each."""
    splits = {name: entries for name, entries in evidence.imaged.items() if entries}
    chosen: list[tuple[str, FrameEntry]] = []
    for left, name in zip(range(len(splits), 0, -1), sorted(splits, key=lambda name: len(splits[name]))):
        entries = splits[name]
        count = min(len(entries), max(0, limit - len(chosen)) // left)
        chosen += [(name, entries[i]) for i in np.unique(np.linspace(0, len(entries) - 1, count).astype(int))]
    thumbnails = []
    for done, (name, entry) in enumerate(chosen, start=1):
        evidence.progress(done, len(chosen), "comparing images")
        try:
            image = evidence.pixels.image(entry)
        except InputError:
            continue  # damaged images are reported by other checks
        thumbnails.append(_shrink(name, entry, image))
    return thumbnails


def _shrink(split: str, entry: FrameEntry, image: np.ndarray) -> Thumbnail:
    small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = small.mean(axis=2)
    # The declared background may be wrong, so the corners are used.
    ground = np.median([small[0, 0], small[0, -1], small[1, 0], small[1, -1]], axis=0)
    bits = np.where(np.diff(grey, axis=1) > 1, 1.0, -1.0).astype(np.float32).ravel()
    return Thumbnail(split, entry, grey, bits, np.abs(small - ground).max(axis=2) > SUBJECT_LEVELS)


def near_duplicates(
    one: Sequence[Thumbnail], other: Sequence[Thumbnail]
) -> Iterator[tuple[Thumbnail, Thumbnail]]:
    """Pairs of near-duplicates, one from each list."""
    if not one or not other:
        return
    bits = np.stack([thumbnail.bits for thumbnail in other])
    for start in range(0, len(one), _BLOCK):
        block = one[start : start + _BLOCK]
        agreement = np.stack([thumbnail.bits for thumbnail in block]) @ bits.T / bits.shape[1]
        for i, j in np.argwhere(agreement >= 1 - 2 * HASH_DISTANCE):
            if difference(block[i], other[j]) <= LEVELS:
                yield block[i], other[j]


def difference(one: Thumbnail, other: Thumbnail) -> float:
    """95th percentile of the absolute difference, in levels, over the pixels that show the subject in either.

    A moving face differs strongly in few places, a re-saved image slightly everywhere. Infinite if both frames are
    empty, since these are no evidence.
    """
    shown = one.shown | other.shown
    if not shown.any():
        return float("inf")
    return float(np.percentile(np.abs(one.grey - other.grey)[shown], 95))


def structure(grey: FloatArray, shown: np.ndarray) -> float:
    """Standard deviation in levels of a smoothed image (H, W) over the pixels ``shown``, minus that expected from
    white noise: about 0 for pure noise."""
    if not shown.any():
        shown = np.ones_like(shown)
    size = max(3, len(grey) // 24)
    weight = cv2.blur(shown.astype(np.float32), (size, size))
    smooth = cv2.blur(grey * shown, (size, size)) / np.maximum(weight, 1e-6)
    noise = min(float(np.var((grey - smooth)[shown])), SENSOR_NOISE**2) / (size * size)
    return float(np.sqrt(max(0.0, float(np.var(smooth[shown])) - 2 * noise)))
