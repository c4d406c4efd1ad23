"""Boxes of faces by MediaPipe's face detector, whose file is read without the package mediapipe.

Formats read:

- MediaPipe's face detector. Written by google-ai-edge/mediapipe 0.10.21. Checked on its wheel,
  `mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite`.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.io.files import digest, digest_file
from ...bench.landmark_network import (
    CROP,
    NETWORKS,
    FaceCrop,
    LandmarkNetwork,
    face_distance,
    face_size,
    fetched_network,
    open_network,
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
    """The network in a file. Raises as `open_network`, and `InputError` for another network."""

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
        found = []
        longer = max(image.shape[:2])
        for scale in (side / longer for side in SCALES if side <= max(longer, SIDE)):
            size = [max(1, round(scale * side)) for side in image.shape[1::-1]]
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
            for left, top in product(*map(_starts, size)):
                square = np.zeros((SIDE, SIDE, 3), np.uint8)
                part = small[max(0, top) : top + SIDE, max(0, left) : left + SIDE]
                square[max(0, -top) :, max(0, -left) :][: len(part), : part.shape[1]] = part
                scores, points = self._run(square)
                found += [
                    np.concatenate([[score], (one + [left, top]).ravel() / scale])
                    for score, one in zip(scores, points)
                ]
        return [_crop(one) for one in _merged(found)]

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
    """The landmark network in a file, and the detector in the file beside it or else the one that was fetched.

    Raises as both.
    """

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
            found = self.network.find_in(image, crop)
            # A part of a face that looks like one has a lower score.
            if found is not None and all(face_distance(found, other) > 1 for other in faces):
                faces.append(found)
        return sorted(faces, key=face_size, reverse=True)
