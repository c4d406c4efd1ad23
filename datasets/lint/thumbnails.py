"""Near-duplicates among images: a perceptual hash proposes pairs, thumbnails confirm them.

Frames of one camera look much alike, so a hash alone accuses too many. The hash is a difference hash (signs of
horizontal steps of brightness); a proposed pair counts where the thumbnails differ by less than what saving an
image anew changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...bench.contracts import FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ..ga.transforms import FrameEntry
from ..images import read_image

SIDE = 32
"""Thumbnails are square with this many pixels a side."""

HASH_DISTANCE = 0.1
"""Largest share of hash bits in which a near-duplicate may differ."""

LEVELS = 2.0
"""Largest `difference` between two thumbnails of near-duplicates, 8-bit levels."""

SUBJECT_LEVELS = 4.0
"""A thumbnail's pixel shows the subject where it differs from the upper corners by more."""

_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A frame made small.

    Attributes
    ----------
    grey : (SIDE, SIDE) float32 levels.
    bits : (SIDE * (SIDE - 1),) float32, +1 where brightness grows to the right by more than a level, else -1.
    shown : (SIDE, SIDE) bool, where it differs from the upper corners.
    """

    split: str
    entry: FrameEntry
    grey: FloatArray
    bits: FloatArray
    shown: np.ndarray


def make_thumbnails(
    splits: Mapping[str, Sequence[FrameEntry]],
    background: Sequence[float],
    limit: int,
    *,
    progress: Progress = no_progress,
) -> list[Thumbnail]:
    """Thumbnails of up to ``limit`` frames, an equal share of every split, evenly spaced in each."""
    filled = {name: part for name, part in splits.items() if part}
    chosen: list[tuple[str, FrameEntry]] = []
    for left, (name, part) in zip(range(len(filled), 0, -1), sorted(filled.items(), key=_size)):
        count = min(len(part), max(0, limit - len(chosen)) // left)
        chosen += [(name, part[i]) for i in np.unique(np.linspace(0, len(part) - 1, count).astype(int))]
    found = []
    for done, (name, entry) in enumerate(chosen, start=1):
        progress(done, len(chosen), "comparing images")
        try:
            image = read_image(entry.image, background)
        except InputError:
            continue  # damaged inside: the decoded views and the reader report that
        found.append(_shrink(name, entry, image))
    return found


def _size(item: tuple[str, Sequence[FrameEntry]]) -> int:
    return len(item[1])


def _shrink(split: str, entry: FrameEntry, image: np.ndarray) -> Thumbnail:
    small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = small.mean(axis=2)
    # What is declared may be wrong; what lies in the corners is what there is.
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

    A face that moves differs much in few places, an image saved anew little in all. Infinite where neither shows
    anything, as empty frames are no evidence of anything.
    """
    shown = one.shown | other.shown
    if not shown.any():
        return float("inf")
    return float(np.percentile(np.abs(one.grey - other.grey)[shown], 95))
