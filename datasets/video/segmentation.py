"""Masks of a person by MediaPipe's selfie segmentation network.

The network's file is part of the package mediapipe 0.10.21
(``mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite``) and is read without that package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.tflite import open_network


class SelfieSegmentation:
    """The network of a file."""

    def __init__(self, path: Path):
        remedy = "It is in the wheel of mediapipe 0.10.21, as mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite."
        expected = "a network that segments a person"
        self._network: Any = open_network(path, expected, remedy)
        (self._input,), (self._output,) = (
            self._network.get_input_details(),
            self._network.get_output_details(),
        )
        _, self._height, self._width, _ = map(int, self._input["shape"])
        shape = tuple(map(int, self._output["shape"]))
        if shape != (1, self._height, self._width, 1):
            raise InputError(path, "", expected, f"an output of shape {shape}")

    def mask(self, image: ByteArray) -> ByteArray:
        """(H, W) 8-bit coverage of the person in an (H, W, 3) image."""
        size = (self._width, self._height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        self._network.set_tensor(self._input["index"], small[None])
        self._network.invoke()
        found: FloatArray = self._network.get_tensor(self._output["index"])[0, :, :, 0]
        large = cv2.resize(found, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.rint(255 * large.clip(0, 1)), np.uint8)
