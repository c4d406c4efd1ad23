"""Localisation of one person's head in the frames of a video.

Boxes of faces by MediaPipe's face detector, whose file is read without the package mediapipe.

Formats read:

- MediaPipe's face detector. Written by google-ai-edge/mediapipe 0.10.21. Checked on its wheel,
  `mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import BoolArray, ByteArray, FloatArray, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import Member, store_arrays, stored_arrays
from ...bench.io.files import digest, digest_file
from ...bench.io.videos import TimedFrame
from ...bench.landmark_network import (
    COUNT,
    CROP,
    NETWORKS,
    SAME,
    FaceCrop,
    LandmarkNetwork,
    face_distance,
    face_size,
    fetched_network,
    open_network,
    same_face,
)

SIDE, STRIDE = 192, 4
"""Pixels of the square that the network sees, and of one cell of its grid."""
LEAST_SCORE = 0.6
"""Minimum probability of a face."""
OVERLAP = 0.3
"""Minimum intersection over union of boxes of the same face."""
SCALES = (96, 192, 384, 768)
"""Longer sides of the image in which faces are searched, pixels: the network finds faces of about a tenth to a half of `SIDE`."""
SHARED = 64
"""Minimum overlap of neighbouring squares, pixels."""


class FaceDetector:
    """The network in a file."""

    def __init__(self, path: Path):
        expected = "a network that detects faces"
        self._network: Any = open_network(path, expected)
        inputs, outputs = self._network.get_input_details(), self._network.get_output_details()
        shapes = [tuple(map(int, one["shape"])) for one in (*inputs, *outputs)]
        if shapes != [(1, SIDE, SIDE, 3), (1, len(ANCHORS), 16), (1, len(ANCHORS), 1)]:
            raise InputError(path, "", expected, f"inputs and outputs of shapes {shapes}")
        self._input, self._boxes, self._scores = (one["index"] for one in (*inputs, *outputs))

    def detect(self, image: ByteArray) -> list[FaceCrop]:
        """Crops for a network of landmarks of the faces in an (H, W, 3) 8-bit RGB image, the highest score first."""
        detections = []
        longer = max(image.shape[:2])
        for scale in (side / longer for side in SCALES if side <= max(longer, SIDE)):
            size = [max(1, round(scale * side)) for side in image.shape[1::-1]]
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
            for left, top in product(*map(_starts, size)):
                square = np.zeros((SIDE, SIDE, 3), np.uint8)
                tile = small[max(0, top) : top + SIDE, max(0, left) : left + SIDE]
                square[max(0, -top) :, max(0, -left) :][: len(tile), : tile.shape[1]] = tile
                scores, points = self._run(square)
                detections += [
                    np.concatenate([[score], (one + [left, top]).ravel() / scale])
                    for score, one in zip(scores, points)
                ]
        return [_crop(one) for one in _merged(detections)]

    def _run(self, square: ByteArray) -> tuple[FloatArray, FloatArray]:
        """Scores (N,) and points (N, 4, 2), two corners and both eyes, of a square of `SIDE` pixels, values from -1 to 1."""
        self._network.set_tensor(self._input, square[None].astype(np.float32) / 127.5 - 1)
        self._network.invoke()
        logits = self._network.get_tensor(self._scores)[0, :, 0]
        kept = logits > np.log(LEAST_SCORE / (1 - LEAST_SCORE))
        middle, size, *eyes = (
            self._network.get_tensor(self._boxes)[0, kept].reshape(-1, 8, 2)[:, :4].swapaxes(0, 1)
        )
        points = np.stack([middle - size / 2, middle + size / 2, *eyes], axis=1)
        return 1 / (1 + np.exp(-logits[kept])), points + ANCHORS[kept, None]


ANCHORS: FloatArray = STRIDE * (
    np.stack(np.meshgrid(*[np.arange(SIDE // STRIDE)] * 2), axis=-1).reshape(-1, 2) + 0.5
)
"""(A, 2) middles of the grid's cells, pixels of the square."""


def _starts(length: int) -> list[int]:
    """Starts of the squares that cover ``length`` pixels; one alone is centred."""
    if length <= SIDE:
        return [(length - SIDE) // 2]
    count = 1 + -(-(length - SIDE) // (SIDE - SHARED))
    return [*map(int, np.linspace(0, length - SIDE, count))]


def _crop(found: FloatArray) -> FaceCrop:
    """As in MediaPipe's graph of landmarks: the box of a detection enlarged, level with the eyes."""
    low, high, left, right = found[1:].reshape(4, 2)
    return FaceCrop(
        (low + high) / 2, CROP * float((high - low).max()), float(np.arctan2(*(right - left)[::-1]))
    )


def _merged(found: list[FloatArray]) -> list[FloatArray]:
    """Detections (9,), each the mean of those that overlap one of a higher score, weighted by score."""
    left, merged = sorted(found, key=lambda one: -one[0]), []
    while left:
        same = [_overlap(left[0], one) > OVERLAP for one in left]
        cluster = np.stack([one for one, joined in zip(left, same) if joined])
        merged.append(np.concatenate([cluster[:1, 0], cluster[:, 0] @ cluster[:, 1:] / cluster[:, 0].sum()]))
        left = [one for one, joined in zip(left, same) if not joined]
    return merged


def _overlap(first: FloatArray, second: FloatArray) -> float:
    """Intersection over union of the boxes of two detections."""
    sides = np.minimum(first[3:5], second[3:5]) - np.maximum(first[1:3], second[1:3])
    common = sides.clip(0).prod()
    return float(common / ((first[3:5] - first[1:3]).prod() + (second[3:5] - second[1:3]).prod() - common))


class FaceFinder:
    """The landmark network in a file, and the detector in the file beside it or else the one that was fetched. Raises
    as both."""

    def __init__(self, landmarks: Path):
        beside, fetched = (
            landmarks.with_name(Path(NETWORKS["detector"].path).name),
            fetched_network("detector"),
        )
        file = beside if beside.exists() else fetched
        self.network, self.detector = LandmarkNetwork(landmarks), FaceDetector(file)
        self.digest = digest(digest_file(landmarks), digest_file(file))

    def follow(self, image: ByteArray, near: FloatArray) -> FloatArray | None:
        """`LandmarkNetwork.follow`."""
        return self.network.follow(image, near)

    def find_all(self, image: ByteArray) -> list[FloatArray]:
        """(COUNT, 2) landmarks of every face of an (H, W, 3) image, the largest first."""
        faces: list[FloatArray] = []
        for crop in self.detector.detect(image):
            face = self.network.find_in(image, crop)
            # A part of a face that looks like one has a lower score.
            if face is not None and all(face_distance(face, other) > 1 for other in faces):
                faces.append(face)
        return sorted(faces, key=face_size, reverse=True)


LEAST_SEEN = 0.5
"""Minimum fraction of frames with a detected face."""
REMEDY = "Film one face, upright, lit from the front, at least a tenth of the picture's height."
ABOVE, BELOW, BESIDE = 1.0, 0.6, 0.8
"""Room around the landmarks in a crop, relative to their height or width: hair, neck, and turns of the head."""
SEARCHED = 10
"""Interval, in frames, of searches of the whole image for further faces."""
REACH, SPEED = 1.0, 5.0
"""Maximum distance between a lost face and its rediscovery, relative to its size: constant, and increase per second."""
STORED_S = 10.0
"""Seconds after which landmarks are stored again, for a run that is interrupted."""


class FoundAgain(NamedTuple):
    """A frame in which a lost face was found again."""

    number: int
    """Of the frame in the file."""
    jump: float
    """Distance from the place where it was before, relative to the face's size there."""

    @property
    def elsewhere(self) -> bool:
        """Whether it is too far away to be identified as the same face by position alone."""
        return self.jump >= SAME


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

    @property
    def again(self) -> tuple[FoundAgain, ...]:
        """Where the face was found again after frames without it, or is elsewhere than in the frame before."""
        seen = np.flatnonzero(self.found).tolist()
        rows = [
            (
                now - before,
                FoundAgain(int(self.numbers[now]), face_distance(self.pixels[now], self.pixels[before])),
            )
            for before, now in pairwise(seen)
        ]
        return tuple(one for steps, one in rows if steps > 1 or one.elsewhere)


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
    """Tracks the face of one person, and all other faces to avoid confusing them.

    The person is the one with the largest face in the first frame that shows a face. From then on a face is the person's because
    it is where that was in the frame before. Where the face is lost, the whole picture is searched at once. The person is then the
    face nearest to the last place that was not seen before and is not farther away than a head can have moved since (`REACH`,
    `SPEED`); every farther one is another's. That a face found again is the same person's is not known, see `FoundFaces.again`.

    Landmarks are rounded to 32 bits, as they are stored, so that an interruption does not change them.
    """

    finder: FaceFinder
    last: FloatArray | None = None
    """(COUNT, 2) landmarks of the person where they were last seen, pixels."""
    last_time: float = 0.0
    """Time of that frame, seconds."""
    lost: bool = True
    """Whether the person is missing in the latest frame."""
    others: list[FloatArray] = field(default_factory=list)
    """(COUNT, 2) landmarks of every other face of the latest frame."""

    def follow(self, image: ByteArray, time: float, search: bool) -> FloatArray | None:
        """The person's landmarks in the next frame, (COUNT, 2) pixels, or None. ``time``: Of the frame, seconds.
        ``search``: Whether to search for further faces even if the person's is found."""
        own = None if self.lost or self.last is None else self._near(image, self.last)
        others: list[FloatArray] = []
        for before in self.others:
            now = self._near(image, before)
            if now is None or any(same_face(now, other) for other in others):
                continue
            if own is not None and self.last is not None and same_face(own, now):
                if face_distance(own, self.last) <= face_distance(now, before):
                    continue  # the other face is hidden or has left
                own = None
            others.append(now)
        if own is None or search:
            seen = [] if own is None else [own]
            new = [
                np.asarray(face, np.float32)
                for face in self.finder.find_all(image)
                if not any(same_face(face, known) for known in [*seen, *others])
            ]
            if own is None and new:
                own = self._own(new, time)
            others += [face for face in new if face is not own]
        if own is not None:
            self.last, self.last_time = own, time
        self.lost, self.others = own is None, others
        return own

    def _near(self, image: ByteArray, before: FloatArray) -> FloatArray | None:
        face = self.finder.follow(image, before)
        return None if face is None else np.asarray(face, np.float32)

    def _own(self, new: Sequence[FloatArray], time: float) -> FloatArray | None:
        """The person's face among those that were not followed, the largest first; None if each is too far away."""
        last = self.last
        if last is None:
            return new[0]
        nearest = min(new, key=lambda face: face_distance(face, last))
        farthest = REACH + SPEED * (time - self.last_time)
        return nearest if face_distance(nearest, last) <= farthest else None


class _Searched(NamedTuple):
    """Detections in a frame."""

    number: int
    time: float
    """Seconds."""
    face: FloatArray | None
    """(COUNT, 2) landmarks of the person, pixels."""
    others: int


_STORED = {
    "numbers": Member("i", ("T",)),
    "times": Member("f", ("T",)),
    "found": Member("b", ("T",)),
    "pixels": Member("f", ("T", COUNT, 2)),
    "others": Member("i", ("T",)),
    "last_others": Member("f", (None, COUNT, 2)),
    "finished": Member("b", ()),
}


def find_faces(
    path: Path,
    frames: Iterable[TimedFrame],
    finder: FaceFinder,
    store: Path,
    mark: str,
    progress: Progress = no_progress,
) -> FoundFaces:
    """Landmarks of one person in all frames, by `FaceFollower`.

    ``path``: The video, for messages. ``frames``: Its frames; not iterated if an earlier call has finished. ``store``: File
    of the landmarks, written during the search; a later call skips its frames. ``mark``: Digest of everything that the
    landmarks depend on.
    """
    kept = stored_arrays(store, mark, _STORED)
    if kept is None or not kept["finished"]:
        kept = _search(frames, finder, kept, store, mark, progress)
    found, count = kept["found"], len(kept["found"])
    seen = int(found.sum())
    if seen < max(1, LEAST_SEEN * count):
        expected = f"the face of one person in at least {LEAST_SEEN:.0%} of the frames"
        said = f"it in {seen} of {count}" if seen else f"no face in any of {count}"
        raise InputError(path, "", expected, said, REMEDY)
    pixels = np.where(found[:, None, None], kept["pixels"], np.nan)
    return FoundFaces(kept["numbers"], pixels, kept["others"])


def _search(
    frames: Iterable[TimedFrame],
    finder: FaceFinder,
    kept: dict[str, np.ndarray] | None,
    store: Path,
    mark: str,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Search the frames after those that are ``kept``; the arrays of `_STORED`, which are also stored."""
    follower = FaceFollower(finder)
    rows: list[_Searched] = []
    if kept is not None:
        faces = [pixels if found else None for pixels, found in zip(kept["pixels"], kept["found"])]
        values = zip(kept["numbers"].tolist(), kept["times"].tolist(), faces, kept["others"].tolist())
        rows = [_Searched(*value) for value in values]
        for row in rows:
            if row.face is not None:
                follower.last, follower.last_time = row.face, row.time
        follower.lost = not rows or rows[-1].face is None
        follower.others = [*kept["last_others"]]
    # Set at once after each frame: an interruption may come between any two statements.
    latest = len(rows), follower.others

    def arrays(finished: bool) -> dict[str, np.ndarray]:
        count, last_others = latest
        pixels = np.zeros((count, COUNT, 2), np.float32)
        for place, row in enumerate(rows[:count]):
            if row.face is not None:
                pixels[place] = row.face
        return {
            "numbers": np.array([row.number for row in rows[:count]], np.int64),
            "times": np.array([row.time for row in rows[:count]], np.float64),
            "found": np.array([row.face is not None for row in rows[:count]], bool),
            "pixels": pixels,
            "others": np.array([row.others for row in rows[:count]], np.int64),
            "last_others": np.array(last_others, np.float32).reshape(-1, COUNT, 2),
            "finished": np.array(finished),
        }

    finished, since = False, monotonic()
    try:
        for index, frame in enumerate(frames):
            if index >= len(rows):
                face = follower.follow(frame.image, frame.time, index % SEARCHED == 0)
                rows.append(_Searched(frame.number, frame.time, face, len(follower.others)))
                latest = len(rows), follower.others
                if monotonic() - since > STORED_S:
                    store_arrays(store, mark, arrays(False))
                    since = monotonic()
            progress(index + 1, index + 1, "landmarks")
        finished = True
    finally:
        if latest[0]:
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
