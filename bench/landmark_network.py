"""Landmarks by MediaPipe's face landmark network.

The network's file is part of the package mediapipe 0.10.21 (``mediapipe/modules/face_landmark/face_landmark.tflite``) and is
read without that package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from .contracts import ByteArray, FloatArray
from .errors import InputError
from .tflite import open_network

CORNERS = (33, 263)
"""Landmarks of the outer corners of the eyes, between which the crop is level."""
CROP = 1.5
"""Side of the crop, relative to the longer side of the landmarks' box."""
MOST_CHANGE = 0.05
"""Landmarks may move by this part of the face's size when the crop is repeated around them."""
_TRIED, _ROUNDS = 6, 3


class _Crop(NamedTuple):
    """A square of an image."""

    middle: FloatArray  # (2,)
    side: float
    angle: float  # radians


class LandmarkNetwork:
    """The network of a file.

    Raises
    ------
    UnavailableError
        The package ai-edge-litert is missing.
    InputError
        The file is missing or is not such a network.
    """

    def __init__(self, path: Path):
        remedy = "It is in the wheel of mediapipe 0.10.21, as mediapipe/modules/face_landmark/face_landmark.tflite."
        expected = f"a network that finds {COUNT} landmarks"
        self._network: Any = open_network(path, expected, remedy)
        try:
            (self._input,) = self._network.get_input_details()
            outputs = self._network.get_output_details()
            self._landmarks = next(one for one in outputs if np.prod(one["shape"]) == 3 * COUNT)
            self._score = next(one for one in outputs if np.prod(one["shape"]) == 1)
        except (ValueError, StopIteration) as error:
            raise InputError(path, "", expected, str(error) or "other outputs") from error
        self._side = int(self._input["shape"][1])

    def find(self, image: ByteArray, near: FloatArray | None = None) -> FloatArray | None:
        """(COUNT, 2) landmarks, pixels, or None where the network sees no face.

        Parameters
        ----------
        image : ByteArray
            (H, W, 3) 8-bit RGB.
        near : FloatArray | None
            Landmarks of a similar image of the camera; without them, squares of several sizes are tried.
        """
        if near is not None:
            found, score = self._run(image, _crop_around(near))
            return found if score > 0 else self.find(image)
        scored = sorted((self._run(image, crop) for crop in _candidates(image)), key=lambda one: -one[1])
        best, least = None, MOST_CHANGE
        for found, score in scored[:_TRIED]:
            change = np.inf
            for _ in range(_ROUNDS):
                if score > 0:
                    before, (found, score) = found, self._run(image, _crop_around(found))
                    change = float(np.abs(found - before).mean() / np.ptp(found, axis=0).max())
            # Where the network sees a whole face, the landmarks of a crop around them are the same.
            if score > 0 and change < least:
                best, least = found, change
        return best

    def _run(self, image: ByteArray, crop: _Crop) -> tuple[FloatArray, float]:
        """Landmarks, and the logit of the probability that the crop shows a face."""
        turn = crop.side / self._side * _turn(crop.angle)
        to_image = np.concatenate([turn, (crop.middle - turn @ np.full(2, self._side / 2))[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shift = to_image.copy()
        shift[:, 2] += turn @ np.full(2, 0.5) - 0.5  # OpenCV's pixel centres are whole numbers
        size = (self._side, self._side)
        pixels = cv2.warpAffine(image, shift, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        self._network.set_tensor(self._input["index"], pixels[None].astype(np.float32) / 255)
        self._network.invoke()
        found = self._network.get_tensor(self._landmarks["index"]).reshape(COUNT, 3)[:, :2].astype(np.float64)
        score = float(self._network.get_tensor(self._score["index"]).ravel()[0])
        return found @ turn.T + to_image[:, 2], score


COUNT = 468
"""Landmarks of the network."""


def _candidates(image: ByteArray) -> list[_Crop]:
    height, width = image.shape[:2]
    shorter = min(height, width)
    return [
        _Crop(np.array([x * width, y * height]), side * shorter, 0.0)
        for side in (0.6, 0.9)
        for x in (0.35, 0.5, 0.65)
        for y in (0.35, 0.5, 0.65)
    ]


def _crop_around(landmarks: FloatArray) -> _Crop:
    along = landmarks[CORNERS[1]] - landmarks[CORNERS[0]]
    angle = float(np.arctan2(along[1], along[0]))
    level = landmarks @ _turn(angle)
    low, high = level.min(axis=0), level.max(axis=0)
    return _Crop(_turn(angle) @ ((low + high) / 2), CROP * float((high - low).max()), angle)


def _turn(angle: float) -> FloatArray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
