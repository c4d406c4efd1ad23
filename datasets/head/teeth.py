"""Teeth as in GaussianAvatars and VHAP: two curved double plates attached to the rings of the lips.

Qian et al., "GaussianAvatars", CVPR 2024, supplement; the construction follows their code.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ...bench.errors import InputError
from .arrays import JOINT_NAMES, RING_REGIONS, HeadArrays
from .geometry import connected_pieces, mesh_edges

_log = logging.getLogger(__name__)

ROWS = (
    *("upper_root", "lower_root", "upper_edge", "lower_edge"),
    *("upper_root_back", "upper_edge_back", "lower_root_back", "lower_edge_back"),
)
"""Blocks of n vertices, in the order in which they are appended."""

# Lengths in units of d, the mean distance between the lips' rings.
SET_BACK = 1.5
GAP = 0.1
OVERBITE = 0.4
HEIGHT = 2.0
THICKNESS = 1.0


def with_teeth(arrays: HeadArrays) -> HeadArrays:
    """Append 8 n teeth vertices and 12 (n - 1) triangles, n being the length of the lip rings.

    Upper teeth follow the neck joint, lower ones the jaw. They follow the identity like the lips in front of them
    (mean of the matching upper and lower lip vertex), and have no expression, pose correctives, influence on joints or place in the chart.
    Adds the regions ``teeth``, ``teeth_upper`` and ``teeth_lower``.
    """
    upper, lower = lip_rings(arrays)
    vertices, columns = arrays.template.shape[0], len(upper)
    positions = _positions(arrays.template[upper], arrays.template[lower])
    follow = 0.5 * (arrays.shape_basis[upper] + arrays.shape_basis[lower])
    on_jaw = np.repeat([row.startswith("lower") for row in ROWS], columns)
    joints = np.where(on_jaw, JOINT_NAMES.index("jaw"), JOINT_NAMES.index("neck"))
    weights = np.eye(len(JOINT_NAMES))[joints]
    towards_left = float(arrays.template[upper[-1], 0] - arrays.template[upper[0], 0]) > 0
    triangles = vertices + _triangles(columns, towards_left)
    teeth = vertices + np.arange(len(weights))
    return replace(
        arrays,
        template=_append(arrays.template, positions),
        faces=np.concatenate([arrays.faces, triangles.astype(arrays.faces.dtype)]),
        shape_basis=_append(arrays.shape_basis, np.tile(follow, (len(ROWS), 1, 1))),
        expression_basis=_append_zeros(arrays.expression_basis, len(weights)),
        pose_basis=_append_zeros(arrays.pose_basis, len(weights)),
        joint_regressor=_append_zeros(arrays.joint_regressor.T, len(weights)).T.copy(),
        skinning_weights=_append(arrays.skinning_weights, weights),
        eyelid_basis=None
        if arrays.eyelid_basis is None
        else _append_zeros(arrays.eyelid_basis, len(weights)),
        uv=None if arrays.uv is None else _append_zeros(arrays.uv, len(triangles)),
        regions={
            **arrays.regions,
            "teeth": teeth,
            "teeth_upper": teeth[~on_jaw],
            "teeth_lower": teeth[on_jaw],
        },
    )


def with_teeth_where_possible(arrays: HeadArrays) -> HeadArrays:
    """Append teeth to a head without them; if the rings of the lips are not found, log the reason and return it unchanged."""
    if "teeth" in arrays.regions:
        return arrays
    try:
        return with_teeth(arrays)
    except InputError as error:
        _log.warning("no teeth: %s", error)
        return arrays


def _positions(upper: FloatArray, lower: FloatArray) -> FloatArray:
    """(8 n, 3) vertices, block by block as in `ROWS`, from the (n, 3) rings."""
    distance = np.linalg.norm(upper - lower, axis=1).mean()

    def along(y: float = 0.0, z: float = 0.0) -> FloatArray:
        return distance * np.array([0.0, y, z])

    middle = 0.5 * (upper + lower)
    middle[:, 1] = middle[:, 1].mean()
    middle = middle + along(z=-SET_BACK)
    rows = {"upper_edge": middle + along(y=GAP), "lower_edge": middle + along(y=-GAP, z=-OVERBITE)}
    rows["upper_root"] = rows["upper_edge"] + along(y=HEIGHT)
    rows["lower_root"] = rows["lower_edge"] + along(y=-HEIGHT)
    rows |= {f"{name}_back": row + along(z=-THICKNESS) for name, row in rows.items()}
    return np.concatenate([rows[name] for name in ROWS])


def _triangles(columns: int, towards_left: bool) -> IntArray:
    """Triangles of the six strips, seen from outside counter-clockwise, as indices into the new vertices. In the order
    of GaussianAvatars, whose splats are bound to triangles by index and rotate with their first edge."""
    block = {name: index * columns + np.arange(columns) for index, name in enumerate(ROWS)}
    strips = []
    for first, second, falling, turned in (
        ("upper_root", "upper_edge", True, False),
        ("upper_root_back", "upper_edge_back", True, True),
        ("upper_edge_back", "upper_edge", False, True),
        ("lower_edge", "lower_root", False, False),
        ("lower_root_back", "lower_edge_back", True, False),
        ("lower_edge_back", "lower_edge", False, False),
    ):
        strip = _strip(block[first], block[second], falling=falling)
        strips.append(strip[:, [0, 2, 1]] if turned != towards_left else strip)
    return np.concatenate(strips)


def _strip(first: IntArray, second: IntArray, *, falling: bool) -> IntArray:
    """Quads between two rows in two triangles each; the diagonal flips at the middle for symmetry.

    The triangles face a viewer who sees the rows run to the left with ``first`` above ``second``. ``falling``:
    the first half's diagonals run from ``first`` to the next of ``second``.
    """
    a, next_a, b, next_b = first[:-1], first[1:], second[:-1], second[1:]
    down = np.stack([a, next_b, b, a, next_a, next_b], axis=1).reshape(-1, 2, 3)
    up = np.stack([a, next_a, b, next_a, next_b, b], axis=1).reshape(-1, 2, 3)
    first_half = np.arange(len(a)) < len(a) / 2
    return np.where((first_half == falling)[:, None, None], down, up).reshape(-1, 3)


def _append(array: FloatArray, rows: FloatArray) -> FloatArray:
    return np.concatenate([array, rows.astype(array.dtype)])


def _append_zeros(array: FloatArray, count: int) -> FloatArray:
    return _append(array, np.zeros((count, *array.shape[1:])))


RING_LENGTH = 15
"""Vertices of each ring in GaussianAvatars."""

_REMEDY = (
    f"Give the rings as regions {' and '.join(RING_REGIONS)} (a JSON file of vertex indices passed as "
    "`regions` when the head is loaded)."
)


def lip_rings(asset: HeadAsset) -> tuple[IntArray, IntArray]:
    """Upper and lower ring: (n,) vertices each, from one corner of the mouth to the other, pairs matching.

    Rings that are found run from the subject's left to the right, as GaussianAvatars' do. The region ``lips`` is a band
    around the mouth. With D edges from its outer border to its deepest vertices, the upper ring lies D // 2 edges and the
    lower one D // 3 edges inside the border, without the corners of the mouth. In FLAME, D is 7, and these rings are the
    two lists of GaussianAvatars' code.

    ``asset``: Head whose ring regions are returned unchanged if it has both; otherwise the rings are found from ``lips``,
    with `RING_LENGTH` vertices, fewer if the lips have fewer.
    """
    where = f"head model {asset.version!r}"
    if all(name in asset.regions for name in RING_REGIONS):
        given, other = (np.asarray(asset.regions[name], dtype=np.int64) for name in RING_REGIONS)
        if len(given) != len(other) or len(given) < 3:
            found = f"{len(given)} and {len(other)}"
            raise InputError(where, "lip rings", "two rings of one length, at least 3", found)
        return given, other
    if not len(asset.regions.get("lips", ())):
        raise InputError(where, "regions", "lips", "none of that name", _REMEDY)
    edges = mesh_edges(asset.faces)
    edges = np.concatenate([edges, edges[:, ::-1]])
    depth = _depth_of_lips(asset, edges)
    deepest = int(depth.max())
    upper = _arc(asset, edges, depth == deepest // 2, 0)
    lower = _arc(asset, edges, depth == deepest // 3, 1)
    count = min(RING_LENGTH, len(upper), len(lower))
    weights = asset.skinning_weights[:, JOINT_NAMES.index("jaw")]
    if count < 3 or weights[lower].mean() - weights[upper].mean() < 0.2:
        found = f"{len(upper)} and {len(lower)} vertices, told apart by the jaw's skinning weight"
        raise InputError(where, "lips", "an upper and a lower lip around the mouth", found, _REMEDY)
    left = min(asset.template[part, 0].max() for part in (upper, lower))
    right = max(asset.template[part, 0].min() for part in (upper, lower))
    across = np.linspace(right, left, count)
    return _pick(asset, upper, across)[::-1], _pick(asset, lower, across)[::-1]


def _depth_of_lips(asset: HeadAsset, edges: IntArray) -> IntArray:
    """(V,) edges between each vertex of the lips and their outer border; -1 elsewhere. ``edges`` has both directions."""
    lips = np.isin(np.arange(len(asset.template)), asset.regions["lips"])
    border = np.unique(edges[lips[edges[:, 0]] & ~lips[edges[:, 1]], 0])
    if not len(border):  # a mesh of only lips
        border = np.flatnonzero(lips)
    # The inner border, towards the mouth, is the narrower one.
    outer = max(connected_pieces(border, edges), key=lambda piece: np.ptp(asset.template[piece, 0]))
    depth = np.full(len(lips), -1)
    depth[outer] = 0
    reached, steps = outer, 0
    while len(reached):
        steps += 1
        beside = edges[np.isin(edges[:, 0], reached), 1]
        reached = np.unique(beside[lips[beside] & (depth[beside] < 0)])
        depth[reached] = steps
    return depth


def _arc(asset: HeadAsset, edges: IntArray, ring: np.ndarray, place: int) -> IntArray:
    """The upper (``place`` 0) or lower (1) half of a ring around the mouth, (V,) bool, without its two corners."""
    members = np.flatnonzero(ring)
    x = asset.template[members, 0]
    rest = np.setdiff1d(members, members[[x.argmin(), x.argmax()]])
    halves = sorted(connected_pieces(rest, edges), key=len)[-2:]
    if len(halves) < 2:
        return np.empty(0, np.int64)
    weights = asset.skinning_weights[:, JOINT_NAMES.index("jaw")]
    return sorted(halves, key=lambda half: float(weights[half].mean()))[place]


def _pick(asset: HeadAsset, rim: IntArray, across: np.ndarray) -> IntArray:
    """One vertex of the rim near each position on x, none twice, in order."""
    order = rim[np.argsort(asset.template[rim, 0], kind="stable")]
    x = asset.template[order, 0]
    picked: list[int] = []
    for done, target in enumerate(across):
        first = picked[-1] + 1 if picked else 0
        last = len(order) - (len(across) - done)  # leave enough for the following ones
        picked.append(first + int(np.argmin(np.abs(x[first : last + 1] - target))))
    return order[picked]
