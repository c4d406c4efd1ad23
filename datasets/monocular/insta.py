"""Read training folders of INSTA, which ``generate.sh`` makes from Metrical Tracker's output::

    transforms_train.json, transforms_test.json (or transforms.json alone), transforms_val.json
    images/00012.png            straight alpha; without, matted/00012.png has it
    flame/exp/00012.txt         expression, one number a line
    flame/jaw, flame/eyes       6D rotations, one and two; only older versions of the script write them
    meshes/00012.obj            FLAME's vertices, its faces simplified
    canonical.obj               the subject's head without expression, its jaw open by 12 degrees
    depth, seg_mask             not used

``transform_matrix`` is camera-to-world with OpenCV's axes, in metres; unlike in GaussianAvatars' JSONs of the same names
no axis is flipped. The world is that of FLAME with root and neck at rest. Identity is not in a parameter file: it is
fitted to ``canonical.obj``, and other missing parameters to the meshes (see `mesh_fit`). The tracker's eyelids are
only in the meshes and fitted if the head model has a basis for them.

Formats read:

- INSTA's training folders. Written by Zielon/INSTA@9c17968e (`scripts/transforms.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ...bench.contracts import Camera, FloatArray, HeadPose, IntArray, Progress
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers
from ...bench.io.documents import checked, read_json, read_text
from ...bench.io.files import read_bytes, reading, with_slashes
from ...bench.io.images import probe_image
from ...bench.protocol import evenly_with_ends
from ..ga.layout import ALL_FRAMES_FILE, SPLIT_FILES
from ..ga.transforms import check_lenses, read_rigid
from ..head.arrays import JOINT_NAMES, HeadArrays
from ..head.loaders import EYELIDS_REMEDY
from ..head.model import HeadModel
from .clip import VIDEO, Track, VideoFrame, coefficients, frame_number, ordered, rotations_of_6d

WORST_DISTANCE = 1e-4
"""Maximum median distance of vertices from the mesh, metres: rounding gives 1e-8, another head model of the same
topology 1e-3, and lids without a basis in the head model move fewer than half of the vertices."""

_VERTEX = re.compile(rb"^v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_TURNING = [JOINT_NAMES.index(name) for name in ("jaw", "left_eye", "right_eye")]
_STEP, _SMALL, _MOST_STEPS = 1e-6, 1e-9, 30
_TOGETHER = 32  # meshes posed at once
_ROWS = 200
"""Number of vertices used for each joint and lid, enough for rounding to eight digits."""


def read_vertices(path: Path, count: int) -> FloatArray:
    """(V, 3) vertices of a Wavefront OBJ; faces are not read, since programs simplify them without changing the
    vertices."""
    content = read_bytes(path, "a Wavefront OBJ")
    rows = _VERTEX.findall(content)
    if len(rows) != count:
        remedy = "Give the head model the video was tracked with."
        raise InputError(path, "v", f"{count} vertices, as the head model has", f"{len(rows)}", remedy)
    with reading(path, "three numbers for each vertex", "v"):  # no array of the longest word
        vertices = np.array([[float(word) for word in vertex] for vertex in rows])
    check_numbers(path, "v", vertices, MAX_MAGNITUDE)
    return vertices


class Identity(NamedTuple):
    """Result of `MeshFit.fit_identity`."""

    shape: FloatArray
    """(S,)"""
    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""


class Pose(NamedTuple):
    """Result of `MeshFit.fit_pose`."""

    turns: FloatArray
    """(9,) axis-angle of jaw, left and right eye."""
    lids: FloatArray
    """(2,) eyelids, left and right; (0,) where the head model has no basis for them."""
    distance: float
    """Median distance of a vertex from the mesh, metres."""
    farthest: float
    """Largest distance of a vertex from the mesh, metres."""


class MeshFit:
    """Inverts a head model with root and neck at rest."""

    def __init__(self, head: HeadArrays) -> None:
        self._model = HeadModel(head, dtype=torch.float64)
        self._template = np.asarray(head.template, np.float64)
        self._shape_basis = np.asarray(head.shape_basis, np.float64)
        none = np.zeros((*self._template.shape, 0))
        self._lids = none if head.eyelid_basis is None else np.asarray(head.eyelid_basis, np.float64)
        weights = np.asarray(head.skinning_weights, np.float64)[:, _TURNING]
        parts = [*weights.T, *np.abs(self._lids).max(axis=1).T]
        strong = [np.flatnonzero(part > 0.1 * part.max(initial=0)) for part in parts]
        picked = [rows[evenly_with_ends(range(len(rows)), _ROWS)] for rows in strong]
        self._rows: IntArray = np.unique(np.concatenate(picked))

    def fit_identity(self, mesh: FloatArray) -> Identity:
        """Shape coefficients, jaw and eyes of a (V, 3) mesh without expression, by the Gauss-Newton method."""
        basis = np.moveaxis(self._shape_basis, 2, 0)
        size = len(basis)
        shape, turns = np.zeros(size), np.zeros(9)
        for _ in range(_MOST_STEPS):
            shaped = self._template + self._shape_basis @ shape
            posed, by_turn = self._linearised(shaped, turns)
            # For given rotations a posed mesh is linear in the mesh at rest, except for the correctives.
            still = self._posed(np.zeros_like(shaped)[None], turns[None])
            parts = np.array_split(basis, max(size // _TOGETHER, 1))
            by_shape = [self._posed(part, turns[None]) - still for part in parts]
            jacobian = np.concatenate([*by_shape, by_turn]).reshape(size + 9, -1)
            gram, right = jacobian @ jacobian.T, jacobian @ (mesh - posed).ravel()
            step = np.linalg.lstsq(gram, right, rcond=1e-13)[0]
            shape, turns = shape + step[:size], turns + step[size:]
            if np.abs(step).max() < _SMALL:
                break
        shaped = self._template + self._shape_basis @ shape
        return Identity(shape, turns, _middle(self._posed(shaped[None], turns[None])[0] - mesh))

    def fit_pose(self, mesh: FloatArray, shaped: FloatArray, known: FloatArray | None) -> Pose:
        """Jaw, eyes and eyelids of one mesh. ``mesh``: (V, 3). ``shaped``: (V, 3) head with identity and expression,
        unposed. ``known``: (9,) jaw and eyes if they are known; only the eyelids are fitted then."""
        turns, lids = np.zeros(9) if known is None else known, np.zeros(self._lids.shape[2])
        rows = self._rows
        by_lids = self._lids[rows].reshape(3 * len(rows), -1)
        for _ in range(_MOST_STEPS):
            columns = [by_lids]
            if known is None:
                posed, by_turn = self._linearised(shaped, turns)
                columns.append(by_turn[:, rows].reshape(9, -1).T)
            else:
                posed = self._posed(shaped[None], turns[None])[0]
            left = (mesh - posed)[rows].ravel() - by_lids @ lids
            step = np.linalg.lstsq(np.hstack(columns), left, rcond=None)[0]
            lids = lids + step[: len(lids)]
            if known is None:
                turns = turns + step[len(lids) :]
            if np.abs(step).max(initial=0) < _SMALL:
                break
        left = mesh - self._posed(shaped[None], turns[None])[0] - self._lids @ lids
        return Pose(turns, lids, _middle(left), float(np.linalg.norm(left, axis=1).max()))

    def _linearised(self, shaped: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(V, 3) posed vertices and their (9, V, 3) derivatives by the turns, by forward differences."""
        posed = self._posed(shaped[None], turns + _STEP * np.eye(10, 9, -1))
        return posed[0], (posed[1:] - posed[0]) / _STEP

    @torch.no_grad()
    def _posed(self, shaped: FloatArray, turns: FloatArray) -> FloatArray:
        """(B, V, 3) vertices of (B or 1, V, 3) heads at rest with (B or 1, 9) turns of jaw and eyes."""
        moving, rest = torch.from_numpy(turns), torch.zeros(1, 3, dtype=torch.float64)
        still = dict.fromkeys(("rotation", "neck", "translation"), rest)
        expression = torch.zeros(1, self._model.expression_size, dtype=torch.float64)
        return self._model(
            **still,
            canonical=torch.from_numpy(shaped),
            expression=expression,
            jaw=moving[:, :3],
            eyes=moving[:, 3:],
        ).numpy()


def _middle(left: FloatArray) -> float:
    return float(np.median(np.linalg.norm(left, axis=1)))


def check_distance(file: Path, distance: float, version: str) -> None:
    """Raise `InputError` if a mesh is farther from the head than rounding explains."""
    if not distance <= WORST_DISTANCE:
        expected = (
            f"a mesh that head model {version} makes, its middle vertex within {1e3 * WORST_DISTANCE:g} mm"
        )
        remedy = (
            "Give the head model that the video was tracked with: Metrical Tracker's is FLAME 2020 "
            "(generic_model.pkl), whose coefficients are not those of FLAME 2023."
        )
        raise InputError(file, "v", expected, f"{1e3 * distance:.3g} mm", remedy)


log = logging.getLogger(__name__)

EXPRESSIONS, CANONICAL = "flame/exp", "canonical.obj"
CHECKED_MESHES = 50
"""Number of meshes of a video that are compared with complete parameters, enough to include a blink."""
WORST_VERTEX = 1e-3
"""Maximum distance of a vertex from a mesh without a warning about lost eyelids, which move by up to 9 mm, metres."""


@dataclass(frozen=True)
class _Intrinsics:
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    camera_angle_x: float | None = None
    w: float | None = None
    h: float | None = None


@dataclass(frozen=True)
class _Frame(_Intrinsics):
    file_path: str = ""
    mesh_path: str = ""
    exp_path: str = ""
    timestep_index: int | None = None
    transform_matrix: Any = None


@dataclass(frozen=True)
class _Document(_Intrinsics):
    frames: tuple[_Frame, ...] = ()


@dataclass(frozen=True, eq=False)
class _Source:
    """A frame's files and JSON entry."""

    where: tuple[Path, str]
    number: int
    image: Path
    mask: Path
    camera: Camera
    expression: Path
    mesh: Path


def is_insta(root: Path) -> bool:
    """Whether a folder has this layout: coefficients as text, and frames."""
    return (root / EXPRESSIONS).is_dir() and any((root / file).is_file() for file in _files())


def read_insta(root: Path, head: HeadArrays, progress: Progress) -> Track:
    """Read a folder."""
    held_out: frozenset[tuple[str, int]] | None = None
    documents = [root / file for file in (SPLIT_FILES["train"], SPLIT_FILES["self_reenactment"])]
    if not all(document.is_file() for document in documents):
        documents = [root / ALL_FRAMES_FILE]
    parts = [_read_document(root, document) for document in documents]
    if len(parts) == 2:
        held_out = frozenset((VIDEO, source.number) for source in parts[1])
        shared = held_out & {(VIDEO, source.number) for source in parts[0]}
        if shared:
            found = f"{len(shared)} frames of {documents[0].name} again, such as {min(shared)[1]}"
            raise InputError(documents[1], "frames", "frames that are not trained on", found)
    sources = sorted((source for part in parts for source in part), key=lambda source: source.number)
    fit = MeshFit(head)
    canonical = root / CANONICAL
    identity = fit.fit_identity(read_vertices(canonical, len(head.template)))
    check_distance(canonical, identity.distance, head.version)
    meshes = _Meshes(root, head, fit, identity.shape, sources)
    frames = []
    for done, source in enumerate(sources, start=1):
        camera, pose = source.camera, meshes.pose(source)
        frames.append(VideoFrame(source.where, VIDEO, source.number, source.image, source.mask, camera, pose))
        progress(done, len(sources), "reading tracked parameters")
    notes = {
        "layout": "insta",
        "shape_from": CANONICAL,
        "canonical_jaw": identity.turns[:3].round(4).tolist(),
        "canonical_distance_mm": 1e3 * identity.distance,
        **meshes.notes(),
    }
    files = frozenset([*documents, canonical, *meshes.files])
    return Track(ordered(root, frames), identity.shape, held_out, files, notes)


def _files() -> tuple[str, ...]:
    return (SPLIT_FILES["train"], ALL_FRAMES_FILE)


def _read_document(root: Path, path: Path) -> list[_Source]:
    content = read_json(path)
    check_lenses(path, content)
    document = checked(content, _Document, path, foreign=True)
    return [_source(root, path, f"frames[{i}]", frame, document) for i, frame in enumerate(document.frames)]


def _source(root: Path, path: Path, where: str, frame: _Frame, document: _Document) -> _Source:
    if frame.timestep_index is not None:
        raise InputError(
            path,
            f"{where}.timestep_index",
            "a frame of INSTA's, which has none",
            "VHAP's export of meshes",
            "Its meshes have no jaw or eye rotation: export the tracking again with --flame-mode param.",
        )
    if not frame.file_path:
        raise InputError(path, f"{where}.file_path", "the file of an image", "none")
    image = root / with_slashes(frame.file_path)
    image = image if image.suffix else image.with_suffix(".png")
    number = frame_number(path, f"{where}.file_path", image.stem)
    info = probe_image(image)
    mask = image
    if not info.has_alpha:
        mask = root / "matted" / f"{image.stem}.png"
        if not mask.is_file() or not probe_image(mask).has_alpha:
            expected = f"an alpha channel, or matted/{mask.name} with one"
            raise InputError(image, "", expected, "colours alone", "Run INSTA's generate.sh to the end.")
        other = probe_image(mask)
        if (other.width, other.height) != (info.width, info.height):
            raise InputError(mask, "", f"{info.width}x{info.height} pixels", f"{other.width}x{other.height}")
    world_to_camera = np.linalg.inv(read_rigid(path, f"{where}.transform_matrix", frame.transform_matrix))
    K = _intrinsics(path, where, frame, document, info.width, info.height)
    camera = Camera("0", info.width, info.height, K, world_to_camera)
    expression = root / with_slashes(frame.exp_path or f"{EXPRESSIONS}/{image.stem}.txt")
    mesh = root / with_slashes(frame.mesh_path or f"meshes/{image.stem}.obj")
    return _Source((path, where), number, image, mask, camera, expression, mesh)


def _intrinsics(
    path: Path, where: str, frame: _Frame, document: _Document, width: int, height: int
) -> FloatArray:
    """(3, 3) K; entries of the frame take precedence over the document's."""
    given = {
        name: own if own is not None else getattr(document, name)
        for name, own in ((name, getattr(frame, name)) for name in _Intrinsics.__dataclass_fields__)
    }
    for name, size in (("w", width), ("h", height)):
        if given[name] not in (None, size):
            remedy = "Intrinsics in pixels belong to images of the size that was tracked."
            raise InputError(path, f"{where}.{name}", f"{size}, as the image", f"{given[name]:g}", remedy)
    focal, angle = given["fl_x"], given["camera_angle_x"]
    if focal is None and angle is not None and 0 < angle < np.pi:
        focal = width / (2 * np.tan(angle / 2))
    if focal is None or focal <= 0:
        raise InputError(path, f"{where}.fl_x", "a positive focal length in pixels", f"{focal}")
    second = focal if given["fl_y"] is None else given["fl_y"]
    if second <= 0:
        raise InputError(path, f"{where}.fl_y", "a positive focal length in pixels", f"{second:g}")
    cx = width / 2 if given["cx"] is None else given["cx"]
    cy = height / 2 if given["cy"] is None else given["cy"]
    K = np.array([[focal, 0.0, cx], [0.0, second, cy], [0.0, 0.0, 1.0]])
    check_numbers(path, where, K, MAX_MAGNITUDE)
    return K


class _Meshes:
    """Poses of frames, from text files if they exist and otherwise from meshes."""

    def __init__(
        self, root: Path, head: HeadArrays, fit: MeshFit, shape: FloatArray, sources: list[_Source]
    ) -> None:
        self._root, self._head, self._fit = root, head, fit
        with torch.no_grad():
            model = HeadModel(head, dtype=torch.float64)
            self._neutral = model.canonical(torch.from_numpy(shape))[0].numpy()
        self._expressions = np.asarray(head.expression_basis, np.float64)
        self._compared = {source.number for source in evenly_with_ends(sources, CHECKED_MESHES)}
        self._farthest, self._fitted, self._read = 0.0, 0, 0
        self._missed = self._closed = 0.0
        self.files: set[Path] = set()

    def pose(self, source: _Source) -> HeadPose:
        """Pose of a frame in FLAME's world."""
        head, stem = self._head, source.expression.stem
        expression = coefficients(
            source.expression, "", self._numbers(source.expression), head.expression_basis.shape[2]
        )
        jaw = self._rotations(self._root / "flame/jaw" / f"{stem}.txt", 1)
        eyes = self._rotations(self._root / "flame/eyes" / f"{stem}.txt", 2)
        angles: FloatArray | None = None if jaw is None or eyes is None else np.concatenate([jaw, eyes])
        lids: FloatArray | None = None
        if angles is None or head.eyelid_basis is not None or source.number in self._compared:
            if angles is not None and not source.mesh.is_file():
                lids = None if head.eyelid_basis is None else np.zeros(2)
            else:
                mesh = read_vertices(source.mesh, len(head.template))
                self.files.add(source.mesh)
                found = self._fit.fit_pose(mesh, self._neutral + self._expressions @ expression, angles)
                check_distance(source.mesh, found.distance, head.version)
                self._farthest, self._read = max(self._farthest, found.distance), self._read + 1
                self._fitted += angles is None
                angles = found.turns
                lids = found.lids if len(found.lids) else None
                self._missed = max(self._missed, found.farthest)
                self._closed = max(self._closed, float(found.lids.max(initial=0.0)))
        assert angles is not None, "fitted where it was not given"
        rest = np.zeros(3)
        return HeadPose(head.version, expression, rest, rest, angles[:3], angles[3:], rest, lids)

    def notes(self) -> dict[str, Any]:
        """Source of the poses."""
        eyelids = f"from meshes, closed by up to {self._closed:.2f}"
        if self._head.eyelid_basis is None:
            eyelids = (
                f"the head model has no basis; vertices lie up to {1e3 * self._missed:.1f} mm from the meshes"
            )
            if self._missed > WORST_VERTEX:
                log.warning("%s: eyelids: %s. %s", self._root, eyelids, EYELIDS_REMEDY)
        return {
            "jaw_and_eyes_from_meshes": self._fitted,
            "meshes_compared": self._read,
            "mesh_distance_mm": 1e3 * self._farthest,
            "eyelids": eyelids,
        }

    def _rotations(self, path: Path, count: int) -> FloatArray | None:
        """Concatenated axis-angle vectors from 6D rotations or axis-angle in a file; None if they are missing."""
        if not path.is_file():
            return None
        values = self._numbers(path)
        if len(values) == 3 * count:
            return values
        if len(values) != 6 * count:
            expected = f"{6 * count} numbers (6D rotations) or {3 * count} (axis-angle)"
            raise InputError(path, "", expected, f"{len(values)}")
        return rotations_of_6d(path, "", values.reshape(count, 6)).ravel()

    def _numbers(self, path: Path) -> FloatArray:
        text = read_text(path, "text")
        with reading(path, "numbers, one a line"):
            values = np.array([float(word) for word in text.split()])  # no array of the longest word
        check_numbers(path, "", values, MAX_MAGNITUDE)
        self.files.add(path)
        return values
