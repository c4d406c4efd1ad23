"""Files of a head model for GaussianAvatars' code: FLAME's pickle, its masks, a template, landmarks.

Their paths are relative to the program's working directory, so that a clip's own head model replaces the one in the
checkout. The code adds teeth, attached to thirty vertices with fixed indices, and reads 300 and 100 coefficients: a
head of another topology is renumbered so that these vertices are its lips, one with fewer coefficients is padded.
"""

from __future__ import annotations

import importlib
import itertools
import math
import operator
import pickle
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import cv2
import numpy as np

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray, HeadAsset, HeadPose, IntArray
from ....bench.errors import InputError
from ....bench.io.files import atomic_path, read_bytes, write_bytes, write_text
from ....datasets.ga.tracking import pose_to_parameters
from ....datasets.ga.writer import save_npz
from ....datasets.head.arrays import JOINT_NAMES, RING_REGIONS
from ....datasets.head.loaders import FLAME_IDENTITY_SIZE
from ....datasets.head.teeth import lip_rings
from ...shared.avatar_files import head_arrays
from ..checkout import find_constant

Image = TypeVar("Image", ByteArray, FloatArray)

LARGEST_ERROR = 0.1
"""Tolerance of a projection at the image's border in pixels, if pixels are not quite square or have a
skew."""


@dataclass(frozen=True, eq=False)
class Window:
    """A box of a camera's image with the principal point in its middle."""

    camera: Camera
    """Camera of the box, with the principal point exactly in the middle and one focal length for both axes."""
    left: int
    top: int
    """Position of the box in the image, whole pixels; negative if it begins outside."""

    def cut(self, image: ByteArray) -> ByteArray:
        """Crop of a camera's image to the box."""
        rows = slice(self.top, self.top + self.camera.height)
        return np.ascontiguousarray(image[rows, self.left : self.left + self.camera.width])

    def uncut(self, image: Image, camera: Camera) -> Image:
        """The image of the camera, cropped from one of the box around it."""
        rows = slice(-self.top, camera.height - self.top)
        return cast(Image, np.ascontiguousarray(image[rows, -self.left : camera.width - self.left]))

    def padded(self, image: ByteArray, fill: int) -> ByteArray:
        """An image (H, W, C) of the camera, padded with ``fill`` to the box around it."""
        whole = np.full((self.camera.height, self.camera.width, image.shape[2]), fill, np.uint8)
        whole[-self.top : image.shape[0] - self.top, -self.left : image.shape[1] - self.left] = image
        return whole


def inside(camera: Camera) -> Window:
    """The largest window inside the image, for training, since nothing is known beyond the image."""
    return _window(camera, grow=False)


def around(camera: Camera) -> Window:
    """The smallest window around the image, for rendering; the image is cropped from it."""
    return _window(camera, grow=True)


def cameras_of(clip: Clip, *splits: str) -> dict[str, Camera]:
    """Cameras of the frames of some splits, of all by default, by name and in the order of the names."""
    names = {key.camera for split in splits or clip.splits for key in clip.splits[split]}
    return {name: clip.cameras[name] for name in sorted(names)}


def check_square_pixels(camera: Camera, where: str) -> None:
    """Raise `InputError` for a camera with visibly non-square or skewed pixels."""
    K = np.asarray(camera.K, np.float64)
    off = max(abs(K[1, 1] / K[0, 0] - 1) * camera.height, abs(K[0, 1] / K[0, 0]) * camera.width) / 2
    if off > LARGEST_ERROR:
        found = f"focal lengths {K[0, 0]:.2f} and {K[1, 1]:.2f}, skew {K[0, 1]:.2f}"
        raise InputError(where, f"camera {camera.id}", "square pixels, which the code supports", found)


def _window(camera: Camera, *, grow: bool) -> Window:
    width, left, off_x = _span(camera.width, float(camera.K[0, 2]), grow)
    height, top, off_y = _span(camera.height, float(camera.K[1, 2]), grow)
    focal = float(camera.K[0, 0])
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    turned = np.eye(4)
    turned[:3, :3] = _towards(np.array([-off_x / focal, -off_y / focal, 1.0]))
    world_to_camera = turned @ np.asarray(camera.world_to_camera, np.float64)
    return Window(
        replace(camera, width=width, height=height, K=K, world_to_camera=world_to_camera), left, top
    )


def _span(size: int, center: float, grow: bool) -> tuple[int, int, float]:
    """Length and start of a window along one axis, and the offset of the principal point to the right of its middle.

    The offset is at most a quarter of a pixel, since starts and ends are whole pixels.
    """
    shift = math.floor(size - 2 * center + 0.5)
    length = size + abs(shift) if grow else size - abs(shift)
    if length < 1:
        raise InputError("camera", "K", f"a principal point inside the image, {size} pixels", f"{center:.1f}")
    # Shift > 0: the principal point lies left of the middle. Growing adds pixels at the left, shrinking removes them
    # at the right.
    begin = (-shift if shift > 0 else 0) if grow else (0 if shift > 0 else -shift)
    return length, begin, center - begin - length / 2


def _towards(direction: FloatArray) -> FloatArray:
    """The smallest rotation from a direction to the optical axis."""
    unit = direction / np.linalg.norm(direction)
    axis = np.cross(unit, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return np.eye(3)
    rotation, _ = cv2.Rodrigues(axis / sine * math.atan2(sine, float(unit[2])))
    return np.asarray(rotation, np.float64)


def square(camera: Camera, side: int) -> Window:
    """The square window around an image with the principal point in its middle; pixels need not be square."""
    K = np.asarray(camera.K, np.float64)
    (left, off_x), (top, off_y) = (_centred(float(K[axis, 2]), side) for axis in range(2))
    if not _encloses(camera, side):
        raise InputError(f"camera {camera.id}", "side", f"{square_side([camera])} pixels or more", str(side))
    turned = np.eye(4)
    turned[:3, :3] = _towards(np.array([-off_x / K[0, 0], -off_y / K[1, 1], 1.0]))
    centred = np.array([[K[0, 0], 0.0, side / 2], [0.0, K[1, 1], side / 2], [0.0, 0.0, 1.0]])
    world_to_camera = turned @ np.asarray(camera.world_to_camera, np.float64)
    moved = replace(camera, width=side, height=side, K=centred, world_to_camera=world_to_camera)
    return Window(moved, left, top)


def square_side(cameras: Iterable[Camera]) -> int:
    """The smallest side of a square window by `square` around the image of each camera."""
    cameras = list(cameras)
    shortest = max(max(camera.width, camera.height) for camera in cameras)
    return next(side for side in itertools.count(shortest) if all(_encloses(c, side) for c in cameras))


def _encloses(camera: Camera, side: int) -> bool:
    for axis, size in enumerate((camera.width, camera.height)):
        begin, _ = _centred(float(camera.K[axis, 2]), side)
        if begin > 0 or begin + side < size:
            return False
    return True


def _centred(center: float, side: int) -> tuple[int, float]:
    """Start of a window with a point in its middle, and the offset of the point to the right of the middle, at most half a pixel."""
    begin = math.floor(center - side / 2 + 0.5)
    return begin, center - begin - side / 2


ASSETS = Path("flame_model/assets/flame")
MODEL_FILE, MASKS_FILE = ASSETS / "flame2023.pkl", ASSETS / "FLAME_masks.pkl"
TEMPLATE_FILE, LANDMARKS_FILE = ASSETS / "head_template_mesh.obj", ASSETS / "landmark_embedding_with_eyes.npy"
SOURCE = "flame_model/flame.py"
EXPRESSION_SIZE = 100
"""Expression coefficients that their code reads."""
MASKS = (
    *("face", "neck", "scalp", "boundary", "right_eyeball", "left_eyeball", "right_ear"),
    *("left_ear", "forehead", "eye_region", "nose", "lips", "right_eye_region", "left_eye_region"),
)
"""Regions of FLAME's masks; those that a head lacks are empty."""
LANDMARKS = 70


def padding_remarks(head: HeadAsset) -> list[str]:
    """Record entry of an avatar if the expression basis of its head is padded."""
    size = head.expression_basis.shape[2]
    return [f"an expression basis of {size} directions is padded with zeros"] * (size < EXPRESSION_SIZE)


def without_teeth(head: HeadAsset) -> tuple[IntArray, IntArray]:
    """(V',) vertices of a head without its teeth, and its triangles (F', 3) in their numbering."""
    kept = np.setdiff1d(np.arange(len(head.template)), head.regions.get("teeth", []))
    number = np.full(len(head.template), -1)
    number[kept] = np.arange(len(kept))
    return kept, number[head.faces[np.isin(head.faces, kept).all(axis=1)]]


@dataclass(frozen=True, eq=False)
class OfficialHead:
    """A head model for their code: without teeth, with vertices in their order."""

    head: HeadAsset

    order: IntArray
    """(V',) vertex of the clip's head for each of theirs; -1 for a vertex without a counterpart."""
    faces: IntArray

    @classmethod
    def of(cls, head: HeadAsset, checkout: Path) -> OfficialHead:
        """Convert a clip's head model for their code."""
        official = cls.numbered(head)
        if _same_faces(official.faces, checkout / TEMPLATE_FILE):
            return official  # FLAME's own topology: their indices are valid
        return official._with_lips(_their_rings(checkout), f"head model {head.version!r}")

    @classmethod
    def numbered(cls, head: HeadAsset) -> OfficialHead:
        """A head with its own indices, without teeth."""
        where = f"head model {head.version!r}"
        for name, size, most in (
            ("identity", head.shape_basis.shape[2], FLAME_IDENTITY_SIZE),
            ("expression", head.expression_basis.shape[2], EXPRESSION_SIZE),
        ):
            if size > most:
                expected = f"at most {most} directions, as many as their code reads"
                raise InputError(where, f"{name} basis", expected, f"{size}")
        if list(head.parents) != [-1, 0, 1, 1, 1]:
            expected = f"FLAME's joints, {', '.join(JOINT_NAMES)}"
            raise InputError(where, "parents", expected, f"{list(head.parents)}")
        return cls(head, *without_teeth(head))

    def _with_lips(self, wanted: tuple[IntArray, IntArray], where: str) -> OfficialHead:
        """Renumber the vertices so that the given indices are the rings of the lips."""
        rings = [np.searchsorted(self.order, ring) for ring in lip_rings(self.head)]
        for ring, numbers in zip(rings, wanted):
            if len(ring) != len(numbers):
                expected = f"rings of {len(numbers)} vertices, to which their code attaches teeth"
                raise InputError(where, " and ".join(RING_REGIONS), expected, f"{len(ring)}")
        lips, places = np.concatenate(rings), np.concatenate(wanted)
        count = max(len(self.order), int(places.max()) + 1)
        free = np.setdiff1d(np.arange(count), places)
        rest = np.setdiff1d(np.arange(len(self.order)), lips)
        old = np.full(count, -1)
        old[places] = lips
        old[free[: len(rest)]] = rest
        new = np.empty(len(self.order), np.int64)
        new[old[old >= 0]] = np.flatnonzero(old >= 0)
        return OfficialHead(self.head, np.where(old < 0, -1, self.order[old]), new[self.faces])

    def vertices(self, values: FloatArray) -> FloatArray:
        """Values per vertex, in their order; 0 for vertices without a counterpart."""
        taken = np.asarray(values)[np.maximum(self.order, 0)]
        taken[self.order < 0] = 0
        return taken

    def write(self, folder: Path) -> None:
        """Write the four files below the program's working directory."""
        model = self.model()
        write_bytes(folder / MODEL_FILE, pickled(model))
        write_bytes(folder / MASKS_FILE, pickled({name: self.region(name) for name in MASKS}))
        write_text(folder / TEMPLATE_FILE, obj_text(model["v_template"], self.faces))
        write_landmarks(folder / LANDMARKS_FILE, {"full_lmk": (1, LANDMARKS)})

    def model(self, offset: FloatArray | None = None) -> dict[str, np.ndarray]:
        """The arrays of FLAME's file by their names; ``offset`` (V, 3), of the clip's head, is added to the template."""
        head, weights = self.head, self.vertices(self.head.skinning_weights).astype(np.float64)
        weights[self.order < 0, 0] = 1.0
        parents = np.maximum(head.parents, 0)
        template = head.template if offset is None else head.template + offset
        return {
            "v_template": self.vertices(template).astype(np.float64),
            "f": self.faces.astype(np.uint32),
            "shapedirs": np.concatenate(
                [
                    padded(self.vertices(head.shape_basis), FLAME_IDENTITY_SIZE),
                    padded(self.vertices(head.expression_basis), EXPRESSION_SIZE),
                ],
                axis=2,
            ).astype(np.float32),
            "posedirs": self.vertices(head.pose_basis).astype(np.float64),
            "J_regressor": self.vertices(head.joint_regressor.T).T.astype(np.float64),
            "kintree_table": np.stack([parents, np.arange(len(parents))]).astype(np.int64),
            "weights": weights,
        }

    def write_eyelids(self, left: Path, right: Path) -> None:
        """Write the eyelid bases (V', 3), metres; zeros for a head without them."""
        basis = head_arrays(self.head).eyelid_basis
        for side, path in enumerate((left, right)):
            values = np.zeros((len(self.head.template), 3)) if basis is None else basis[:, :, side]
            write_npy(path, self.vertices(values).astype(np.float64))

    def region(self, name: str) -> IntArray:
        """Vertices of a region in their order; none for one that the head lacks."""
        return np.flatnonzero(np.isin(self.order, self.head.regions.get(name, []))).astype(np.int64)


@dataclass(frozen=True, eq=False)
class OfficialTracking:
    """Tracked parameters of one subject for their code."""

    head: OfficialHead
    shape: FloatArray
    static_offset: FloatArray

    def write(self, path: Path, pose: HeadPose) -> None:
        """Write the parameters of one timestep."""
        save_npz(path, self.parameters(pose))

    def parameters(self, pose: HeadPose) -> dict[str, np.ndarray]:
        """Parameters of one timestep, padded: ``shape`` (300,), ``static_offset`` (1, V, 3), all others with one row."""
        version = self.head.head.version
        if pose.head_model != version:
            raise InputError("pose", "head_model", repr(version), repr(pose.head_model))
        values = {k: v for k, v in pose_to_parameters(pose).items() if k != "eyelids"}
        values["expr"] = padded(values["expr"], EXPRESSION_SIZE)
        shape = padded(np.asarray(self.shape, np.float32)[None], FLAME_IDENTITY_SIZE)[0]
        offset = self.head.vertices(np.asarray(self.static_offset, np.float32))[None]
        return {**values, "shape": shape, "static_offset": offset}


def obj_text(vertices: FloatArray, faces: IntArray) -> str:
    """A mesh as an OBJ file, with one texture coordinate for all corners because it is never drawn."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices]
    lines += ["vt 0 0", *("f {}/1 {}/1 {}/1".format(*face) for face in np.asarray(faces) + 1)]
    return "\n".join(lines) + "\n"


def write_landmarks(path: Path, sizes: Mapping[str, tuple[int, ...]]) -> None:
    """Write landmarks, which the code loads and never uses, all on the first triangle.

    ``sizes`` is their number by prefix. A structured array is read like the dictionary of FLAME's own file.
    """
    fields = []
    for name, size in sizes.items():
        fields += [(f"{name}_faces_idx", "<i8", size), (f"{name}_bary_coords", "<f4", (*size, 3))]
    landmarks = np.zeros((), dtype=fields)
    for name in sizes:
        landmarks[f"{name}_bary_coords"] = 1 / 3
    write_npy(path, landmarks)


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an array as npy atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)


def pickled(arrays: Mapping[str, np.ndarray | SparseMatrix]) -> bytes:
    """Arrays by name as a pickle that every version of numpy can read: it only calls ``numpy.ndarray``."""
    from io import BytesIO

    stream = BytesIO()
    ArrayPickler(stream, protocol=4).dump(dict(arrays))
    return stream.getvalue()


class SparseMatrix:
    """A matrix that is pickled as a ``scipy.sparse.csc_matrix``, which FLAME's file has.

    Pickles by SciPy itself name a module that differs between its versions.
    """

    def __init__(self, dense: FloatArray):
        self.dense = dense

    def __reduce__(self) -> tuple[Any, ...]:
        return operator.methodcaller("csc_matrix", self.dense), (_ModuleReference("scipy.sparse"),)


class _ModuleReference:
    """A reference to a module, imported when the pickle is read."""

    def __init__(self, name: str):
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return importlib.import_module, (self.name,)


class ArrayPickler(pickle.Pickler):
    """Writes an array as a call of its class with shape, type and bytes.

    Pickles by numpy itself name a module that moved with version 2, which older versions cannot find.
    """

    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return NotImplemented
        contiguous = np.ascontiguousarray(value)
        return np.ndarray, (value.shape, value.dtype.str, bytearray(contiguous.tobytes()))


def padded(values: FloatArray, size: int) -> FloatArray:
    """Zeros appended along the last axis."""
    missing = size - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)])


def _their_rings(checkout: Path) -> tuple[IntArray, IntArray]:
    """Indices of the upper and lower lip vertices to which their source attaches teeth."""
    rings = []
    for name in RING_REGIONS:
        pattern = rf'"{name}",\s*torch\.tensor\(\[\s*([\d,\s]+?),?\s*\]\)'
        numbers = find_constant(checkout, SOURCE, pattern, name)
        rings.append(np.array([int(number) for number in numbers.split(",")]))
    return rings[0], rings[1]


def _same_faces(faces: IntArray, template: Path) -> bool:
    """Whether the triangles are those of the template in the checkout; False if there is none."""
    if not template.is_file():
        return False
    return bool(np.array_equal(read_obj(template)[1], faces))


def read_obj(path: Path) -> tuple[int, IntArray]:
    """Number of vertices of an OBJ file, and its triangles (F, 3), numbered from 0; other faces are left out."""
    text = read_bytes(path, "an OBJ file").decode(errors="replace")
    corners = re.findall(r"^f\s+(\d+)\S*\s+(\d+)\S*\s+(\d+)\S*\s*$", text, re.MULTILINE)
    return len(re.findall(r"^v\s", text, re.MULTILINE)), np.array(corners, np.int64).reshape(-1, 3) - 1
