"""The tracked mesh compared with frames: position, orientation, silhouette, skin, and whether expressions explain colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.protocol import evenly_with_ends
from ..ga.tracking import Tracking
from ..head.geometry import project, rigid_alignment, vertex_normals
from ..head.subject import PosedSubject
from ..mesh_pictures import rasterize_mesh

if TYPE_CHECKING:
    from .evidence import Evidence
    from .views import ViewFacts


class TrackedSubject(PosedSubject):
    """The head with the identity of the first readable timestep, with teeth if its files have them."""

    def __init__(self, tracking: Tracking) -> None:
        super().__init__(tracking.head, tracking.shape, tracking.static_offset)
        self.head = tracking.head

    @cached_property
    def skin(self) -> IntArray:
        """Vertices of the face without eyeballs and mouth, whose colours can be compared; sorted."""
        regions = self.head.regions
        inner = [regions.get(name, np.empty(0, np.int64)) for name in INNER]
        return np.setdiff1d(regions.get("face", np.arange(len(self.head.template))), np.concatenate(inner))


FACE = ("face", "forehead", "nose")
"""Regions that neither hair nor cloth should cover, whose mesh must be inside the foreground."""

INNER = ("mouth_socket", "left_eyeball", "right_eyeball", "teeth")
NOT_SKIN = ("lips", "eye_region", *INNER)

SLACK = 0.04
"""Distance outside the foreground that a vertex of the face may have, relative to the mesh's height in the
image."""

WORKING_HEIGHT = 400
"""Maximum height of filled meshes in pixels, since only coarse values are needed."""

MIN_SKIN_PIXELS = 12
FAR = 0.2
"""Distance from the mesh relative to its height in the image: about 6 cm, more than most hair."""


@dataclass(frozen=True, eq=False)
class MeshFacts:
    """The posed mesh of one frame relative to its camera."""

    vertices: FloatArray
    """(V, 3) in the world of the frame's sequence, metres."""
    camera: Camera
    """Camera of the frame, at the image's size."""
    distance: float
    """Distance from the camera to the mesh's centre, metres."""
    depth: float
    """Depth of that centre along the viewing direction; negative behind the camera."""
    upright: float
    """Cosine of the angle between the upward directions of image and head."""
    facing: float
    """Cosine of the angle between the face's direction and the direction from head to camera."""
    face_outside: float | None = None
    """Fraction of the face's vertices outside of the foreground; this and the next three are None without a mask."""
    overlap: float | None = None
    """Intersection over union of mesh and foreground."""
    size: float | None = None
    """Area of the mesh divided by that of the foreground."""
    far: float | None = None
    """Fraction of the foreground that is farther from the mesh than `FAR`."""
    skin: FloatArray | None = None
    """Median colour (3,) of the face's visible skin, 8-bit levels; None if little of it is visible."""


def compare_mesh(
    subject: TrackedSubject, pose: HeadPose, camera: Camera, image: ByteArray, mask: ByteArray | None
) -> MeshFacts:
    """Pose the subject's mesh and compare it with an image, (H, W, 3) RGB, and its mask, (H, W)."""
    vertices = subject.meshes([pose])[0]
    turn = camera.world_to_camera[:3, :3]
    centre = vertices.mean(axis=0)
    towards = camera.center - centre
    # Axes of the template for the posed mesh, estimated from the face, in rows.
    face = _members(subject, FACE)
    head = rigid_alignment(vertices[face], subject.head.template[face])[:3, :3]
    distance = float(np.linalg.norm(towards))
    plain = MeshFacts(
        vertices=vertices,
        camera=camera,
        distance=distance,
        depth=float((turn @ centre + camera.world_to_camera[:3, 3])[2]),
        upright=float(-turn[1] @ head[1]),
        facing=float(head[2] @ towards / max(distance, 1e-9)),
    )
    if plain.depth <= 0:
        return plain
    return _compare_mask(plain, subject, image, mask)


def _members(subject: TrackedSubject, names: tuple[str, ...]) -> IntArray:
    """Vertices of the regions with these names; all vertices if the head has none of them."""
    regions = [subject.head.regions[name] for name in names if name in subject.head.regions]
    return np.unique(np.concatenate(regions)) if regions else np.arange(len(subject.head.template))


def _compare_mask(
    plain: MeshFacts, subject: TrackedSubject, image: ByteArray, mask: ByteArray | None
) -> MeshFacts:
    camera, vertices = plain.camera, plain.vertices
    scale = min(1.0, WORKING_HEIGHT / camera.height)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    small = camera.resized(width, height)
    front = rasterize_mesh(vertices, subject.head.faces, small).face
    filled = front >= 0
    size = (width, height)
    foreground = None
    if mask is not None:
        foreground = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    skin = _skin(subject, front, picture, foreground)
    if foreground is None or not foreground.any():
        return replace(plain, skin=skin)
    return replace(
        plain,
        skin=skin,
        overlap=float((filled & foreground).sum() / (filled | foreground).sum()),
        size=float(filled.sum() / foreground.sum()),
        far=_far(filled, foreground),
        face_outside=_face_outside(subject, vertices, small, filled, foreground),
    )


def _skin(
    subject: TrackedSubject, front: IntArray, image: ByteArray, foreground: np.ndarray | None
) -> FloatArray | None:
    member = np.zeros(len(subject.head.template), dtype=bool)
    member[_members(subject, FACE)] = True
    for name in NOT_SKIN:
        member[subject.head.regions.get(name, [])] = False
    shows = (front >= 0) & member[subject.head.faces[np.maximum(front, 0)]].all(axis=2)
    if foreground is not None:
        shows &= foreground
    return np.median(image[shows], axis=0) if shows.sum() >= MIN_SKIN_PIXELS else None


def _far(filled: np.ndarray, foreground: np.ndarray) -> float:
    rows = np.flatnonzero(filled.any(axis=1))
    if not len(rows):
        return 1.0
    distance = cv2.distanceTransform((~filled).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float((distance[foreground] > FAR * (rows[-1] - rows[0] + 1)).mean())


def _face_outside(
    subject: TrackedSubject, vertices: FloatArray, camera: Camera, filled: np.ndarray, foreground: np.ndarray
) -> float:
    pixels = project(vertices[_members(subject, FACE)], camera)
    column, row = np.floor(np.clip(pixels, -1, 2**20)).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    if not inside.any():
        return 1.0
    distance = cv2.distanceTransform((~foreground).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    rows = np.flatnonzero(filled.any(axis=1))
    slack = SLACK * (rows[-1] - rows[0] + 1) if len(rows) else 0.0
    return float((distance[row[inside], column[inside]] > slack).mean())


FRAMES = 16
"""Frames to judge by."""

FEWEST_FRAMES, FEWEST_VERTICES = 6, 50
"""Minimum amount of data for a result."""

EXPRESSION_FACING = 0.5
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


def weigh_expression(evidence: Evidence) -> ExpressionFit | None:
    """Compare the expression with a face at rest in the most frontal camera of the views; None if there are too few data."""
    subject, camera = evidence.subject, _facing_camera(evidence.views)
    if subject is None or camera is None:
        return None
    poses = {entry: evidence.pose(entry.timestep) for split in evidence.imaged.values() for entry in split}
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
            image = evidence.pixels.image(entry)
        except InputError:
            continue  # reported as a damaged file
        still = replace(pose, expression=np.zeros_like(pose.expression))
        for samples, vertices in zip((moving, resting), subject.meshes([pose, still])):
            samples.append(_face_colours(vertices, subject, evidence.camera(entry), image))
    return _compare(camera, moving, resting)


def _facing_camera(views: Sequence[ViewFacts]) -> str | None:
    facing: dict[str, list[float]] = {}
    for view in views:
        if view.mesh is not None and view.mesh.depth > 0:
            facing.setdefault(view.entry.camera_id, []).append(view.mesh.facing)
    return max(facing, key=lambda name: float(np.median(facing[name]))) if facing else None


def _face_colours(
    vertices: FloatArray, subject: TrackedSubject, camera: Camera, image: ByteArray
) -> _FaceColours:
    points = vertices[subject.skin]
    outward = vertex_normals(vertices, subject.head.faces)[subject.skin]
    towards = camera.center - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    pixels = project(points, camera)
    where = (pixels - 0.5).astype(np.float32)  # OpenCV's pixel centres are at integers
    sampled = cv2.remap(image.astype(np.float32), where[:, :1], where[:, 1:], cv2.INTER_LINEAR)
    colours = sampled[:, 0].astype(np.float64)
    within = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return _FaceColours(colours, ((outward * towards).sum(axis=1) > EXPRESSION_FACING) & within, pixels)


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
