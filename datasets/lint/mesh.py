"""Tracked parameters read file by file, and the tracked mesh compared with a frame: position, orientation, silhouette,
skin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import read_npz
from ..ga.tracking import Tracking, read_tracking
from ..ga.transforms import FrameEntry
from ..head.arrays import HeadArrays
from ..head.geometry import project, rigid_alignment
from ..head.subject import PosedSubject
from ..mesh_pictures import rasterize_mesh

OFFSETS = ("static_offset", "dynamic_offset")
"""Arrays with a row per vertex; too large to keep for every timestep."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """One parameter file.

    Attributes
    ----------
    arrays : Mapping[str, np.ndarray]
        Stored arrays without the per-vertex `OFFSETS`; empty if the file cannot be read.
    not_finite : tuple[str, ...]
        Names of arrays with NaN or infinite numbers.
    offset_change_m : float
        Largest difference of its static offset from the first file's; 0 without one.
    dynamic_m : float
        Largest entry of its dynamic offset; 0 without one.
    pose : HeadPose | None
        None if the head is unknown or the arrays do not fit it.
    error : InputError | None
        Why there is no pose.
    """

    timestep: int
    path: Path
    arrays: Mapping[str, np.ndarray]
    not_finite: tuple[str, ...] = ()
    offset_change_m: float = 0.0
    dynamic_m: float = 0.0
    pose: HeadPose | None = None
    error: InputError | None = None


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


def read_parameters(
    entries: Sequence[FrameEntry], head: HeadArrays | None, *, progress: Progress = no_progress
) -> tuple[dict[int, Parameters], TrackedSubject | None]:
    """Parameters by timestep (of its first frame), and the head and identity that they fit."""
    files: dict[int, Path] = {}
    for entry in entries:
        files.setdefault(entry.timestep, entry.parameters)
    found: dict[int, Parameters] = {}
    subject: TrackedSubject | None = None
    first_offset: np.ndarray | None = None
    for done, (timestep, path) in enumerate(sorted(files.items()), start=1):
        progress(done, len(files), "reading parameters")
        try:
            arrays = read_npz(path)
        except InputError as error:
            found[timestep] = Parameters(timestep, path, {}, error=error)
            continue
        offset = _numbers(arrays.get("static_offset"))
        if first_offset is None:
            first_offset = offset
        pose = fault = None
        if head is not None:
            try:
                tracking = read_tracking(
                    {timestep: path},
                    subject.head if subject else head,
                    "",
                    teeth="keep" if subject else "auto",
                )
                pose = tracking.poses[timestep]
                subject = subject or TrackedSubject(tracking)
            except InputError as error:
                fault = error
        found[timestep] = Parameters(
            timestep=timestep,
            path=path,
            arrays={name: array for name, array in arrays.items() if name not in OFFSETS},
            not_finite=not_finite(arrays),
            offset_change_m=_largest(offset - first_offset) if offset.shape == first_offset.shape else 0.0,
            dynamic_m=_largest(_numbers(arrays.get("dynamic_offset"))),
            pose=pose,
            error=fault,
        )
    return found, subject


def not_finite(arrays: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the arrays with NaN or infinite numbers."""
    return tuple(name for name, array in arrays.items() if not _is_finite(array))


def _numbers(array: np.ndarray | None) -> np.ndarray:
    """The array if its numbers are finite, else an empty one."""
    usable = array is not None and array.dtype.kind in "fiu" and _is_finite(array)
    return array if array is not None and usable else np.empty(0)


def _is_finite(array: np.ndarray) -> bool:
    return array.dtype.kind not in "f" or bool(np.isfinite(array).all())


def _largest(array: np.ndarray) -> float:
    return float(np.abs(array).max(initial=0.0))


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
    """The posed mesh of one frame relative to its camera.

    Attributes
    ----------
    vertices : FloatArray
        (V, 3) in the world of the frame's sequence, metres.
    camera : Camera
        Camera of the frame, at the image's size.
    distance : float
        Distance from the camera to the mesh's centre, metres.
    depth : float
        Depth of that centre along the viewing direction; negative behind the camera.
    upright : float
        Cosine of the angle between the upward directions of image and head.
    facing : float
        Cosine of the angle between the face's direction and the direction from head to camera.
    face_outside : float | None
        Fraction of the face's vertices outside of the foreground; None without a mask.
    overlap : float | None
        Intersection over union of mesh and foreground; None without a mask.
    size : float | None
        Area of the mesh divided by that of the foreground; None without a mask.
    far : float | None
        Fraction of the foreground that is farther from the mesh than `FAR`; None without a mask.
    skin : FloatArray | None
        Median colour (3,) of the face's visible skin, 8-bit levels; None if little of it is visible.
    """

    vertices: FloatArray
    camera: Camera
    distance: float
    depth: float
    upright: float
    facing: float
    face_outside: float | None = None
    overlap: float | None = None
    size: float | None = None
    far: float | None = None
    skin: FloatArray | None = None


def lay_mesh(
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
    return _held_against(plain, subject, image, mask)


def _members(subject: TrackedSubject, names: tuple[str, ...]) -> IntArray:
    """Vertices of the regions with these names; all vertices if the head has none of them."""
    regions = [subject.head.regions[name] for name in names if name in subject.head.regions]
    return np.unique(np.concatenate(regions)) if regions else np.arange(len(subject.head.template))


def _held_against(
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
