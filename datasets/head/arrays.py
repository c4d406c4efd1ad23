"""A head model in FLAME's layout as plain arrays, checked once and stored as an npz."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.files import atomic_path, digest

JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
"""Joint order of the layout; every pose argument of the model refers to it."""

RING_REGIONS = ("lip_outside_ring_upper", "lip_outside_ring_lower")
"""Regions whose order means something: vertices in sequence along the ring. All others are sorted."""

FORMAT = "headbench-head-1"
WEIGHT_TOLERANCE = 1e-4

MAX_BYTES = 4 * 2**30
"""Most an npz may hold unpacked: tracked parameters of ten thousand timesteps, and ten times any head model."""

_ARRAYS = ("template", "faces", "shape_basis", "expression_basis", "pose_basis", "joint_regressor")
_STORED = (*_ARRAYS, "skinning_weights", "parents")


@dataclass(frozen=True, eq=False)
class HeadArrays:
    """A head model in FLAME's layout (a `HeadAsset`). Units: metres.

    V vertices, F triangles, S identity and E expression directions, J joints in the order of `JOINT_NAMES`.

    Attributes
    ----------
    version : names the expression basis; poses carry it as ``HeadPose.head_model``.
    template : (V, 3) mean head.
    faces : (F, 3) int64 triangles, counter-clockwise seen from outside.
    shape_basis, expression_basis : (V, 3, S), (V, 3, E) metres per unit coefficient.
    pose_basis : (V, 3, 9 (J-1)); column 9(j-1)+3r+c belongs to (R_j - I)[r, c].
    joint_regressor : (J, V) dense; joints come from the shaped mesh.
    skinning_weights : (V, J), rows sum to 1.
    parents : (J,), the root has -1 and every joint comes after its parent.
    eyelid_basis : (V, 3, 2) left and right, added after skinning and turned with root and neck; None where the
        model has none.
    regions : vertex indices by name, unique; sorted except for `RING_REGIONS`.
    landmarks : vertex index by name; may be empty.
    """

    version: str
    template: FloatArray
    faces: IntArray
    shape_basis: FloatArray
    expression_basis: FloatArray
    pose_basis: FloatArray
    joint_regressor: FloatArray
    skinning_weights: FloatArray
    parents: IntArray
    eyelid_basis: FloatArray | None = None
    regions: Mapping[str, IntArray] = field(default_factory=dict)
    landmarks: Mapping[str, int] = field(default_factory=dict)

    def validate(self, file: str | PathLike[str]) -> HeadArrays:
        """Check everything the model relies on and return self.

        Parameters
        ----------
        file : where the arrays come from; named in the error.

        Raises
        ------
        InputError
            For wrong shapes, non-finite numbers, face or region indices out of range, a joint tree that is
            none, or skinning weights that do not sum to 1.
        """
        self._validate_shapes(file)
        self._validate_numbers(file)
        self._validate_indices(file)
        self._validate_skeleton(file)
        return self

    def fingerprint(self) -> str:
        """Hex digest of the content: version, all arrays, regions and landmarks."""
        arrays = [np.asarray(getattr(self, name)) for name in _STORED]
        if self.eyelid_basis is not None:
            arrays.append(self.eyelid_basis)
        regions = [part for name in sorted(self.regions) for part in (name, self.regions[name])]
        return digest(self.version, *arrays, *regions, dict(sorted(self.landmarks.items())))

    def _validate_shapes(self, file: str | PathLike[str]) -> None:
        joints = len(JOINT_NAMES)
        vertices = self.template.shape[0] if self.template.ndim == 2 else -1
        expected: dict[str, tuple[int | str, ...]] = {
            "template": ("V", 3),
            "faces": ("F", 3),
            "shape_basis": (vertices, 3, "S"),
            "expression_basis": (vertices, 3, "E"),
            "pose_basis": (vertices, 3, 9 * (joints - 1)),
            "joint_regressor": (joints, vertices),
            "skinning_weights": (vertices, joints),
            "parents": (joints,),
        }
        if self.eyelid_basis is not None:
            expected["eyelid_basis"] = (vertices, 3, 2)
        for name, shape in expected.items():
            found = np.asarray(getattr(self, name)).shape
            fits = len(found) == len(shape) and all(
                isinstance(want, str) or want == have for want, have in zip(shape, found)
            )
            if not fits:
                raise InputError(file, name, f"shape ({', '.join(map(str, shape))})", f"shape {found}")
        if vertices == 0 or self.faces.shape[0] == 0:
            raise InputError(file, "template", "at least one vertex and one triangle", "an empty mesh")

    def _validate_numbers(self, file: str | PathLike[str]) -> None:
        names = ["template", "shape_basis", "expression_basis", "pose_basis", "joint_regressor"]
        names += ["skinning_weights"] + ["eyelid_basis"] * (self.eyelid_basis is not None)
        for name in names:
            array = getattr(self, name)
            if array.dtype.kind != "f":
                raise InputError(file, name, "floating-point numbers", f"dtype {array.dtype}")
            broken = int(array.size - np.count_nonzero(np.isfinite(array)))
            if broken:
                raise InputError(file, name, "finite numbers", f"{broken} that are NaN or infinite")
        sums = self.skinning_weights.sum(axis=1, dtype=np.float64)
        worst = int(np.argmax(np.abs(sums - 1)))
        if abs(sums[worst] - 1) > WEIGHT_TOLERANCE:
            raise InputError(
                file,
                "skinning_weights",
                f"rows that sum to 1 within {WEIGHT_TOLERANCE:g}",
                f"a sum of {sums[worst]:.6g} at vertex {worst}",
            )

    def _validate_indices(self, file: str | PathLike[str]) -> None:
        vertices = self.template.shape[0]
        _check_indices(file, "faces", self.faces, vertices)
        for name, members in self.regions.items():
            key = f"regions[{name}]"
            if members.ndim != 1:
                raise InputError(file, key, "a one-dimensional array of vertex indices", f"{members.ndim}-d")
            _check_indices(file, key, members, vertices)
            if len(np.unique(members)) != len(members):
                raise InputError(file, key, "every vertex once", "repeated vertices")
            if name not in RING_REGIONS and np.any(np.diff(members) < 0):
                raise InputError(file, key, "sorted vertex indices", "an unsorted list")
        for name, vertex in self.landmarks.items():
            if not 0 <= vertex < vertices:
                raise InputError(file, f"landmarks[{name}]", f"a vertex below {vertices}", str(vertex))

    def _validate_skeleton(self, file: str | PathLike[str]) -> None:
        if self.parents.dtype.kind not in "iu":
            raise InputError(file, "parents", "integer joint indices", f"dtype {self.parents.dtype}")
        parents = [int(parent) for parent in self.parents]
        is_tree = parents[0] == -1 and all(
            0 <= parent < joint for joint, parent in enumerate(parents) if joint
        )
        if not is_tree:
            raise InputError(
                file,
                "parents",
                "a tree: -1 for joint 0, then a parent that comes before its joint",
                str(parents),
            )


def _check_indices(file: str | PathLike[str], key: str, indices: IntArray, count: int) -> None:
    if indices.dtype.kind not in "iu":
        raise InputError(file, key, "integer vertex indices", f"dtype {indices.dtype}")
    if indices.size and not (0 <= int(indices.min()) and int(indices.max()) < count):
        found = f"indices from {indices.min()} to {indices.max()}"
        raise InputError(file, key, f"vertex indices from 0 to {count - 1}", found)


def save_head(path: Path, arrays: HeadArrays) -> None:
    """Write a head as one npz file (no pickled objects), whole or not at all.

    Members: ``format``, ``version``, the array fields by name, ``eyelid_basis`` if there is one,
    ``region/<name>`` for each region, ``landmark_names`` and ``landmark_vertices``.
    """
    content: dict[str, np.ndarray] = {"format": np.array(FORMAT), "version": np.array(arrays.version)}
    content |= {name: np.asarray(getattr(arrays, name)) for name in _STORED}
    if arrays.eyelid_basis is not None:
        content["eyelid_basis"] = arrays.eyelid_basis
    content |= {f"region/{name}": members for name, members in arrays.regions.items()}
    content["landmark_names"] = np.array(list(arrays.landmarks), dtype=np.str_)
    content["landmark_vertices"] = np.array(list(arrays.landmarks.values()), dtype=np.int64)
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **content)


def read_head(path: Path) -> HeadArrays:
    """Read what `save_head` wrote, validated.

    Raises
    ------
    InputError
        Where the file is not such an npz, lacks a member or holds arrays that make no head.
    """
    content = read_npz(path)
    if str(content.get("format", "")) != FORMAT:
        raise InputError(path, "format", repr(FORMAT), repr(str(content.get("format", "nothing"))))
    missing = [
        name for name in (*_STORED, "version", "landmark_names", "landmark_vertices") if name not in content
    ]
    if missing:
        raise InputError(path, missing[0], "an array of that name", f"only {', '.join(sorted(content))}")
    regions = {
        key.removeprefix("region/"): value for key, value in content.items() if key.startswith("region/")
    }
    names, vertices = content["landmark_names"], content["landmark_vertices"]
    if names.shape != vertices.shape or names.ndim != 1 or vertices.dtype.kind not in "iu":
        raise InputError(
            path, "landmark_vertices", f"one vertex for each of {names.size} names", f"{vertices.shape}"
        )
    return HeadArrays(
        version=str(content["version"]),
        **{name: content[name] for name in _STORED},
        eyelid_basis=content.get("eyelid_basis"),
        regions=regions,
        landmarks={str(name): int(vertex) for name, vertex in zip(names, vertices)},
    ).validate(path)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read every member of an npz without ever unpickling, `MAX_BYTES` in all once unpacked.

    Raises
    ------
    InputError
        Where the file is missing, damaged, too large, no npz, or holds pickled objects.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            # Before anything is unpacked: a few kB of zeros can declare terabytes.
            unpacked = sum(member.file_size for member in archive.zip.infolist())
            if unpacked > MAX_BYTES:
                raise InputError(path, "", f"at most {MAX_BYTES} bytes of arrays", f"{unpacked} bytes")
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise InputError(path, "", "a file", "none") from error
    except InputError:
        raise
    except Exception as error:  # a damaged archive makes zipfile and numpy raise almost anything
        raise InputError(path, "", "an npz file of plain arrays", f"unreadable content ({error})") from error
