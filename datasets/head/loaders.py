"""Load a head model from what it comes as: a FLAME pickle, our npz, or ICT-FaceKit's."""

from __future__ import annotations

import reprlib
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import read_npz
from ...bench.io.documents import read_json
from .arrays import RING_REGIONS, HeadArrays, read_head, with_derived_regions
from .ict import ict_head, is_ict
from .unpickle import read_pickle

FLAME_IDENTITY_SIZE = 300
"""Columns of FLAME's ``shapedirs`` that span identity; those after them span expression."""

_ZIP = b"PK\x03\x04"


def load_head(
    path: str | PathLike[str],
    *,
    masks: str | PathLike[str] | None = None,
    regions: str | PathLike[str] | None = None,
    version: str | None = None,
) -> HeadArrays:
    """Load a head model; what the file is follows from its content.

    Parameters
    ----------
    path : FLAME pickle (2020: ``generic_model.pkl``, 2023: ``flame2023.pkl``), npz written by `save_head`,
        or ICT-FaceKit npz.
    masks : ``FLAME_masks.pkl``, for a FLAME pickle; the derived regions are added.
    regions : JSON file ``{name: [vertex, ...]}`` with further regions, such as the lip rings.
    version : names the expression basis. Needed where the file name of a FLAME pickle does not tell
        ("flame2020", "flame2023"); must agree with what a npz of ours says.

    Raises
    ------
    InputError
        Where a file is missing, damaged or of no known kind, or holds arrays that make no head.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            start = stream.read(len(_ZIP))
    except OSError as error:
        raise InputError(path, "", "a head model file", error.strerror or "nothing readable") from error
    if start != _ZIP:
        head = _flame(path, version or flame_version(path))
    else:
        content = read_npz(path)
        head = ict_head(path, content) if is_ict(content) else read_head(path)
        if version is not None and version != head.version:
            raise InputError(path, "version", repr(version), repr(head.version))
    if masks is not None:
        head = replace(head, regions={**head.regions, **read_masks(masks)})
    if regions is not None:
        head = replace(head, regions={**head.regions, **read_regions(regions)})
    if masks is not None or regions is not None:
        head.validate(regions or masks or path)
    return with_derived_regions(head)


def flame_version(path: Path) -> str:
    """Version of a FLAME pickle by its usual file name.

    Raises
    ------
    InputError
        Where the name leaves it open: the two files have the same layout, and confusing them goes unnoticed.
    """
    name = path.stem.lower().replace("-", "_")
    if "2023" in name:
        return "flame2023_no_jaw" if "no_jaw" in name else "flame2023"
    if "2020" in name or name == "generic_model":
        return "flame2020"
    expected = "a file name with FLAME's version (generic_model.pkl, flame2020.pkl, flame2023.pkl)"
    remedy = (
        "Say which it is: version='flame2020' or 'flame2023'. Their coefficients are not interchangeable."
    )
    raise InputError(path, "version", expected, repr(path.name), remedy)


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


def _flame(path: Path, version: str) -> HeadArrays:
    content = read_pickle(path)

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
    parents[:1] = -1  # the file has an unsigned -1 there
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
