"""A head model in FLAME's layout as plain arrays, validated and stored as an npz."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, check_arrays, read_npz
from ...bench.io.files import atomic_path, digest
from .geometry import triangle_areas

if TYPE_CHECKING:
    from ...bench.expressions import Expression

JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
"""Joint order of the layout; every pose argument of the model refers to it."""

RING_REGIONS = ("lip_outside_ring_upper", "lip_outside_ring_lower")
"""Regions with ordered vertices, in sequence along the ring. All others are sorted."""

FORMAT = "headbench-head-1"
WEIGHT_TOLERANCE = 1e-4

MAX_EXTENT, MAX_AREA = 10.0, 100.0
"""Maximum extent and area of an unposed head, metres and square metres; a head with shoulders has 1 and 2. Distant
vertices or large triangles would take the time and memory of thousands of heads when a mesh is drawn."""

_ARRAYS = ("template", "faces", "shape_basis", "expression_basis", "pose_basis", "joint_regressor")
STORED = (*_ARRAYS, "skinning_weights", "parents")
_MEMBERS = {
    "template": Member("f", ("V", 3), MAX_MAGNITUDE),
    "faces": Member("iu", ("F", 3)),
    "shape_basis": Member("f", ("V", 3, "S"), MAX_MAGNITUDE),
    "expression_basis": Member("f", ("V", 3, "E"), MAX_MAGNITUDE),
    "pose_basis": Member("f", ("V", 3, "9 (J - 1)"), MAX_MAGNITUDE),
    "joint_regressor": Member("f", ("J", "V"), MAX_MAGNITUDE),
    "skinning_weights": Member("f", ("V", "J"), MAX_MAGNITUDE),
    "parents": Member("iu", ("J",)),
    "eyelid_basis": Member("f", ("V", 3, 2), MAX_MAGNITUDE, optional=True),
    "uv": Member("f", ("F", 3, 2), MAX_MAGNITUDE, optional=True),
}
OPTIONAL = ("eyelid_basis", "uv")
"""Optional arrays of a head."""


@dataclass(frozen=True, eq=False)
class HeadArrays:
    """A head model in FLAME's layout (a `HeadAsset`). Units: metres. V vertices, F triangles, S identity and E
    expression directions, J joints in the order of `JOINT_NAMES`."""

    version: str
    """Name of the expression basis, equal to ``HeadPose.head_model`` of its poses."""
    template: FloatArray
    """(V, 3) mean head."""
    faces: IntArray
    """(F, 3) int64 triangles, counter-clockwise seen from outside."""
    shape_basis: FloatArray
    expression_basis: FloatArray
    """(V, 3, S), (V, 3, E) metres per unit coefficient."""
    pose_basis: FloatArray
    """(V, 3, 9 (J-1)); column 9(j-1)+3r+c belongs to (R_j - I)[r, c]."""
    joint_regressor: FloatArray
    """(J, V) dense; joints come from the shaped mesh."""
    skinning_weights: FloatArray
    """(V, J), rows sum to 1."""
    parents: IntArray
    """(J,), the root has -1 and every joint comes after its parent."""
    eyelid_basis: FloatArray | None = None
    """(V, 3, 2) left and right, added after skinning and rotated with root and neck; None if the model has none."""
    regions: Mapping[str, IntArray] = field(default_factory=dict)
    """Vertex indices by name, unique; sorted except for `RING_REGIONS`."""
    landmarks: Mapping[str, int] = field(default_factory=dict)
    """Vertex index by name; may be empty."""
    expression_names: tuple[str, ...] = ()
    """Names of the expression directions, in order; () if they have none."""
    uv: FloatArray | None = None
    """(F, 3, 2) texture coordinates of the triangles' corners, in [0, 1] inside the chart; None if the model has no
    chart."""

    def validate(self, file: str | PathLike[str]) -> HeadArrays:
        """Validate the model and return self. ``file``: Source of the arrays, named in the error."""
        arrays = {name: np.asarray(getattr(self, name)) for name in STORED} | self._optional()
        sizes = {"J": len(JOINT_NAMES), "9 (J - 1)": 9 * (len(JOINT_NAMES) - 1)}
        sizes = check_arrays(file, arrays, _MEMBERS, sizes)
        if self.expression_names and len(self.expression_names) != sizes["E"]:
            expected = f"as many names as expression directions, {sizes['E']}"
            raise InputError(file, "expression_names", expected, str(len(self.expression_names)))
        if sizes["V"] == 0 or sizes["F"] == 0:
            raise InputError(file, "template", "at least one vertex and one triangle", "an empty mesh")
        sums = self.skinning_weights.sum(axis=1, dtype=np.float64)
        worst = int(np.argmax(np.abs(sums - 1)))
        if abs(sums[worst] - 1) > WEIGHT_TOLERANCE:
            expected = f"rows that sum to 1 within {WEIGHT_TOLERANCE:g}"
            found = f"a sum of {sums[worst]:.6g} at vertex {worst}"
            raise InputError(file, "skinning_weights", expected, found)
        self._validate_indices(file)
        parents = [int(parent) for parent in self.parents]
        if parents[0] != -1 or not all(0 <= p < joint for joint, p in enumerate(parents[1:], start=1)):
            expected = "a tree: -1 for joint 0, then a parent that comes before its joint"
            raise InputError(file, "parents", expected, str(parents))
        check_size(file, "template", self.template, self.faces)
        return self

    def __call__(
        self, pose: HeadPose, shape: FloatArray | None = None, static_offset: FloatArray | None = None
    ) -> FloatArray:
        """Vertices (V, 3) in a pose, metres, float64. ``shape``: (S,) identity coefficients; None for the mean head.
        ``static_offset``: (V, 3) metres, added to the shaped template."""
        from .model import PosedSubject  # with torch

        shape = np.zeros(self.shape_basis.shape[2]) if shape is None else shape
        offset = np.zeros(self.template.shape) if static_offset is None else static_offset
        return PosedSubject(self, shape, offset).meshes([pose])[0]

    def named_expressions(self) -> list[Expression]:
        """Named expressions of the model; none for models like FLAME."""
        from .procedural.versions import named_expressions  # imported here because few callers need it

        return named_expressions(self.version, self.expression_names, self.expression_basis.shape[2])

    def fingerprint(self) -> str:
        """Hex digest of the content: version, all arrays, regions and landmarks."""
        arrays = [np.asarray(getattr(self, name)) for name in STORED]
        arrays += self._optional().values()
        regions = [part for name in sorted(self.regions) for part in (name, self.regions[name])]
        return digest(self.version, *arrays, *regions, dict(sorted(self.landmarks.items())))

    def _optional(self) -> dict[str, FloatArray]:
        """Existing `OPTIONAL` arrays by name."""
        given = ((name, getattr(self, name)) for name in OPTIONAL)
        return {name: values for name, values in given if values is not None}

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


def check_size(file: str | PathLike[str], key: str, vertices: FloatArray, faces: IntArray) -> None:
    """Raise `InputError` unless a mesh, (V, 3) metres, has an area, and extents and area within their bounds."""
    vertices = np.asarray(vertices, np.float64)
    extent = float(np.abs(vertices).max())
    if not extent <= MAX_EXTENT:
        raise InputError(file, key, f"a head within {MAX_EXTENT:g} m of its origin", f"{extent:g} m")
    area = float(triangle_areas(vertices, faces).sum())
    if not 0 < area <= MAX_AREA:
        expected = f"a surface of at most {MAX_AREA:g} square metres, not of none"
        raise InputError(file, key, expected, f"{area:g}")


def _check_indices(file: str | PathLike[str], key: str, indices: IntArray, count: int) -> None:
    if indices.dtype.kind not in "iu":
        raise InputError(file, key, "integer vertex indices", f"dtype {indices.dtype}")
    if indices.size and not (0 <= int(indices.min()) and int(indices.max()) < count):
        found = f"indices from {indices.min()} to {indices.max()}"
        raise InputError(file, key, f"vertex indices from 0 to {count - 1}", found)


_FILE = {
    **dict.fromkeys(STORED, Member("biufU")),
    "version": TEXT,
    "landmark_names": Member("U", ("L",)),
    "landmark_vertices": Member("iu", ("L",)),
    "expression_names": Member("U", ("E",), optional=True),
}


def save_head(path: Path, arrays: HeadArrays) -> None:
    """Write a head atomically as one npz file without pickled objects.

    Members: ``format``, ``version``, the array fields by name, existing `OPTIONAL` arrays,
    ``region/<name>`` for each region, ``landmark_names`` and ``landmark_vertices``, ``expression_names`` if there are any.
    Equal heads give equal bytes: the file is uncompressed because compression depends on the library's version.
    """
    content: dict[str, np.ndarray] = {"format": np.array(FORMAT), "version": np.array(arrays.version)}
    content |= {name: np.asarray(getattr(arrays, name)) for name in STORED}
    content |= arrays._optional()
    content |= {f"region/{name}": members for name, members in arrays.regions.items()}
    content["landmark_names"] = np.array(list(arrays.landmarks), dtype=np.str_)
    content["landmark_vertices"] = np.array(list(arrays.landmarks.values()), dtype=np.int64)
    if arrays.expression_names:
        content["expression_names"] = np.array(arrays.expression_names, dtype=np.str_)
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **content)


def read_head(path: Path) -> HeadArrays:
    """Read what `save_head` wrote, validated."""
    return head_of(path, read_npz(path))


def head_of(path: Path, content: Mapping[str, np.ndarray]) -> HeadArrays:
    """The head of the members of a file that `save_head` wrote, validated."""
    check_arrays(path, content, {"format": TEXT})
    if str(content["format"]) != FORMAT:
        raise InputError(path, "format", repr(FORMAT), repr(str(content["format"]))[:80])
    check_arrays(path, content, _FILE)
    regions = {
        key.removeprefix("region/"): value for key, value in content.items() if key.startswith("region/")
    }
    names, vertices = content["landmark_names"], content["landmark_vertices"]
    return HeadArrays(
        version=str(content["version"]),
        **{name: content[name] for name in (*STORED, *OPTIONAL) if name in content},
        regions=regions,
        landmarks={str(name): int(vertex) for name, vertex in zip(names, vertices)},
        expression_names=tuple(map(str, content.get("expression_names", ()))),
    ).validate(path)


def with_derived_regions(head: HeadArrays) -> HeadArrays:
    """The head with additional regions derived from existing ones, as VHAP does for ``FLAME_masks.pkl``.

    * ``hair`` = scalp - (face and neck), if the regions scalp, face and neck exist;
    * ``ears``, ``eyeballs`` = left and right together;
    * ``left_eye``, ``right_eye`` = eye region and eyeball of the side;
    * ``skin`` = everything but eyeballs, hair, lips, teeth and the boundary.

    Regions are derived only if all inputs exist and they are not given already; those that VHAP defines as vertex
    lists (irises, lip rings, ...) cannot be derived.
    """
    regions = dict(head.regions)

    def add(name: str, inputs: tuple[str, ...], members: IntArray) -> None:
        if name not in regions and all(source in regions for source in inputs):
            regions[name] = np.unique(members)

    def union(*names: str) -> IntArray:
        return np.concatenate([np.empty(0, np.int64), *(regions[name] for name in names if name in regions)])

    for name, parts in (
        ("ears", ("left_ear", "right_ear")),
        ("eyeballs", ("left_eyeball", "right_eyeball")),
        ("left_eye", ("left_eye_region", "left_eyeball")),
        ("right_eye", ("right_eye_region", "right_eyeball")),
    ):
        add(name, parts, union(*parts))
    add("hair", ("scalp", "face", "neck"), np.setdiff1d(union("scalp"), union("face", "neck")))
    bare = union("eyeballs", "hair", "lips", "teeth", "boundary")
    add("skin", ("eyeballs", "hair", "lips"), np.setdiff1d(np.arange(len(head.template)), bare))
    return replace(head, regions=regions)


def region(head: HeadAsset, name: str) -> IntArray:
    """Vertices of a region."""
    if not len(head.regions.get(name, ())):
        known = ", ".join(sorted(head.regions)) or "none"
        remedy = "For a FLAME pickle, give FLAME_masks.pkl as masks=."
        where = f"head model {head.version!r}"
        raise InputError(where, f"regions[{name}]", "the vertices of that region", f"regions {known}", remedy)
    return np.asarray(head.regions[name])


def faces_in_region(asset: HeadAsset, name: str) -> IntArray:
    """Indices of the triangles whose three vertices are all in the region, ascending."""
    if name not in asset.regions:
        known = ", ".join(sorted(asset.regions)) or "no regions"
        raise InputError(f"head model {asset.version!r}", "regions", f"a region {name!r}", known)
    inside = np.zeros(asset.template.shape[0], dtype=bool)
    inside[asset.regions[name]] = True
    return np.flatnonzero(inside[asset.faces].all(axis=1))


_in_memory: WeakValueDictionary[str, HeadArrays] = WeakValueDictionary()


def in_memory(head: HeadArrays, fingerprint: str) -> HeadArrays:
    """Deduplicate: the head with the same fingerprint that is already in memory, else ``head``."""
    return _in_memory.setdefault(fingerprint, head)
