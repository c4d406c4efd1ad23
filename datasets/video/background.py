"""Masks of a person by background subtraction of the empty room, for a static camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from ...bench.contracts import ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.landmark_network import face_size
from .faces import BELOW

SAMPLES, LEAST_EMPTY = 60, 10
"""Maximum and minimum number of frames of the empty room from which the background is learnt."""
LEAST_LEVELS, NOISES = 12.0, 6.0
"""Minimum difference from the background of foreground: levels of 255, and multiples of the pixel's noise."""
MOST_NOISE, MOST_NOISY = 12.0, 0.25
"""Noise above which a pixel's background moves, levels, and fraction of such pixels above which the camera counts as moved."""
MOST_UNSURE = 0.5
"""Maximum of `HeadMask.unsure`, median of `CHECKED` frames."""
CHECKED = 12
BLUR = 1.0  # pixels
_USE = "for --masks background"
_OTHERWISE = "or give --segmentation, or masks of another program by --masks FOLDER."
_REMEDY = f"Film again and leave the picture for a few seconds; {_OTHERWISE}"
_MOVED = f"Film again with a camera that stands still, and leave the picture for a few seconds; {_OTHERWISE}"


class HeadMask(NamedTuple):
    """A mask of a frame."""

    mask: ByteArray
    """(H, W) 255 for the person."""
    unsure: float
    """Ambiguous pixels relative to those of the person: near the outline, those with a difference near the threshold; inside
    the face, those that look like the background."""


class Background(NamedTuple):
    """The room without anyone."""

    colours: FloatArray
    """(H, W, 3) levels."""
    threshold: FloatArray
    """(H, W) minimum difference of foreground, levels."""

    def mask(self, image: ByteArray, face: FloatArray) -> HeadMask:
        """The mask of an (H, W, 3) image of the same view with the landmarks ``face``, (L, 2) pixels.

        It is the connected part of the difference that holds the face, without holes, and ends `BELOW` the chin as crops do.
        """
        hull = np.zeros(image.shape[:2], np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(face).astype(np.int32)), 1)
        inside, bottom = hull.astype(bool), float(face[:, 1].max())
        above = np.arange(len(hull))[:, None] < bottom + BELOW * (bottom - face[:, 1].min())
        levels = cv2.GaussianBlur(image, (0, 0), BLUR).astype(np.float32)
        # Phones change the exposure; it is estimated from pixels beside the face.
        outside = cv2.distanceTransform(1 - hull, cv2.DIST_L2, 5) > face_size(face) / 2
        outside &= np.arange(len(hull))[:, None] < bottom
        colours = self.colours
        if outside.any():
            colours = (
                colours * (np.median(levels[outside], axis=0) + 1) / (np.median(colours[outside], axis=0) + 1)
            )
        ratio = np.abs(levels - colours).max(axis=2) / self.threshold
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        differs = (((ratio > 1) | inside) & above).astype(np.uint8)
        differs = cv2.morphologyEx(differs, cv2.MORPH_OPEN, kernel)
        differs = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, kernel, iterations=2)
        _, labels = cv2.connectedComponents(differs)
        counts = np.bincount(labels[inside], minlength=2)
        counts[0] = 0
        mask = ndimage.binary_fill_holes(labels == counts.argmax()) & above
        near = cv2.dilate(mask.astype(np.uint8), kernel, iterations=3).astype(bool) & above
        unsure = (near & ~inside & (ratio > 0.5) & (ratio < 2)) | (inside & (ratio < 1))
        return HeadMask(np.where(mask, 255, 0).astype(np.uint8), float(unsure.sum() / max(1, mask.sum())))


def learn_background(path: Path, images: Sequence[ByteArray]) -> Background:
    """The median of each pixel over frames that do not show a face, most of which have to show the empty room.

    Parameters
    ----------
    path : Path
        The video, for messages.
    images : Sequence[ByteArray]
        Images (H, W, 3) of one view.
    """
    if len(images) < LEAST_EMPTY:
        expected = f"at least {LEAST_EMPTY} frames that show nobody's face, {_USE}"
        raise InputError(path, "", expected, f"{len(images)}", _REMEDY)
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), BLUR) for image in images])
    colours, noise = np.empty(blurred.shape[1:], np.float32), np.empty(blurred.shape[1:3], np.float32)
    for row in range(len(colours)):  # one at a time, to limit memory
        values = blurred[:, row].astype(np.float32)
        colours[row] = np.median(values, axis=0)
        noise[row] = 1.4826 * np.median(np.abs(values - colours[row]).max(axis=2), axis=0)
    moved = float((noise > MOST_NOISE).mean())
    if moved > MOST_NOISY:
        expected = f"the same empty room in most frames that show nobody's face, {_USE}"
        raise InputError(path, "", expected, f"{moved:.0%} of the pixels change in them", _MOVED)
    return Background(colours, np.maximum(LEAST_LEVELS, NOISES * noise))


def check_background(
    path: Path, background: Background, images: Sequence[ByteArray], faces: FloatArray
) -> None:
    """Raise `InputError` if masks of images with landmarks (N, L, 2) are too uncertain: the person may be in the background."""
    unsure = float(np.median([background.mask(image, face).unsure for image, face in zip(images, faces)]))
    if unsure > MOST_UNSURE:
        expected = f"masks in which at most {MOST_UNSURE:.0%} of the person's pixels are unsure, {_USE}"
        raise InputError(path, "", expected, f"{unsure:.0%}", _REMEDY)
