"""Error of tracked meshes by region of the head."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..bench.contracts import Clip, FloatArray, HeadAsset, IntArray
from ..bench.errors import InputError
from .head.geometry import fit_sphere
from .head.subject import PosedSubject

LID_REACH = 1.25
"""Lids are the skin within this many radii of an eyeball's centre."""


class RegionError(NamedTuple):
    """Root mean square errors of a region over its vertices and all timesteps, millimetres."""

    absolute: float
    """Distance of the vertices."""
    affine: float
    """Distance after the best affine map of the region at each timestep."""
    motion: float
    """Change of the distance over time, in the frame of the head: the error after subtracting each vertex's mean error."""


def error_regions(head: HeadAsset) -> dict[str, IntArray]:
    """Vertices of face (without lips, lids and eyeballs), lips, lids, eyeballs, neck and scalp, as far as the head has them."""
    known = {name: np.asarray(members, np.int64) for name, members in head.regions.items() if len(members)}
    template = np.asarray(head.template, np.float64)
    none = np.zeros(0, np.int64)
    eyeballs, lids = none, none
    for side in ("left_eyeball", "right_eyeball"):
        if side in known:
            eyeballs = np.union1d(eyeballs, known[side])
            middle, radius = fit_sphere(template[known[side]])
            lids = np.union1d(
                lids, np.flatnonzero(np.linalg.norm(template - middle, axis=1) < LID_REACH * radius)
            )
    lids = np.setdiff1d(np.intersect1d(lids, known.get("eye_region", none)), eyeballs)
    lips = known.get("lips", none)
    inner = np.concatenate([eyeballs, lids, lips, known.get("mouth_socket", none), known.get("teeth", none)])
    regions = {
        "face": np.setdiff1d(known.get("face", none), inner),
        "lips": lips,
        "lids": lids,
        "eyeballs": eyeballs,
    }
    regions |= {name: known.get(name, none) for name in ("neck", "scalp")}
    return {name: members for name, members in regions.items() if len(members)}


def tracking_errors(tracked: Clip, exact: Clip) -> Mapping[str, RegionError]:
    """Errors of a clip's tracking against that of another clip of the same subject, by region.

    Raises `InputError` if the clips do not share timesteps or have head models of other topologies.
    """
    where = f"clip of {tracked.subject}"
    if tracked.head.faces.shape != exact.head.faces.shape or not np.array_equal(
        tracked.head.faces, exact.head.faces
    ):
        raise InputError(where, "head", f"the topology of {exact.head.version}", tracked.head.version)
    timesteps = sorted({*tracked.poses} & {*exact.poses})
    if not timesteps:
        raise InputError(where, "poses", "timesteps of the other capture", "none of them")
    subjects = PosedSubject.of(tracked), PosedSubject.of(exact)
    assert isinstance(exact.head, HeadAsset)
    poses = [[clip.poses[timestep] for timestep in timesteps] for clip in (tracked, exact)]
    found, wanted = (subject.meshes(own) for subject, own in zip(subjects, poses))
    turns = subjects[1].motions(poses[1])[:, :3, :3]
    return {
        name: mesh_errors(found[:, members], wanted[:, members], turns)
        for name, members in error_regions(exact.head).items()
    }


def mesh_errors(found: FloatArray, wanted: FloatArray, turns: FloatArray) -> RegionError:
    """Errors of points (T, n, 3) relative to others, metres, for a head with rotations (T, 3, 3)."""

    def spread(gaps: FloatArray) -> float:
        return 1e3 * float(np.sqrt((gaps**2).sum(axis=-1).mean()))

    gaps = found - wanted
    own = np.einsum("tij,tni->tnj", turns, gaps)
    mapped = []
    for one, other in zip(found, wanted):
        terms = np.concatenate([one - one.mean(axis=0), np.ones((len(one), 1))], axis=1)
        mapped.append(terms @ np.linalg.lstsq(terms, other, rcond=None)[0] - other)
    return RegionError(spread(gaps), spread(np.stack(mapped)), spread(own - own.mean(axis=0)))
