"""The focal length of one camera from landmarks of a head model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadAsset
from ...bench.errors import InputError
from ..head.rotations import rotation_of
from .equations import NormalEquations
from .fit import Fitter
from .landmarks import ImageLandmarks, spread_vertices
from .rig import Views
from .settings import FOCAL_SPREAD, USUAL_FOCAL

TRIED = tuple(np.geomspace(0.8, 6.0, 10))
"""Focal lengths relative to the longer side of the picture."""
FRAMES, TURNED = 16, 8
"""Number of frames that are fitted, and how many of them are those whose rotations of the head differ most."""
WEIGHT = 1.0
"""Weight of a landmark relative to the prior. With that of tracking, residuals due to the prior would hide perspective."""
CLEAR = 1.02
"""Minimum ratio of the residuals at both ends of `TRIED` to the smallest one for a determined focal length."""
INDEPENDENT = 50
"""Number of independent residuals that all landmarks are worth, since their errors are correlated."""


class FocalLength(NamedTuple):
    """An estimate."""

    pixels: float
    residuals: FloatArray
    """(N,) root mean square distance of landmarks, pixels, at each tried focal length."""

    @property
    def source(self) -> str:
        """Whether the landmarks determine the focal length, in words."""
        if self.residuals[[0, -1]].min() > CLEAR * self.residuals.min():
            return "estimated from landmarks"
        return "assumed, since the landmarks hardly determine it; give --focal if you know it"


def estimate_focal(head: HeadAsset, camera: Camera, landmarks: ImageLandmarks, side: float) -> FocalLength:
    """The most probable focal length of one camera by landmarks of a head model and the prior of `USUAL_FOCAL`.

    Shape, poses and expressions are fitted for each tried length; between them the minimum of a parabola in its logarithm is
    taken. Landmarks have systematic errors of some millimetres, and a near face with a short lens looks like a longer face, so that
    the estimate may be wrong by a quarter.

    ``landmarks``: (T, 1, L, 2) pixels of ``camera``. ``side``: Longer side of the camera's whole picture in pixels of
    ``camera``, before it was cropped.
    """
    sample = landmarks.of(landmarks.seen)
    turns = rotation_of(_fitter(head, camera, sample, side * USUAL_FOCAL).start().poses[:, :3]).as_matrix()
    even = np.linspace(0, len(turns) - 1, FRAMES - TURNED).astype(int)
    sample = sample.of(np.union1d(even, spread_vertices(turns.reshape(-1, 9), TURNED)))
    tried = side * np.array(TRIED)
    residuals = np.array([_residual(head, camera, sample, focal) for focal in tried])
    improbable = INDEPENDENT * np.log(residuals) + (np.log(TRIED) - np.log(USUAL_FOCAL)) ** 2 / (
        2 * FOCAL_SPREAD**2
    )
    best = int(improbable.argmin())
    pixels = tried[best]
    if 0 < best < len(tried) - 1:
        below, least, above = improbable[best - 1 : best + 2]
        step = 0.5 * (below - above) / (below - 2 * least + above)
        pixels = tried[best] * (tried[best + 1] / tried[best]) ** step
    return FocalLength(float(pixels), residuals)


def _fitter(head: HeadAsset, camera: Camera, landmarks: ImageLandmarks, focal: float) -> Fitter:
    K = np.array(camera.K, np.float64)
    K[0, 0] = K[1, 1] = focal
    views = Views([Camera(camera.id, camera.width, camera.height, K, camera.world_to_camera)])
    return Fitter(head, views, landmarks, np.zeros(0, np.int64))


def _residual(head: HeadAsset, camera: Camera, landmarks: ImageLandmarks, focal: float) -> float:
    """Of the frames whose landmarks are not left out."""
    fitter = _fitter(head, camera, landmarks, focal)
    state = fitter.fit_landmarks(fitter.start(), weight=WEIGHT)
    equations = NormalEquations(state)
    distances = fitter.add_landmarks(equations, fitter.landmark_rig(), state, WEIGHT)
    used = distances[distances > 0]
    if not len(used):
        where, expected = f"landmarks at a focal length of {focal:.0f} pixels", "some that fit the head model"
        raise InputError(where, "", expected, "none", "Give --focal.")
    return float(np.sqrt(np.mean(used**2)))
