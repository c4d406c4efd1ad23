"""Load a head model from a FLAME pickle, headbench's npz, or the folder of ICT-FaceKit.

Formats read:

- FLAME 2020 and 2023 (`generic_model.pkl`, `flame2023.pkl`). Written by the authors of FLAME (flame.is.tue.mpg.de; licensed).
  Not checked on a file of the program.
- FLAME 2023 Open (`flame2023_Open.pkl`, in some archives `flame2023.pkl`). Written by the authors of FLAME (CC BY 4.0, after
  registration). Not checked on a file of the program.
- FLAME's masks (`FLAME_masks.pkl`). Written by the authors of FLAME (after registration). Not checked on a file of the program.
- Texture coordinates (`head_template_mesh.obj`, `head_template.obj`). Written by the authors of FLAME. Checked on
  ShenhanQian/VHAP@4b64ab7d `asset/flame/head_template_mesh.obj` and yfeng95/DECA@a11554ae `data/head_template.obj`, whose
  triangles agree.
- Eyelid bases (`l_eyelid.npy`, `r_eyelid.npy`). Written by Zielon/metrical-tracker, also in georgeretsi/smirk. Checked on
  Zielon/metrical-tracker@c2a51722 `flame/blendshapes/l_eyelid.npy`.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_npy, read_npz, read_pickle
from ...bench.io.documents import read_json, read_text
from ...bench.io.files import open_regular, reading
from .arrays import RING_REGIONS, HeadArrays, head_of, with_derived_regions

CHART_FILES = ("head_template_mesh.obj", "head_template.obj")
"""FLAME's mesh with texture coordinates, as VHAP and GaussianAvatars, and DECA, name it."""


def read_chart(path: Path, faces: IntArray) -> FloatArray:
    """Texture coordinates of the corners of triangles, (F, 3, 2) float32.

    The OBJ file may order the triangles differently, begin each at another corner, and contain additional ones.

    ``faces``: (F, 3) triangles of the head model.
    """
    text = read_text(path, "mesh")
    with reading(path, "an OBJ mesh of triangles with texture coordinates"):
        rows = [row for row in map(str.split, text.splitlines()) if row[:1] in (["vt"], ["f"])]
        coordinates = np.array([row[1:3] for row in rows if row[0] == "vt"], np.float64)
        corners = [[corner.split("/")[:2] for corner in row[1:]] for row in rows if row[0] == "f"]
        indices = np.array(corners, np.int64) - 1
        if indices.shape[1:] != (3, 2) or indices.min() < 0:
            raise ValueError("no triangles, or indices below 1")
        check_numbers(path, "vt", coordinates, MAX_MAGNITUDE)
        given, uv = indices[:, :, 0], coordinates[indices[:, :, 1]]
    order, wanted = np.argsort(given, axis=1), np.argsort(faces, axis=1)
    known, known_order = np.unique(np.take_along_axis(given, order, 1), axis=0, return_index=True)
    places = {tuple(corners): row for corners, row in zip(known.tolist(), known_order.tolist())}
    found = [places.get(tuple(corners), -1) for corners in np.take_along_axis(faces, wanted, 1).tolist()]
    if -1 in found:
        expected = "the triangles of the head model"
        raise InputError(path, "f", expected, f"{found.count(-1)} of {len(faces)} that are not there")
    result = np.empty((len(faces), 3, 2), np.float32)
    by_vertex = np.take_along_axis(uv[found], order[found][:, :, None], 1)
    np.put_along_axis(result, wanted[:, :, None], by_vertex, 1)
    return result


FLAME_IDENTITY_SIZE = 300
"""Number of columns of FLAME's ``shapedirs`` for identity; the remaining ones are expression."""

_ZIP = b"PK\x03\x04"


MASKS_FILE, REGIONS_FILE = "FLAME_masks.pkl", "regions.json"
EYELID_FILES = ("l_eyelid.npy", "r_eyelid.npy")
EYELIDS_REMEDY = f"Put {' and '.join(EYELID_FILES)} of Metrical Tracker or SMIRK beside the head model."
PLACES = (".", "FLAME_masks", "..", "../FLAME_masks")
"""Folders in which files of a FLAME pickle are searched, relative to the pickle: beside it, as in the repositories of
VHAP and GaussianAvatars, or one folder above, as in SMIRK."""


def load_head(
    path: str | PathLike[str],
    *,
    masks: str | PathLike[str] | None = None,
    regions: str | PathLike[str] | None = None,
    eyelids: str | PathLike[str] | None = None,
    chart: str | PathLike[str] | None = None,
    version: str | None = None,
) -> HeadArrays:
    """Load a head model. The format is detected from the content.

    Files that belong to a FLAME pickle and are not given are searched for in `PLACES` under their usual names,
    ``FLAME_masks.pkl``, ``l_eyelid.npy`` and ``r_eyelid.npy``, ``head_template_mesh.obj`` or ``head_template.obj``, and
    ``regions.json`` beside the pickle.

    Parameters
    ----------
    path : str | PathLike[str]
        FLAME pickle (2020: ``generic_model.pkl``, 2023: ``flame2023.pkl``, 2023 Open by its content),
        npz written by `save_head`, or ICT-FaceKit's folder ``FaceXModel`` or an npz of its arrays.
    masks : str | PathLike[str] | None
        ``FLAME_masks.pkl``, for a FLAME pickle; the derived regions are added.
    regions : str | PathLike[str] | None
        JSON file ``{name: [vertex, ...]}`` with further regions, such as the lip rings.
    eyelids : str | PathLike[str] | None
        Folder of ``l_eyelid.npy`` and ``r_eyelid.npy`` (or one of these), (V, 3) metres by which a
        closed lid moves, as Metrical Tracker and SMIRK ship them.
    chart : str | PathLike[str] | None
        OBJ file of the mesh with texture coordinates.
    version : str | None
        Name of the expression basis. Required if the file name of a FLAME pickle does not contain it
        ("flame2020", "flame2023"); must agree with the version in an npz of this package, and with the content of
        FLAME 2023 Open ("flame2023_open").
    """
    path = Path(path)
    start = _ZIP  # also of the folder of ICT-FaceKit
    if not path.is_dir():
        with open_regular(path, "a head model file") as stream:
            start = stream.read(len(_ZIP))
    if start == _ZIP:
        content = None if path.is_dir() else read_npz(path)
        if content is None or "v_neutral" in content:
            from .ict import ict_head, read_ict  # slow to import

            head = ict_head(path, read_ict(path) if content is None else content)
        else:
            head = head_of(path, content)
        if version is not None and version != head.version:
            raise InputError(path, "version", repr(version), repr(head.version))
    elif start[:1] not in _PICKLES or path.suffix.lower() in MESHES:
        expected = "a head model with its bases: a FLAME pickle, or an npz file"
        if path.suffix.lower() in MESHES:
            raise InputError(path, "", expected, "a mesh", "A mesh alone has no expressions and no joints.")
        raise InputError(
            path, "", expected, f"a file that starts with {start!r}" if start else "an empty file"
        )
    else:
        head = _flame(path, version)
        masks = masks or _beside(path, MASKS_FILE)
        regions_file = path.with_name(REGIONS_FILE)  # a common file name
        regions = regions or (regions_file if regions_file.is_file() else None)
        lid = next(filter(None, (_beside(path, name) for name in EYELID_FILES)), None)
        eyelids = eyelids or (lid.parent if lid else None)
        chart = chart or next(filter(None, (_beside(path, name) for name in CHART_FILES)), None)
    if masks is not None:
        head = replace(head, regions={**head.regions, **read_masks(masks)})
    if regions is not None:
        head = replace(head, regions={**head.regions, **read_regions(regions)})
    if chart is not None:
        head = replace(head, uv=read_chart(Path(chart), head.faces))
    if masks is not None or regions is not None:
        head.validate(regions or masks or path)
    if eyelids is not None:
        folder = Path(eyelids)
        head = _with_eyelids(head, folder.parent if folder.is_file() else folder, path)
    return with_derived_regions(head)


_PICKLES = (b"\x80", b"(", b"}", b"c", b"]")
"""First bytes of pickles, by protocol and content."""
MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".fbx")


def _beside(path: Path, name: str) -> Path | None:
    """A file that belongs to a FLAME pickle, or None."""
    folders = dict.fromkeys(
        (path.parent, path.resolve().parent)
    )  # the folder of a symbolic link, then that of its target
    files = (folder / place / name for folder in folders for place in PLACES)
    return next(filter(Path.is_file, files), None)


def _with_eyelids(head: HeadArrays, folder: Path, file: Path) -> HeadArrays:
    """The head with the eyelid basis of a folder."""
    files = [folder / name for name in EYELID_FILES]
    bases = [read_npy(path) for path in files]
    for path, basis in zip(files, bases):
        if basis.shape != head.template.shape or basis.dtype.kind != "f":
            expected = f"floats of shape {head.template.shape}, those of {file.name}"
            raise InputError(path, "", expected, f"{basis.dtype} of shape {basis.shape}")
    return replace(head, eyelid_basis=np.stack(bases, axis=2)).validate(folder)


OPEN, OPEN_KEY = "flame2023_open", "supr_expression_metadata"
"""FLAME 2023 Open (CC BY 4.0) and the key that its pickle alone has. Its template, identities and expressions, which are
SUPR's, differ from those of FLAME 2023, although its archive calls the file ``flame2023.pkl``, too."""


def flame_version(path: Path) -> str:
    """Version of a FLAME pickle by its usual file or folder name, such as ``FLAME2020/male_model.pkl``."""
    stem = path.stem.lower().replace("-", "_")
    folder = re.fullmatch("flame[-_ ]?(2020|2023)", path.parent.name.lower())
    years = set(re.findall(r"(?<!\d)(2020|2023)(?!\d)", stem))
    if stem == "generic_model":
        years.add("2020")
    if folder and (not years or stem == "generic_model"):
        years.add(folder[1])
    if years == {"2023"}:
        return "flame2023_no_jaw" if "no_jaw" in stem else "flame2023"
    if years == {"2020"}:
        return "flame2020"
    expected = "a name with FLAME's version (generic_model.pkl, flame2020.pkl, flame2023.pkl)"
    found = path.name if not folder else f"{path.parent.name}/{path.name}"
    remedy = "Rename the file, or set version='flame2020' or 'flame2023' in Python. Their coefficients are not interchangeable."
    raise InputError(path, "version", expected, repr(found), remedy)


def _content_version(path: Path, content: Mapping[str, Any], stated: str | None) -> str:
    """Version of a FLAME pickle by its content, else as stated, else by its name."""
    if OPEN_KEY not in content:
        return stated or flame_version(path)
    if stated not in (None, OPEN):
        remedy = f"The key {OPEN_KEY} is that of FLAME 2023 Open, a model with coefficients of its own."
        raise InputError(path, "version", repr(stated), repr(OPEN), remedy)
    return OPEN


def read_masks(path: str | PathLike[str]) -> dict[str, IntArray]:
    """Regions of a ``FLAME_masks.pkl``: sorted, unique vertex indices by name."""
    return {name: _members(path, name, members) for name, members in read_pickle(path).items()}


def read_regions(path: str | PathLike[str]) -> dict[str, IntArray]:
    """Regions of a JSON file ``{name: [vertex, ...]}``. Lip rings keep their order, others are sorted."""
    result = {}
    for name, members in read_json(Path(path)).items():
        if not isinstance(members, list) or not all(type(m) is int and 0 <= m < 2**31 for m in members):
            raise InputError(path, name, "a list of vertex indices", reprlib.repr(members))
        result[name] = _members(path, name, np.array(members, dtype=np.int64))
    return result


def _members(path: str | PathLike[str], name: str, members: Any) -> IntArray:
    if not isinstance(members, np.ndarray) or members.ndim != 1 or members.dtype.kind not in "iu":
        raise InputError(path, name, "an array of vertex indices", f"{type(members).__name__}")
    members = members.astype(np.int64)
    return members if name in RING_REGIONS else np.unique(members)


def _flame(path: Path, stated: str | None) -> HeadArrays:
    content = read_pickle(path)
    version = _content_version(path, content, stated)

    def array(name: str, kinds: str, ndim: int) -> np.ndarray:
        values = content.get(name)
        if not isinstance(values, np.ndarray):
            found = f"only {', '.join(sorted(content)) or 'nothing'}"
            raise InputError(path, name, "an array of that name", found)
        if values.dtype.kind not in kinds or values.ndim != ndim:
            expected = f"{ndim} dimensions of {'integers' if 'i' in kinds else 'floats'}"
            raise InputError(path, name, expected, f"{values.ndim} of {values.dtype}")
        return values

    directions = array("shapedirs", "f", 3)
    if directions.shape[2] <= FLAME_IDENTITY_SIZE:
        expected = f"{FLAME_IDENTITY_SIZE} identity directions and then those of expression"
        raise InputError(path, "shapedirs", expected, f"{directions.shape[2]} directions in all")
    tree = array("kintree_table", "iu", 2)
    if not len(tree):
        raise InputError(path, "kintree_table", "a row of parents", "none")
    parents = tree[0].astype(np.int64)
    parents[:1] = -1  # the file has -1 as an unsigned number there
    return HeadArrays(
        version=version,
        template=array("v_template", "f", 2),
        faces=array("f", "iu", 2).astype(np.int64),
        shape_basis=directions[:, :, :FLAME_IDENTITY_SIZE],
        expression_basis=directions[:, :, FLAME_IDENTITY_SIZE:],
        pose_basis=array("posedirs", "f", 3),
        joint_regressor=array("J_regressor", "f", 2),
        skinning_weights=array("weights", "f", 2),
        parents=parents,
    ).validate(path)
