"""Masks of a head by the difference from what is behind it, for a camera that stands still."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from ...bench.contracts import BoolArray, ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.landmark_network import face_size
from .faces import BELOW

SAMPLES = 60
"""Frames from which the background is learnt."""
AROUND = 0.35
"""The head is looked for within this distance of its landmarks, relative to the face's size."""
LEAST_SHARE = 0.1
"""Part of the frames in which the background of a pixel has to be visible."""
LEAST_LEVELS, NOISES = 12.0, 6.0
"""Difference from the background that shows a person: levels of 255, and multiples of the noise of the pixel."""
MOST_NOISE, MOST_NOISY = 12.0, 0.25
"""Noise of a pixel whose background moves, levels, and the part of such pixels from which the camera counts as moved."""
LEAST_REVEALED = 0.6
"""Part of the surroundings of the face whose background has to be known, median over the frames."""
_REMEDY = "Give masks of another program by --masks FOLDER, or --segmentation."


class HeadMask(NamedTuple):
    """A mask of a frame."""

    mask: ByteArray
    """(H, W) 255 for the person."""
    unsure: float
    """Pixels of which the difference says little, relative to those of the person: the background behind them was never visible, or the
    difference is near the threshold."""


class Background(NamedTuple):
    """What is behind the head."""

    colours: FloatArray
    """(H, W, 3) levels; interpolated where it was never visible."""
    known: BoolArray
    """(H, W) whether it was visible."""
    threshold: FloatArray
    """(H, W) levels of difference that show a person."""

    def mask(self, image: ByteArray, face: FloatArray) -> HeadMask:
        """The mask of an (H, W, 3) image of the same view with the landmarks ``face``, (L, 2) pixels.

        It has the component of the difference that holds the face, without holes, and ends `BELOW` the chin: a torso that hardly moves
        cannot be told from the room.
        """
        hull, region, above = _regions(image.shape[:2], face)
        outside = self.known & ~region
        levels = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
        colours = self.colours
        if outside.any():  # phones change the exposure
            colours = (
                colours * (np.median(levels[outside], axis=0) + 1) / (np.median(colours[outside], axis=0) + 1)
            )
        difference = np.abs(levels - colours).max(axis=2)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        differs = (((difference > self.threshold) | hull) & above).astype(np.uint8)
        differs = cv2.morphologyEx(differs, cv2.MORPH_OPEN, kernel)
        differs = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, kernel, iterations=2)
        _, labels = cv2.connectedComponents(differs)
        counts = np.bincount(labels[hull], minlength=2)
        counts[0] = 0
        mask = ndimage.binary_fill_holes(labels == counts.argmax()) & above
        near = cv2.dilate(mask.astype(np.uint8), kernel, iterations=3).astype(bool) & above & ~hull
        ratio = difference / self.threshold
        unsure = near & (~self.known | ((ratio > 0.5) & (ratio < 2)))
        return HeadMask(np.where(mask, 255, 0).astype(np.uint8), float(unsure.sum() / max(1, mask.sum())))


def learn_background(path: Path, images: Sequence[ByteArray], faces: FloatArray) -> Background:
    """The median of each pixel over the frames in which the head is elsewhere.

    Parameters
    ----------
    path : Path
        The video, for messages.
    images : Sequence[ByteArray]
        N images (H, W, 3) of one view, spread over the video.
    faces : FloatArray
        (N, L, 2) landmarks in them, pixels.

    Raises
    ------
    InputError
        The camera moves, or the head does not move enough to show what is behind it.
    """
    shape = images[0].shape[:2]
    regions = [_regions(shape, face) for face in faces]
    heads = np.stack([region for _, region, _ in regions])
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), 1.0) for image in images])
    known = (~heads).sum(axis=0) >= max(3, LEAST_SHARE * len(images))
    colours, noise = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    for row in range(shape[0]):  # one at a time, for the memory
        (columns,) = np.nonzero(known[row])
        hidden = heads[:, row, columns, None]
        values = np.where(hidden, np.nan, blurred[:, row, columns].astype(np.float32))
        if len(columns):
            colours[row, columns] = np.nanmedian(values, axis=0)
            away = np.abs(values - colours[row, columns]).max(axis=2)
            noise[row, columns] = 1.4826 * np.nanmedian(away, axis=0)
    moved = float((noise[known] > MOST_NOISE).mean()) if known.any() else 0.0
    if moved > MOST_NOISY:
        expected = "a camera that stands still before a room without motion, for --masks background"
        raise InputError(path, "", expected, f"a background of which {moved:.0%} changes", _REMEDY)
    shown = [
        (known & ring).sum() / max(1, ring.sum())
        for hull, head, above in regions
        if (ring := head & above & ~hull).any()
    ]
    revealed = float(np.median(shown)) if shown else 0.0
    if revealed < LEAST_REVEALED:
        expected = f"a head that moves until {LEAST_REVEALED:.0%} of the background around it was visible"
        remedy = f"Film again and move to both sides by half a head's width. {_REMEDY}"
        raise InputError(path, "", f"{expected}, for --masks background", f"{revealed:.0%}", remedy)
    unknown = np.where(known, 0, 255).astype(np.uint8)
    filled = cv2.inpaint(np.rint(colours).astype(np.uint8), unknown, 3, cv2.INPAINT_TELEA)
    colours = np.where(known[..., None], colours, filled).astype(np.float32)
    return Background(colours, known, np.maximum(LEAST_LEVELS, NOISES * noise))


def _regions(shape: tuple[int, ...], face: FloatArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """(H, W): the hull of the landmarks, where the head may be, and what is not below the neck."""
    hull = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(face).astype(np.int32)), 1)
    size, (left, top), (right, bottom) = face_size(face), face.min(axis=0), face.max(axis=0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    neck = (x >= left) & (x <= right) & (y > (top + bottom) / 2)
    region = (cv2.distanceTransform(1 - hull, cv2.DIST_L2, 5) < AROUND * size) | neck
    return hull.astype(bool), region, y < bottom + BELOW * (bottom - top)
