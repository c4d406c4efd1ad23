"""Removal of lens distortion from images, so that a pinhole camera describes them.

Lenses are named and parametrised as COLMAP does (its ``sensor/models.h``), which shares OpenCV's formulas. Pixel
coordinates have the centre of the top left pixel at (0.5, 0.5), in COLMAP as here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...bench.contracts import FloatArray, FrameKey
from ...bench.errors import InputError
from ..clip import CaptureClip, FramePixels

_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_OUTSIDE = -1e4


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera with distortion.

    Attributes
    ----------
    model : str
        COLMAP's name of the model: a pinhole, or a distortion that can be undone.
    parameters : tuple[float, ...]
        In COLMAP's order; lengths in pixels.
    width, height : int
        Image size, pixels.
    """

    model: str
    parameters: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raise `InputError` for an invalid lens."""
        if self.model not in _PARAMETERS:
            raise InputError("lens", "model", f"one of {', '.join(_PARAMETERS)}", repr(self.model))
        names = _PARAMETERS[self.model].split()
        if len(self.parameters) != len(names) or not np.isfinite(self.parameters).all():
            expected = f"{len(names)} finite numbers: {', '.join(names)}"
            raise InputError(f"lens {self.model}", "parameters", expected, str(self.parameters))
        if min(self._by_name.get("f", 1), self._by_name.get("fx", 1), self._by_name.get("fy", 1)) <= 0:
            raise InputError(
                f"lens {self.model}", "parameters", "positive focal lengths", str(self.parameters)
            )

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the same camera without its distortion."""
        values = self._by_name
        fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
        return np.array([[fx, 0, values["cx"]], [0, fy, values["cy"]], [0, 0, 1]])

    @property
    def distorts(self) -> bool:
        """Whether the lens has distortion; a fisheye lens without coefficients also does."""
        return self._fisheye or bool(self._coefficients.any())

    def map_from(self, K: FloatArray, width: int, height: int) -> FloatArray:
        """(height, width, 2) float32 position of each pixel of a pinhole image in the distorted one, pixels.

        Far outside the calibrated view a polynomial may fold back into the image; such positions are moved outside.
        """
        # OpenCV's origin is the centre of the top left pixel.
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        undo = cv2.fisheye.initUndistortRectifyMap if self._fisheye else cv2.initUndistortRectifyMap
        arguments = (self.K - half, self._coefficients, np.eye(3), np.asarray(K, np.float64) - half)
        places = np.stack(undo(*arguments, (width, height), cv2.CV_32FC1), axis=-1) + np.float32(0.5)
        places[~_unfolded(places, K)] = _OUTSIDE
        return places

    @property
    def _fisheye(self) -> bool:
        return self.model.endswith("FISHEYE")

    @property
    def _by_name(self) -> dict[str, float]:
        return dict(zip(_PARAMETERS[self.model].split(), self.parameters))

    @property
    def _coefficients(self) -> FloatArray:
        """Distortion coefficients in OpenCV's order."""
        names = "k1 k2 k3 k4" if self._fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
        return np.array([self._by_name.get(name, 0.0) for name in names.split()])


def _unfolded(places: FloatArray, K: FloatArray) -> np.ndarray:
    """(H, W) bool: connected region around the principal point in which a map keeps its orientation.

    Outside a ring in which the lens's polynomial decreases it may increase again, mirrored twice.
    """
    height, width = places.shape[:2]
    if min(width, height) < 2:
        return np.ones((height, width), dtype=bool)
    down, across = (np.asarray(change) for change in np.gradient(places, axis=(0, 1)))
    upright = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
    _, parts = cv2.connectedComponents(upright.astype(np.uint8), connectivity=4)
    x = int(np.clip(K[0, 2], 0, width - 1))
    y = int(np.clip(K[1, 2], 0, height - 1))
    return upright & (parts == parts[y, x])


def undistort_image(image: FloatArray, places: FloatArray, background: FloatArray | float) -> FloatArray:
    """Resample a float32 image (H, W) or (H, W, 3) by a map of `Lens.map_from`; ``background`` outside of it.

    Bicubic, with places rounded to 1/32 pixel, and clamped to [0, 1].
    """
    ground = [float(value) for value in np.broadcast_to(np.asarray(background, np.float64), (3,))]
    x, y = (np.ascontiguousarray(places[..., axis] - np.float32(0.5)) for axis in (0, 1))
    moved = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=ground)
    return np.clip(moved, 0, 1).astype(np.float32, copy=False)


def undistort_clip(clip: CaptureClip, lenses: Mapping[str, Lens]) -> CaptureClip:
    """The clip with distortion removed from images and masks; pixels outside the distorted image are background.

    Each different lens holds a map of 8 bytes per pixel while the clip lives.

    Parameters
    ----------
    lenses : Mapping[str, Lens]
        Lens by camera id; cameras without one have no distortion.
    """
    stray = sorted(set(lenses) - set(clip.cameras))
    if stray:
        raise InputError("lenses", stray[0], f"one of {', '.join(sorted(clip.cameras))}", "no such camera")
    bent = {name: lens for name, lens in lenses.items() if lens.distorts}
    if not bent:
        return clip
    cameras = dict(clip.cameras)
    for name, lens in bent.items():
        camera = clip.cameras[name]
        if (camera.width, camera.height) != (lens.width, lens.height):
            expected, found = f"{camera.width}x{camera.height}", f"{lens.width}x{lens.height}"
            raise InputError(f"lens of camera {name}", "size", f"{expected}, that of the images", found)
        cameras[name] = replace(camera, K=lens.K)
    lens_of = {clip.recorded(key).camera: bent[key.camera] for key in clip.files if key.camera in bent}
    maps = {lens: lens.map_from(lens.K, lens.width, lens.height) for lens in set(lens_of.values())}
    ground = np.asarray(clip.background, dtype=np.float32)

    def undistort(key: FrameKey, pixels: FramePixels) -> FramePixels:
        if key.camera not in lens_of:
            return pixels
        places = maps[lens_of[key.camera]]
        coverage = pixels.coverage
        if coverage is not None:
            coverage = undistort_image(coverage, places, 0.0)
        return FramePixels(undistort_image(pixels.image, places, ground), coverage)

    parameters = {name: [lens.model, list(lens.parameters)] for name, lens in sorted(bent.items())}
    return clip.derive_pixels("undistort", {"lenses": parameters}, undistort, cameras=cameras)
