"""The focal length of one camera from landmarks of a head model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadAsset
from .fit import Fitter
from .landmarks import ImageLandmarks
from .solve import NormalEquations
from .views import Views

TRIED = tuple(np.geomspace(0.8, 5.0, 9))
"""Focal lengths relative to the longer side of the picture."""
FRAMES = 16
WEIGHT = 1.0
"""Weight of a landmark relative to the prior. With that of tracking, residuals due to the prior would hide perspective."""
CLEAR = 1.02
"""Minimum ratio of the residuals at both ends of `TRIED` to the smallest one for a determined focal length."""


class FocalLength(NamedTuple):
    """An estimate."""

    pixels: float
    residuals: FloatArray
    """(N,) root mean square distance of landmarks, pixels, at each tried focal length."""
    tried: FloatArray
    """(N,) pixels."""

    @property
    def clear(self) -> bool:
        """Whether the landmarks determine the focal length."""
        best = int(self.residuals.argmin())
        return 0 < best < len(self.tried) - 1 and self.residuals[[0, -1]].min() > CLEAR * self.residuals[best]


def estimate_focal(head: HeadAsset, camera: Camera, landmarks: ImageLandmarks, side: float) -> FocalLength:
    """The focal length at which the head model fits landmarks of one camera best.

    Shape, poses and expressions are fitted for each tried length; between them the minimum of a parabola in its logarithm is
    taken. Landmarks have systematic errors of some millimetres, and a near face with a short lens looks like a longer face, so that
    the estimate may be wrong by a quarter.

    Parameters
    ----------
    landmarks : ImageLandmarks
        (T, 1, L, 2) pixels of ``camera``.
    side : float
        Longer side of the camera's whole picture in pixels of ``camera``, before it was cropped.
    """
    part = landmarks.of(landmarks.seen)
    part = part.of(np.unique(np.linspace(0, len(part.pixels) - 1, FRAMES).astype(int)))
    tried = side * np.array(TRIED)
    residuals = np.array([_residual(head, camera, part, focal) for focal in tried])
    best = int(residuals.argmin())
    pixels = tried[best]
    if 0 < best < len(tried) - 1:
        below, least, above = residuals[best - 1 : best + 2]
        step = 0.5 * (below - above) / (below - 2 * least + above)
        pixels = tried[best] * (tried[best + 1] / tried[best]) ** step
    return FocalLength(float(pixels), residuals, tried)


def _residual(head: HeadAsset, camera: Camera, landmarks: ImageLandmarks, focal: float) -> float:
    K = np.array(camera.K, np.float64)
    K[0, 0] = K[1, 1] = focal
    views = Views([Camera(camera.id, camera.width, camera.height, K, camera.world_to_camera)])
    fitter = Fitter(head, views, landmarks, WEIGHT)
    state = fitter.fit_landmarks(fitter.start())
    equations = NormalEquations(len(state.poses), state.poses.shape[1], len(state.shape))
    distances = fitter.add_landmarks(equations, fitter.landmark_rig(), state)
    return float(np.sqrt(np.mean(distances**2)))
