"""Measurements of a capture, the input of the linter's checks. Each is made when a check first needs it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import InputError
from ...bench.protocol import evenly_with_ends
from ..ga.transforms import FrameEntry
from ..head.geometry import project_facing, vertex_normals
from .camera_table import CameraFacts, measure_cameras
from .capture import Capture, TrackedSubject
from .views import Thumbnail, ViewFacts, facing_camera, inspect_views, make_thumbnails, pick_views

THOROUGH_TIMESTEPS = 32
"""Timesteps on which cameras are measured with ``--thorough``."""

FEW_PIXELS, FEWEST_VIEWS = 5_000_000, 12
FEW_SHOTS, FEWEST_TIMESTEPS = 48, 2
"""Before a run, most pixels of the views and most images to measure cameras on, which take a few seconds; and numbers of views
and timesteps that are taken in any case."""

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
class _FaceColours:
    """Colours that the face's vertices have in one frame."""

    colours: FloatArray  # (F, 3)
    seen: np.ndarray  # (F,)
    pixels: FloatArray  # (F, 2)


def weigh_expression(capture: Capture, camera: str | None) -> ExpressionFit | None:
    """Compare the expression with a face at rest in the images of a camera; None if there are too few data."""
    subject = capture.subject
    if subject is None or camera is None:
        return None
    poses = {entry: capture.pose(entry.timestep) for entry in capture.imaged_entries}
    usable = sorted(
        (entry for entry, pose in poses.items() if entry.camera_id == camera and pose is not None),
        key=lambda entry: entry.timestep,
    )
    moving: list[_FaceColours] = []
    resting: list[_FaceColours] = []
    for entry in evenly_with_ends(usable, FRAMES):
        pose = poses[entry]
        if pose is None:
            continue
        try:
            image = capture.pixels.image(entry)
        except InputError:
            continue  # reported as a damaged file
        still = replace(pose, expression=np.zeros_like(pose.expression))
        for samples, vertices in zip((moving, resting), subject.meshes([pose, still])):
            samples.append(_face_colours(vertices, subject, capture.camera(entry), image))
    return _compare(camera, moving, resting)


def _face_colours(
    vertices: FloatArray, subject: TrackedSubject, camera: Camera, image: ByteArray
) -> _FaceColours:
    skin = subject.skin
    normals = vertex_normals(vertices, subject.head.faces)[skin]
    pixels, seen = project_facing(vertices[skin], normals, camera, FACING)
    where = (pixels - 0.5).astype(np.float32)  # OpenCV's pixel centres are at integers
    sampled = cv2.remap(image.astype(np.float32), where[:, :1], where[:, 1:], cv2.INTER_LINEAR)
    return _FaceColours(sampled[:, 0].astype(np.float64), seen, pixels)


def _compare(
    camera: str, moving: Sequence[_FaceColours], resting: Sequence[_FaceColours]
) -> ExpressionFit | None:
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


def _variance(picked: Sequence[_FaceColours], seen: np.ndarray) -> FloatArray:
    """(F,) variance of each vertex's colour over the frames in which it is visible, mean over channels."""
    weight = seen[..., None].astype(np.float64)
    colours = np.array([one.colours for one in picked])
    count = np.maximum(weight.sum(axis=0), 1)
    mean = (colours * weight).sum(axis=0) / count
    variance: FloatArray = ((((colours - mean) ** 2) * weight).sum(axis=0) / count).mean(axis=1)
    return variance


class Evidence(Capture):
    """A capture and measurements of its images."""

    @cached_property
    def views(self) -> Sequence[ViewFacts]:
        """Facts on decoded frames."""
        entries, count = self.imaged_entries, self.settings.views
        if self.before_run:
            sizes = ((entry.width or 0) * (entry.height or 0) for entry in entries)
            count = min(count, max(FEWEST_VIEWS, FEW_PIXELS // max(1, 1, *sizes)))
        return inspect_views(self, entries if self.settings.thorough else pick_views(entries, count))

    @cached_property
    def thumbnails(self) -> Sequence[Thumbnail]:
        """Thumbnails of the images searched for near-duplicates."""
        limit = len(self.entries) if self.settings.thorough else self.settings.duplicates
        return make_thumbnails(self, limit)

    @cached_property
    def expression_fit(self) -> ExpressionFit | None:
        """How well expressions explain the images; None if that cannot be measured."""
        return weigh_expression(self, facing_camera(self.views))

    @cached_property
    def cameras(self) -> Mapping[str, CameraFacts]:
        """Measurements of each camera."""
        timesteps = THOROUGH_TIMESTEPS if self.settings.thorough else self.settings.camera_timesteps
        if self.before_run:
            cameras = {entry.camera_id for entry in self.imaged_entries}
            timesteps = min(timesteps, max(FEWEST_TIMESTEPS, FEW_SHOTS // max(1, len(cameras))))
        return measure_cameras(self, timesteps) if timesteps else {}


def by_camera(entries: Sequence[FrameEntry]) -> dict[str, list[FrameEntry]]:
    """Frames by camera id, cameras in index order."""
    frames: dict[str, list[FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.camera_index, e.timestep)):
        frames.setdefault(entry.camera_id, []).append(entry)
    return frames


def first_entries(evidence: Evidence) -> dict[str, FrameEntry]:
    """First frame of each camera, in the first sequence that has it."""
    return {camera: frames[0] for camera, frames in by_camera(evidence.entries).items()}
