"""The two rings of lip vertices that teeth are hung from.

GaussianAvatars and VHAP write these rings out as vertex numbers of FLAME; ``FLAME_masks.pkl`` does not have
them. Here they are read from a regions file where the user has one, and found in the mesh otherwise: the rim
of the mouth is where the outside of the lips (in the face) meets their inside. That follows the lips, but
need not pick the very vertices of GaussianAvatars; results that must match it to the vertex need its list.
"""

from __future__ import annotations

import numpy as np

from ...bench.contracts import HeadAsset, IntArray
from ...bench.errors import InputError
from .arrays import JOINT_NAMES, RING_REGIONS
from .geometry import mesh_edges

RING_LENGTH = 15
"""Vertices of each ring in GaussianAvatars."""

_REMEDY = (
    f"Give the rings as regions {' and '.join(RING_REGIONS)} (a JSON file of vertex indices passed as "
    "`regions` when the head is loaded)."
)


def lip_rings(asset: HeadAsset, length: int = RING_LENGTH) -> tuple[IntArray, IntArray]:
    """Upper and lower ring: (n,) vertices each, from one corner of the mouth to the other, pairs matching.

    Rings that are found run from the subject's left to the right, as GaussianAvatars' do.

    Parameters
    ----------
    asset : its ring regions are returned as they are if it has both; otherwise the rings are found from
        ``lips`` and ``face``.
    length : n of rings that are found; fewer if the rim has fewer vertices.

    Raises
    ------
    InputError
        Where rings are given but differ in length, or none can be found.
    """
    where = f"head model {asset.version!r}"
    if all(name in asset.regions for name in RING_REGIONS):
        upper, lower = (np.asarray(asset.regions[name], dtype=np.int64) for name in RING_REGIONS)
        if len(upper) != len(lower) or len(upper) < 3:
            found = f"{len(upper)} and {len(lower)}"
            raise InputError(where, "lip rings", "two rings of one length, at least 3", found)
        return upper, lower
    rim = _rim(asset, where)
    on_jaw = asset.skinning_weights[rim, JOINT_NAMES.index("jaw")]
    # Along the rim the jaw's weight jumps between the lips; the corners lie in between.
    middle = 0.5 * (float(on_jaw.min()) + float(on_jaw.max()))
    upper, lower = rim[on_jaw < middle], rim[on_jaw >= middle]
    count = min(length, len(upper), len(lower))
    if count < 3 or np.ptp(on_jaw) < 0.2:
        found = f"{len(upper)} and {len(lower)} vertices, told apart by the jaw's skinning weight"
        raise InputError(where, "lips", "an upper and a lower rim of the mouth", found, _REMEDY)
    left = min(asset.template[part, 0].max() for part in (upper, lower))
    right = max(asset.template[part, 0].min() for part in (upper, lower))
    across = np.linspace(right, left, count)
    return _pick(asset, upper, across)[::-1], _pick(asset, lower, across)[::-1]


def _rim(asset: HeadAsset, where: str) -> IntArray:
    """Vertices of the outer lips that share an edge with the inner ones."""
    missing = [name for name in ("lips", "face") if name not in asset.regions]
    if missing:
        raise InputError(where, "regions", f"{' and '.join(missing)}", "none of that name", _REMEDY)
    lips = np.zeros(asset.template.shape[0], dtype=bool)
    lips[asset.regions["lips"]] = True
    face = np.zeros_like(lips)
    face[asset.regions["face"]] = True
    outer, inner = lips & face, lips & ~face
    edges = mesh_edges(asset.faces)
    edges = np.concatenate([edges, edges[:, ::-1]])
    rim = np.unique(edges[outer[edges[:, 0]] & inner[edges[:, 1]], 0])
    if not len(rim):
        found = f"{outer.sum()} outer and {inner.sum()} inner lip vertices without a common edge"
        raise InputError(where, "lips", "lips that reach from the face into the mouth", found, _REMEDY)
    return rim


def _pick(asset: HeadAsset, rim: IntArray, across: np.ndarray) -> IntArray:
    """One vertex of the rim near each position on x, none twice, in order."""
    order = rim[np.argsort(asset.template[rim, 0], kind="stable")]
    x = asset.template[order, 0]
    picked: list[int] = []
    for done, target in enumerate(across):
        first = picked[-1] + 1 if picked else 0
        last = len(order) - (len(across) - done)  # leave enough for those to come
        picked.append(first + int(np.argmin(np.abs(x[first : last + 1] - target))))
    return order[picked]
