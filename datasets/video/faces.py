"""Where the head is in the frames of a video."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...bench.contracts import BoolArray, ByteArray, FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.landmark_network import COUNT, LandmarkNetwork

LEAST_SEEN = 0.5
"""Part of the frames in which a face has to be found."""
ABOVE, BELOW, BESIDE = 1.0, 0.6, 0.8
"""Room around the landmarks in a crop, relative to their height or width: hair, neck, and turns of the head."""


class FoundFaces(NamedTuple):
    """Landmarks of T frames."""

    pixels: FloatArray
    """(T, L, 2) pixels of the upright frames; NaN where no face is found."""

    @property
    def found(self) -> BoolArray:
        """(T,) whether the frame shows a face."""
        return np.asarray(np.isfinite(self.pixels).all(axis=(1, 2)))


class Crop(NamedTuple):
    """A box of the upright frames, pixels."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: ByteArray) -> ByteArray:
        """The part of an (H, W, ...) image."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


def find_faces(
    path: Path, frames: Iterable[ByteArray], network: LandmarkNetwork, progress: Progress = no_progress
) -> FoundFaces:
    """Landmarks of all frames; each is searched around those of the frame before, then everywhere.

    Raises `InputError` where too few frames show a face.
    """
    found, near = [], None
    for number, frame in enumerate(frames):
        near = network.find(frame, near)
        found.append(np.full((COUNT, 2), np.nan) if near is None else near)
        progress(number + 1, number + 1, "landmarks")
    faces = FoundFaces(np.stack(found) if found else np.zeros((0, COUNT, 2)))
    seen = int(faces.found.sum())
    if seen < max(1, LEAST_SEEN * len(found)):
        expected = f"a face in at least {LEAST_SEEN:.0%} of the frames"
        remedy = "Film one face, upright, lit from the front, at least a third of the picture's height."
        raise InputError(path, "", expected, f"one in {seen} of {len(found)}", remedy)
    return faces


def crop_around(faces: FoundFaces, width: int, height: int) -> Crop:
    """The box that holds the head in all frames with a face, inside the picture."""
    seen = faces.pixels[faces.found]
    low, high = seen.min(axis=1), seen.max(axis=1)  # (T, 2)
    sides = np.median(high - low, axis=0)
    first = np.floor(low.min(axis=0) - sides * [BESIDE, ABOVE]).astype(int).clip(0)
    last = np.ceil(high.max(axis=0) + sides * [BESIDE, BELOW]).astype(int)
    last = np.minimum(last, [width, height])
    return Crop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
