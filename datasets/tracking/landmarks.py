"""Landmarks in images: sources, and corresponding points of the mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...bench.contracts import BoolArray, FloatArray, HeadAsset, IntArray
from ..clip import CaptureClip
from ..head.arrays import region
from ..head.subject import PosedSubject
from .views import Occlusion, Views

BIAS_MM, NOISE_MM = 2.6, 1.0
"""Error of the landmarks of a known rig: the part that each landmark has in a camera at all timesteps, and the part that
changes, root mean square along each axis of the image. Measured for a landmark network on synthetic heads."""
COMMON = 0.5
"""Part of the variance of the bias that is the same in all cameras, as of a network that places a landmark wrongly on the face."""
COUNT = 160
"""Landmarks of a known rig."""
_SHARES = (("lips", 0.2), ("eye_region", 0.3), ("face", 0.5))


class ImageLandmarks(NamedTuple):
    """Landmarks of a clip: points of the mesh, and where cameras saw them."""

    corners: IntArray
    """(L, 3) vertices of the triangle of each landmark."""
    weights: FloatArray
    """(L, 3) barycentric weights."""
    pixels: FloatArray
    """(T, C, L, 2) places, pixels; NaN where a landmark was not found."""

    def of(self, timesteps: IntArray | BoolArray) -> ImageLandmarks:
        """Those of some timesteps, indices or a mask."""
        return self._replace(pixels=self.pixels[timesteps])

    @property
    def seen(self) -> BoolArray:
        """(T,) whether any landmark was found."""
        return np.asarray(np.isfinite(self.pixels).any(axis=(1, 2, 3)))


def spread_vertices(points: FloatArray, count: int) -> IntArray:
    """(count,) indices of points (n, 3) that are far from one another, greedily."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def rig_vertices(head: HeadAsset) -> IntArray:
    """Vertices that serve as landmarks of a known rig, spread over lips, eye regions and face.

    Raises `InputError` if the head model has no face region.
    """
    region(head, "face")
    taken: list[IntArray] = []
    hidden = [np.asarray(head.regions.get(name, ()), np.int64) for name in ("mouth_socket", "teeth")]
    for name, share in _SHARES:
        members = np.setdiff1d(head.regions.get(name, ()), np.concatenate([*hidden, *taken])).astype(np.int64)
        if len(members):
            taken.append(members[spread_vertices(np.asarray(head.template)[members], round(share * COUNT))])
    return np.unique(np.concatenate(taken))


def known_rig_landmarks(
    clip: CaptureClip, cameras: Sequence[str], timesteps: Sequence[int], seed: int
) -> ImageLandmarks:
    """Projections of vertices of the clip's own tracked mesh with the error of a landmark network, seeded.

    They replace a network whose file is missing; because of their error, tracking must still be refined. Landmarks
    hidden by the mesh are missing.
    """
    rng = np.random.default_rng([seed, 11, *clip.subject.encode()])  # errors differ by subject
    vertices = rig_vertices(clip.head)
    views = Views([clip.cameras[name] for name in cameras])
    subject = PosedSubject.of(clip)
    occlusion = Occlusion(clip.head, subject.neutral, views)
    size = (len(views.cameras), len(vertices), 2)
    bias = np.sqrt(COMMON) * rng.standard_normal(size[1:]) + np.sqrt(1 - COMMON) * rng.standard_normal(size)
    pixels = np.full((len(timesteps), *size), np.nan)
    for row, (_, mesh) in enumerate(subject.each(clip, timesteps)):
        cosine = occlusion.visible(mesh, vertices)
        projected = views.project(mesh[vertices])
        per_metre = views.intrinsics[:, None, 0, 0] / projected.depth
        error = 1e-3 * (BIAS_MM * bias + NOISE_MM * rng.standard_normal(size))
        found = projected.pixels + error * per_metre[..., None]
        pixels[row] = np.where(cosine[..., None] > 0.5, found, np.nan)
    corners = np.repeat(vertices[:, None], 3, axis=1)
    return ImageLandmarks(corners, np.tile([1.0, 0.0, 0.0], (len(vertices), 1)), pixels)
