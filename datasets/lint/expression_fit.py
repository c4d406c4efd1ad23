"""Test whether the expression coefficients explain the images with a head model.

FLAME 2020 and 2023 have equal numbers of coefficients with different meanings, and no number in the files reveals a
mix-up, but images do. A point of the skin keeps its colour over time, apart from shading. So colours at the mesh's
vertices in the images of one camera vary less with the correct expression than with a face at rest (jaw, head and eyes
moving as tracked). With the coefficients of another basis, of other timesteps or of other units they vary more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import InputError
from ...bench.protocol import evenly_with_ends
from ..ga.layout import CyConvention
from ..ga.transforms import FrameEntry
from ..head.geometry import project, vertex_normals
from .mesh import Parameters, TrackedSubject
from .views import Pixels, ViewFacts, entry_camera

FRAMES = 16
"""Frames to judge by."""

FEWEST_FRAMES, FEWEST_VERTICES = 6, 50
"""Minimum amount of data for a result."""

FACING = 0.5
"""Minimum cosine between a vertex's normal and the direction to the camera."""

MOVES_PX = 0.5
"""Minimum motion of a vertex's projection by expression, for vertices that are compared."""


class ExpressionFit(NamedTuple):
    """Ratio of the variances over time of the face's colours with the expression and with a face at rest.

    ``mean`` and ``median`` compare the mean and the median over ``vertices`` vertices in ``frames`` frames of
    ``camera``: below 1 if the expression explains the images.
    """

    camera: str
    frames: int
    vertices: int
    mean: float
    median: float

    @property
    def ratio(self) -> float:
        """Geometric mean of both: the mean is dominated by the few vertices that move much, the median by the others."""
        return math.sqrt(self.mean * self.median)


@dataclass(frozen=True, eq=False)
class _Picked:
    """Colours that the face's vertices have in one frame."""

    colours: FloatArray  # (F, 3)
    seen: np.ndarray  # (F,)
    pixels: FloatArray  # (F, 2)


def weigh_expression(
    entries: Sequence[FrameEntry],
    views: Sequence[ViewFacts],
    pixels: Pixels,
    subject: TrackedSubject | None,
    parameters: Mapping[int, Parameters],
    cy: CyConvention,
) -> ExpressionFit | None:
    """Compare the expression with a face at rest; None if there are too few data.

    Parameters
    ----------
    entries : Sequence[FrameEntry]
        Frames with existing images.
    views : Sequence[ViewFacts]
        Sample frames; the most frontal camera in them is used.
    """
    camera = _facing_camera(views)
    if subject is None or camera is None:
        return None
    usable = [e for e in entries if e.camera_id == camera and parameters[e.timestep].pose is not None]
    if not usable:
        return None
    usable.sort(key=lambda entry: entry.timestep)
    moving: list[_Picked] = []
    resting: list[_Picked] = []
    for entry in evenly_with_ends(usable, FRAMES):
        pose = parameters[entry.timestep].pose
        if pose is None:
            continue
        try:
            image = pixels.image(entry)
        except InputError:
            continue  # reported as a damaged file
        still = replace(pose, expression=np.zeros_like(pose.expression))
        place = entry_camera(entry, pixels.headers[entry.image], cy)
        for kept, mesh in zip((moving, resting), subject.meshes([pose, still])):
            kept.append(_pick(mesh, subject, place, image))
    return _compare(camera, moving, resting)


def _facing_camera(views: Sequence[ViewFacts]) -> str | None:
    facing: dict[str, list[float]] = {}
    for view in views:
        if view.mesh is not None and view.mesh.depth > 0:
            facing.setdefault(view.entry.camera_id, []).append(view.mesh.facing)
    return max(facing, key=lambda name: float(np.median(facing[name]))) if facing else None


def _pick(vertices: FloatArray, subject: TrackedSubject, camera: Camera, image: ByteArray) -> _Picked:
    points = vertices[subject.skin]
    outward = vertex_normals(vertices, subject.head.faces)[subject.skin]
    towards = camera.center - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    pixels = project(points, camera)
    where = (pixels - 0.5).astype(np.float32)  # OpenCV's pixel centres are at integers
    picked = cv2.remap(image.astype(np.float32), where[:, :1], where[:, 1:], cv2.INTER_LINEAR)
    colours = picked[:, 0].astype(np.float64)
    within = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return _Picked(colours, ((outward * towards).sum(axis=1) > FACING) & within, pixels)


def _compare(camera: str, moving: Sequence[_Picked], resting: Sequence[_Picked]) -> ExpressionFit | None:
    if len(moving) < FEWEST_FRAMES:
        return None
    # Only vertices visible in both are compared.
    seen = np.array([one.seen & other.seen for one, other in zip(moving, resting)])
    moved = np.array(
        [np.linalg.norm(one.pixels - other.pixels, axis=1) for one, other in zip(moving, resting)]
    )
    telling = (seen.sum(axis=0) >= FEWEST_FRAMES) & (moved.max(axis=0) >= MOVES_PX)
    if telling.sum() < FEWEST_VERTICES:
        return None
    ours = _variance(moving, seen)[telling]
    rest = _variance(resting, seen)[telling]
    if rest.mean() <= 0 or np.median(rest) <= 0:
        return None  # a face of one colour
    return ExpressionFit(
        camera,
        len(moving),
        int(telling.sum()),
        float(ours.mean() / rest.mean()),
        float(np.median(ours) / np.median(rest)),
    )


def _variance(picked: Sequence[_Picked], seen: np.ndarray) -> FloatArray:
    """(F,) variance of each vertex's colour over the frames in which it is visible, mean over channels."""
    weight = seen[..., None].astype(np.float64)
    colours = np.array([one.colours for one in picked])
    count = np.maximum(weight.sum(axis=0), 1)
    mean = (colours * weight).sum(axis=0) / count
    variance: FloatArray = ((((colours - mean) ** 2) * weight).sum(axis=0) / count).mean(axis=1)
    return variance
