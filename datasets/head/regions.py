"""Regions derived from others by set algebra, and the triangles of a region."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...bench.contracts import HeadAsset, IntArray
from ...bench.errors import InputError
from .arrays import HeadArrays


def derived_regions(regions: Mapping[str, IntArray], vertex_count: int) -> dict[str, IntArray]:
    """Regions that follow from those given, as VHAP derives them from ``FLAME_masks.pkl``.

    * ``hair`` = scalp - (face and neck), where scalp, face and neck are known;
    * ``ears``, ``eyeballs`` = left and right together;
    * ``left_eye``, ``right_eye`` = eye region and eyeball of the side;
    * ``skin`` = everything but eyeballs, hair, lips, teeth and the boundary.

    Only regions whose inputs are all there are derived, and none that is given already; the ones that VHAP
    writes out as vertex lists (irises, lip rings, ...) cannot be derived this way.
    """
    known = {name: np.asarray(members, dtype=np.int64) for name, members in regions.items()}
    derived: dict[str, IntArray] = {}

    def add(name: str, inputs: tuple[str, ...], members: IntArray) -> None:
        if name not in regions and all(source in known for source in inputs):
            derived[name] = known[name] = np.unique(members)

    def union(*names: str) -> IntArray:
        return np.concatenate([known.get(name, np.empty(0, np.int64)) for name in names])

    add("ears", ("left_ear", "right_ear"), union("left_ear", "right_ear"))
    add("eyeballs", ("left_eyeball", "right_eyeball"), union("left_eyeball", "right_eyeball"))
    for side in ("left", "right"):
        parts = (f"{side}_eye_region", f"{side}_eyeball")
        add(f"{side}_eye", parts, union(*parts))
    add("hair", ("scalp", "face", "neck"), np.setdiff1d(union("scalp"), union("face", "neck")))
    bare = union("eyeballs", "hair", "lips", "teeth", "boundary")
    add("skin", ("eyeballs", "hair", "lips"), np.setdiff1d(np.arange(vertex_count), bare))
    return derived


def with_derived_regions(arrays: HeadArrays) -> HeadArrays:
    """The same head with `derived_regions` added."""
    derived = derived_regions(arrays.regions, arrays.template.shape[0])
    return replace(arrays, regions={**arrays.regions, **derived})


def faces_in_region(asset: HeadAsset, name: str) -> IntArray:
    """Indices of the triangles whose three vertices are all in the region, ascending.

    Raises
    ------
    InputError
        Where the head has no such region.
    """
    if name not in asset.regions:
        known = ", ".join(sorted(asset.regions)) or "no regions"
        raise InputError(f"head model {asset.version!r}", "regions", f"a region {name!r}", known)
    inside = np.zeros(asset.template.shape[0], dtype=bool)
    inside[asset.regions[name]] = True
    return np.flatnonzero(inside[asset.faces].all(axis=1))
