"""Soft masks of a person in front of a room: coverage refined by the colours of the frame, and colours without the room.

The colour of a pixel near the outline is a mixture a F + (1 - a) B of the colours of the person and the room, both
estimated from pixels nearby that are surely of one of them. The coverage a is where the colour lies between the two, then
smoothed by the guided filter (He et al., "Guided image filtering", 2013). The person's colour F is what the frame leaves
for it, as in Forte, "Approximate fast foreground colour estimation", 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ...bench.contracts import ByteArray, FloatArray

UNITS = 256
"""Resolution of masks before they are refined. Lengths are in units of the longer side by this."""
SURE = 230
"""Coverage from which a pixel is the person's, and 255 minus that up to which it is the room's, of 255, if those within a
unit are, too."""
CELLS, FARTHER = 128, 17
"""Colours of person and room are means over 3 cells of this fraction of the longer side; where there are none, over the
second number, and where there are none, over the frame."""
CONTRAST = 0.05
"""Squared distance of the two colours in RGB from 0 to 1 at which colour and mask determine the coverage equally."""
RADIUS, SMOOTHNESS = 2, 6.5
"""Of the guided filter: units and squared levels of 255."""
CLEAN = 0.05
"""Coverage up to which a pixel is empty, and 1 minus that from which it is full."""
REACH = 4
"""Units within which coverage is partial beside the person, and on the person beside the room."""


class _Outline(NamedTuple):
    """Pixels where a mask may be partial."""

    inside: npt.NDArray[np.bool_]
    """(H, W) surely of the person."""
    near: npt.NDArray[np.bool_]
    """(H, W) pixels, N in number, that are surely of neither."""
    person: FloatArray
    room: FloatArray
    """(N, 3) colours in [0, 1]."""

    @classmethod
    def of(cls, image: ByteArray, mask: ByteArray) -> _Outline:
        """Colours decide about the surroundings of the room alone: inside the face, a highlight may look like the room."""
        kernel = _disk(_unit(mask))
        inside, outside = cv2.erode(mask, kernel) > SURE, cv2.dilate(mask, kernel) < 255 - SURE
        _, parts = cv2.connectedComponents((mask <= 127).astype(np.uint8))
        room = np.bincount(parts[outside], minlength=parts.max() + 1) > 0  # others are holes
        beside = cv2.dilate(room[parts].astype(np.uint8), _disk(REACH * _unit(mask))) > 0
        inside |= ~beside
        near = ~(inside | outside)
        return cls(inside, near, _colours(image, inside)[near], _colours(image, outside)[near])


def refined_mask(image: ByteArray, mask: ByteArray, face: FloatArray) -> ByteArray:
    """(H, W) 8-bit coverage of the person with the landmarks ``face``, (L, 2) pixels, in an (H, W, 3) image, from a coarse mask."""
    mask = _connected(mask, face)
    outline = _Outline.of(image, mask)
    coverage = np.where(outline.inside, np.float32(1), np.float32(0))
    given = mask[outline.near] / np.float32(255)
    span = outline.person - outline.room
    contrast = (span**2).sum(axis=1)
    along = ((image[outline.near] / np.float32(255) - outline.room) * span).sum(axis=1)
    share = (along / np.maximum(contrast, 1e-6)).clip(0, 1)
    coverage[outline.near] = given + contrast / (contrast + CONTRAST) * (share - given)
    smooth = cv2.ximgproc.guidedFilter(image, coverage, RADIUS * _unit(mask), SMOOTHNESS)
    return np.asarray(np.rint(255 * ((smooth - CLEAN) / (1 - 2 * CLEAN)).clip(0, 1)), np.uint8)


def without_room(image: ByteArray, mask: ByteArray) -> ByteArray:
    """An (H, W, 3) image with the person's own colour where the (H, W) mask is partial, for any background. Fully covered
    pixels do not change."""
    outline = _Outline.of(image, mask)
    share = mask[outline.near][:, None] / np.float32(255)
    mixed = share * outline.person + (1 - share) * outline.room
    colours = outline.person + share * (image[outline.near] / np.float32(255) - mixed)
    result = image.copy()
    result[outline.near] = np.rint(255 * colours.clip(0, 1))
    return result


def _unit(mask: ByteArray) -> int:
    return max(1, round(max(mask.shape) / UNITS))


def _disk(radius: int) -> ByteArray:
    return np.asarray(
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8
    )


def _connected(mask: ByteArray, face: FloatArray) -> ByteArray:
    """The part of a mask that is connected with most landmarks, and partial coverage within `REACH` of it."""
    _, labels = cv2.connectedComponents((mask > 127).astype(np.uint8))
    columns, rows = (np.rint(face).astype(int).clip(0, np.array(mask.shape)[::-1] - 1)).T
    counts = np.bincount(labels[rows, columns])
    counts[0] = 0
    if not counts.any():
        return mask
    person = (labels == counts.argmax()).astype(np.uint8)
    return np.where(cv2.dilate(person, _disk(REACH * _unit(mask))) > 0, mask, 0).astype(np.uint8)


def _colours(image: ByteArray, chosen: npt.NDArray[np.bool_]) -> FloatArray:
    """(H, W, 3) mean colour in [0, 1] of the chosen pixels nearest to each."""
    height, width = chosen.shape
    scale = CELLS / max(height, width)
    cells = max(1, round(width * scale)), max(1, round(height * scale))
    weights = 255 * chosen.astype(np.uint8)
    layers = np.dstack([cv2.bitwise_and(image, image, mask=weights), weights]).astype(np.float32)
    sums = cv2.resize(layers, cells, interpolation=cv2.INTER_AREA)
    sums = cv2.blur(sums, (3, 3)) + 1e-3 * cv2.blur(sums, (FARTHER, FARTHER)) + 1e-6 * sums.mean(axis=(0, 1))
    return cv2.resize(sums[..., :3] / np.maximum(sums[..., 3:], 1e-6), (width, height))
