"""Preservation of a subject's appearance in a driven avatar, without ground truth or a licensed network.

The parts of a head that expressions do not move (visible scalp and hair, ears, temples) should look as in the subject's
recordings, independent of the driver. The tracked mesh locates them: the colour at every such vertex is compared with the
median colour at the same vertex over the subject's recorded frames in the same camera. The metric is the mean CIEDE2000
difference over the vertices: 0 is equal, 1 is just noticeable, and hair or skin of two people differ by more than 10.

It ignores the face itself, whose appearance changes with expression, and shape except for the outline, and cannot
distinguish people who look alike. It includes general rendering errors and the change of shading with the head's rotation.
For comparison, its value for the subject's own held-out recordings (`own`) estimates these, and its value for the driver's
recordings (`source`) is that of a complete exchange of identity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from skimage.color import deltaE_ciede2000

from ..contracts import (
    BoolArray,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
)
from ..io.images import quantise
from .extremes import training_poses
from .stability import LimitCheck

STEADY_M = 0.0005
"""Vertices that training expressions (one standard deviation of each) move by less than this count as static."""
RIGID_WEIGHT = 0.99
FACING = 0.35
"""Minimum cosine between a vertex normal and the direction to the camera; grazing views are left out."""
SMOOTHING = 0.01
"""Standard deviation of the Gaussian blur of images, relative to the head's height in the image."""
LEAST_VERTICES = 20
NO_APPEARANCE = "no recorded frames of that camera, or no parts that expressions do not move"
HIDDEN = ("teeth", "tongue", "eyeball", "lips", "mouth")
"""Parts of names of regions that are behind others, or open and close over them."""


@dataclass(frozen=True, eq=False)
class RigidVertices:
    """The (N,) vertices of a clip's head that only move rigidly: (N, 3) points and unit normals in the rest
    pose, and its (3,) root and neck joints, metres."""

    indices: IntArray
    points: FloatArray
    normals: FloatArray
    root: FloatArray
    neck: FloatArray

    @classmethod
    def of(cls, clip: Clip) -> RigidVertices:
        """Find the vertices from the head model and the training expressions."""
        expressions = [pose.expression for pose in training_poses(clip)]
        return cls.at(clip, np.flatnonzero(_steady(clip.head, expressions)))

    @classmethod
    def at(cls, clip: Clip, indices: IntArray) -> RigidVertices:
        """Restrict to given vertices."""
        head = clip.head
        coefficients = np.asarray(clip.shape, np.float64)
        shaped = (
            head.template + head.shape_basis[..., : len(coefficients)] @ coefficients + clip.static_offset
        )
        root, neck = (head.joint_regressor @ shaped)[:2]
        return cls(indices, shaped[indices], _normals(shaped, head.faces)[indices], root, neck)

    def posed(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """(N, 3) points and normals of a pose: the head rotates about the neck joint, and everything about the root."""
        root, neck = (cv2.Rodrigues(np.asarray(r, np.float64))[0] for r in (pose.rotation, pose.neck))
        local = (self.points - self.neck) @ neck.T + self.neck
        points = (local - self.root) @ root.T + self.root + pose.translation
        return np.asarray(points), np.asarray(self.normals @ (root @ neck).T)


@dataclass(frozen=True, eq=False)
class RecordedAppearance:
    """Lab colours of a subject's static parts in one camera, (N, 3); NaN for vertices that were not visible."""

    parts: RigidVertices
    colours: FloatArray

    @classmethod
    def recorded(cls, clip: Clip, camera: str, count: int) -> RecordedAppearance | None:
        """The median over up to ``count`` recorded frames of training timesteps; None if the camera has too few."""
        recorded = [*clip.splits.get("train", ()), *clip.splits.get("novel_view", ())]
        keys = sorted(key for key in recorded if key.camera == camera)
        parts = RigidVertices.of(clip)
        if not keys or len(parts.indices) < LEAST_VERTICES:
            return None
        seen = np.array([_colours_of(clip, parts, key) for key in keys[:: max(1, len(keys) // count)]])
        known = np.isfinite(seen).any(axis=0)
        median = np.full(seen.shape[1:], np.nan)
        median[known] = np.nanmedian(seen[:, known], axis=0)
        return cls(parts, median)

    def difference(self, colours: FloatArray) -> float | None:
        """Mean CIEDE2000 difference over the vertices visible in both; None if there are too few."""
        both = np.isfinite(self.colours).all(axis=1) & np.isfinite(colours).all(axis=1)
        if both.sum() < LEAST_VERTICES:
            return None
        return float(deltaE_ciede2000(self.colours[both], colours[both]).mean())


def identity(
    appearance: RecordedAppearance | None, frame: Frame, camera: Camera, pose: HeadPose
) -> LimitCheck:
    """The identity metric of a driven frame; it has no limit, since acceptable values depend on target and driver."""
    if appearance is None or not np.isfinite(frame.rgb).all():
        absent = "not finite" if appearance is not None else NO_APPEARANCE
        return LimitCheck("identity", None, 0.0, math.inf, absent)
    value = appearance.difference(sample(quantise(frame.rgb), camera, *appearance.parts.posed(pose)))
    return LimitCheck("identity", value, 0.0, math.inf, "too little of the static parts is visible")


def of_recording(
    appearance: RecordedAppearance, clip: Clip, keys: Sequence[FrameKey], count: int
) -> float | None:
    """Mean identity metric of up to ``count`` recorded frames of any subject; None if no frame has a value.

    The vertices are those of ``appearance`` that this clip's head has.
    """
    if not keys or len(clip.head.template) <= appearance.parts.indices.max():
        return None
    parts = RigidVertices.at(clip, appearance.parts.indices)
    chosen = keys[:: max(1, len(keys) // count)]
    return mean_known([appearance.difference(_colours_of(clip, parts, key)) for key in chosen])


def mean_known(values: Sequence[float | None]) -> float | None:
    """Mean of the available values; None without any."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _colours_of(clip: Clip, parts: RigidVertices, key: FrameKey) -> FloatArray:
    """(N, 3) Lab colours of a clip's static parts in a recorded frame."""
    return sample(clip.image(key), clip.cameras[key.camera], *parts.posed(clip.poses[key.timestep]))


def sample(image: ByteArray, camera: Camera, points: FloatArray, normals: FloatArray) -> FloatArray:
    """(N, 3) Lab colours of points in an (H, W, 3) 8-bit image; NaN for points that face away or are outside of it.

    Occlusion is not tested; the static parts are convex except for the ears.
    """
    motion = np.asarray(camera.world_to_camera, np.float64)
    local = points @ motion[:3, :3].T + motion[:3, 3]
    projected = local @ np.asarray(camera.K, np.float64).T
    pixels = projected[:, :2] / np.where(local[:, 2:] > 0, projected[:, 2:], np.nan)
    towards = camera.center - points
    cosines = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    columns, lines = np.floor(np.nan_to_num(pixels, nan=-1.0)).T
    seen = (cosines > FACING) & (columns >= 0) & (lines >= 0)
    seen &= (columns < camera.width) & (lines < camera.height)
    colours = np.full((len(points), 3), np.nan)
    if seen.any():
        height = float(np.ptp(pixels[seen, 1]))
        smooth = cv2.GaussianBlur(image.astype(np.float32) / 255.0, (0, 0), max(0.5, SMOOTHING * height))
        lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2Lab)
        colours[seen] = lab[lines[seen].astype(int), columns[seen].astype(int)]
    return colours


def _steady(head: HeadAsset, expressions: Sequence[FloatArray]) -> BoolArray:
    """(V,) mask of exposed vertices that neither expressions nor jaw and eyes move."""
    deviations = np.std(np.asarray(expressions, np.float64), axis=0)
    basis = head.expression_basis[..., : len(deviations)]
    steady: BoolArray = np.linalg.norm(basis * deviations, axis=(1, 2)) < STEADY_M
    steady &= head.skinning_weights[:, 1] >= RIGID_WEIGHT
    for name, indices in head.regions.items():
        if any(part in name for part in HIDDEN):
            steady[indices] = False
    return steady


def _normals(points: FloatArray, faces: IntArray) -> FloatArray:
    """(V, 3) unit normals, averaged over faces by area."""
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
