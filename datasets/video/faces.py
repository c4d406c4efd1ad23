"""Where the head of one person is in the frames of a video."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...bench.contracts import BoolArray, ByteArray, FloatArray, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import Member, store_arrays, stored_arrays
from ...bench.landmark_network import COUNT, LandmarkNetwork, face_distance, same_face
from .decode import TimedFrame

LEAST_SEEN = 0.5
"""Part of the frames in which a face has to be found."""
ABOVE, BELOW, BESIDE = 1.0, 0.6, 0.8
"""Room around the landmarks in a crop, relative to their height or width: hair, neck, and turns of the head."""
SEARCHED = 10
"""In every frame of this number the whole picture is searched for further faces."""
STORED_S = 10.0
"""Seconds after which landmarks are stored again, for a run that is interrupted."""


class FoundFaces(NamedTuple):
    """Landmarks of one person in T frames."""

    numbers: IntArray
    """(T,) numbers of the frames in the file."""
    pixels: FloatArray
    """(T, L, 2) pixels of the upright frames; NaN where the face is not found."""
    others: IntArray
    """(T,) how many other faces were seen."""

    @property
    def found(self) -> BoolArray:
        """(T,) whether the frame shows the face."""
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


@dataclass
class FaceFollower:
    """Follows the face of one person, and all others in order not to take one of them for it.

    The person is the one with the largest face in the first frame that shows a face. From then on a face is the person's because
    it is where that was in the frame before. Where the face is lost, the whole picture is searched, and the person is the face that
    is no other's and nearest to the last place.

    Attributes
    ----------
    last : FloatArray | None
        (COUNT, 2) landmarks of the person where they were last seen, pixels.
    lost : bool
        Whether the latest frame does not show them.
    others : list[FloatArray]
        (COUNT, 2) landmarks of every other face of the latest frame.
    """

    network: LandmarkNetwork
    last: FloatArray | None = None
    lost: bool = True
    others: list[FloatArray] = field(default_factory=list)

    def follow(self, image: ByteArray, search: bool) -> FloatArray | None:
        """The person's landmarks in the next frame, (COUNT, 2) pixels, or None; ``search`` looks for further faces."""
        own = None if self.lost or self.last is None else self.network.follow(image, self.last)
        others: list[FloatArray] = []
        for before in self.others:
            now = self.network.follow(image, before)
            if now is None or any(same_face(now, other) for other in others):
                continue
            if own is not None and self.last is not None and same_face(own, now):
                if face_distance(own, self.last) <= face_distance(now, before):
                    continue  # the other one is hidden or has left
                own = None
            others.append(now)
        if own is None or search:
            seen = [] if own is None else [own]
            new = [
                face
                for face in self.network.find_all(image)
                if not any(same_face(face, known) for known in [*seen, *others])
            ]
            if own is None and new:
                last = self.last
                own = new[0] if last is None else min(new, key=lambda face: face_distance(face, last))
            others += [face for face in new if face is not own]
        self.last, self.lost, self.others = self.last if own is None else own, own is None, others
        return own


_STORED = {
    "numbers": Member("i", ("T",)),
    "found": Member("b", ("T",)),
    "pixels": Member("f", ("T", COUNT, 2)),
    "others": Member("i", ("T",)),
    "last_others": Member("f", (None, COUNT, 2)),
    "finished": Member("b", ()),
}


def find_faces(
    path: Path,
    frames: Iterable[TimedFrame],
    network: LandmarkNetwork,
    store: Path,
    mark: str,
    progress: Progress = no_progress,
) -> FoundFaces:
    """Landmarks of one person in all frames, by `FaceFollower`.

    Parameters
    ----------
    path : Path
        The video, for messages.
    frames : Iterable[TimedFrame]
        Its frames; not iterated if an earlier call has finished.
    store : Path
        File of the landmarks, written meanwhile, whose frames a later call does not search again.
    mark : str
        Digest of everything that the landmarks depend on.

    Raises
    ------
    InputError
        Too few frames show the person.
    """
    kept = stored_arrays(store, mark, _STORED)
    if kept is None or not kept["finished"]:
        kept = _search(frames, network, kept, store, mark, progress)
    found, count = kept["found"], len(kept["found"])
    seen = int(found.sum())
    if seen < max(1, LEAST_SEEN * count):
        expected = f"the face of one person in at least {LEAST_SEEN:.0%} of the frames"
        said = f"it in {seen} of {count}" if seen else f"no face in any of {count}"
        remedy = "Film one face, upright, lit from the front, at least a third of the picture's height."
        raise InputError(path, "", expected, said, remedy)
    pixels = np.where(found[:, None, None], kept["pixels"], np.nan)
    return FoundFaces(kept["numbers"], pixels, kept["others"])


def _search(
    frames: Iterable[TimedFrame],
    network: LandmarkNetwork,
    kept: dict[str, np.ndarray] | None,
    store: Path,
    mark: str,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Search the frames after those that are ``kept``; the arrays of `_STORED`, which are also stored."""
    follower = FaceFollower(network)
    numbers: list[int] = []
    rows: list[FloatArray | None] = []
    others: list[int] = []
    if kept is not None:
        numbers, others = kept["numbers"].tolist(), kept["others"].tolist()
        rows = [pixels if found else None for pixels, found in zip(kept["pixels"], kept["found"])]
        last = next((row for row in reversed(rows) if row is not None), None)
        follower = FaceFollower(network, last, not rows or rows[-1] is None, [*kept["last_others"]])

    def arrays(finished: bool) -> dict[str, np.ndarray]:
        empty = np.zeros((COUNT, 2))
        return {
            "numbers": np.array(numbers, np.int64),
            "found": np.array([row is not None for row in rows], bool),
            "pixels": np.array([empty if row is None else row for row in rows]).reshape(-1, COUNT, 2),
            "others": np.array(others, np.int64),
            "last_others": np.array(follower.others).reshape(-1, COUNT, 2),
            "finished": np.array(finished),
        }

    finished, since = False, time.monotonic()
    try:
        for index, frame in enumerate(frames):
            if index >= len(numbers):
                row = follower.follow(frame.image, index % SEARCHED == 0)
                numbers.append(frame.number)
                rows.append(row)
                others.append(len(follower.others))
                if time.monotonic() - since > STORED_S:
                    store_arrays(store, mark, arrays(False))
                    since = time.monotonic()
            progress(index + 1, index + 1, "landmarks")
        finished = True
    finally:
        if numbers:
            store_arrays(store, mark, arrays(finished))
    return arrays(True)


def crop_around(faces: FoundFaces, width: int, height: int) -> Crop:
    """The box that holds the head in all frames with a face, inside the picture."""
    seen = faces.pixels[faces.found]
    low, high = seen.min(axis=1), seen.max(axis=1)  # (T, 2)
    sides = np.median(high - low, axis=0)
    first = np.floor(low.min(axis=0) - sides * [BESIDE, ABOVE]).astype(int).clip(0)
    last = np.ceil(high.max(axis=0) + sides * [BESIDE, BELOW]).astype(int)
    last = np.minimum(last, [width, height])
    return Crop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
