"""Anatomy of a head: points and curves that painting, hair and wrinkles are based on.

Everything is measured on the subject's own neutral shape, so that any head with the named landmarks (or the
68 of iBUG's scheme) can be rendered. Left is the subject's left, +x; +y is up and +z is front; metres.

Distances to points, polylines and polygons, and noise, from which skin, hair and wrinkles are painted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from skimage.measure import find_contours, points_in_poly

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ...bench.errors import InputError
from ..head.geometry import fit_sphere
from ..images import srgb_to_linear


def blob(points: FloatArray, center: FloatArray, radius: float | FloatArray) -> FloatArray:
    """Gaussian of standard deviation ``radius`` (a number or one per axis) about ``center``; 1 in the middle."""
    return np.exp(-0.5 * (((points - center) / np.asarray(radius)) ** 2).sum(axis=-1))


def polyline_distance(points: FloatArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance to a polyline and the arc-length position of the nearest point on it. ``points`` (N, D), ``line`` (M, D)
    -> distances (N,) and arc-length shares (N,) in [0, 1]."""
    best, place = np.full(len(points), np.inf), np.zeros(len(points))
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    start = np.concatenate([[0.0], np.cumsum(lengths)])
    for index, length in enumerate(lengths):
        if length == 0.0:
            continue
        direction = (line[index + 1] - line[index]) / length
        t = np.clip((points - line[index]) @ direction, 0.0, length)
        distance = np.linalg.norm(points - line[index] - t[:, None] * direction, axis=1)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        place = np.where(nearer, (start[index] + t) / start[-1], place)
    return best, place


def polygon_distance(points: FloatArray, outline: FloatArray) -> FloatArray:
    """Signed distance of (N, 2) points to a closed (M, 2) outline, negative inside."""
    closed = np.concatenate([outline, outline[:1]])
    distance, _ = polyline_distance(points, closed)
    return np.where(points_in_poly(points, outline), -distance, distance)


def smooth_curve(anchors: FloatArray, count: int) -> FloatArray:
    """``count`` points along a Catmull-Rom-like cubic through (M, D) anchors."""
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(anchors, axis=0), axis=1))])
    return CubicSpline(chord / chord[-1], anchors, bc_type="natural")(np.linspace(0.0, 1.0, count))


# Odd constants of the usual integer mixers (one per axis, one per seed).
_MIX = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9))
_SEED_MIX = np.uint64(0xD6E8FEB86659FD93)


def lattice_value(cells: IntArray, seed: int) -> FloatArray:
    """Hash integer points (..., 3) to floats in [0, 1) (a splitmix-like finaliser)."""
    with np.errstate(over="ignore"):
        state = np.full(cells.shape[:-1], seed, np.uint64) * _SEED_MIX
        for axis, factor in enumerate(_MIX):
            state = state ^ (cells[..., axis].astype(np.int64).view(np.uint64) * factor)
            state = (state ^ (state >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        state = state ^ (state >> np.uint64(32))
    return (state >> np.uint64(11)).astype(np.float64) / float(1 << 53)


def value_noise(points: FloatArray, seed: int) -> FloatArray:
    """Trilinear value noise with smooth weights, lattice spacing 1; (N, 3) -> (N,) in [-1, 1]."""
    base = np.floor(points).astype(np.int64)
    t = points - base
    weight = t * t * (3.0 - 2.0 * t)
    total = np.zeros(len(points))
    for corner in range(8):
        bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        share = np.prod(np.where(bits, weight, 1.0 - weight), axis=-1)
        total += share * lattice_value(base + bits, seed)
    return 2.0 * total - 1.0


def fractal_noise(points: FloatArray, period: float, seed: int, octaves: int = 4) -> FloatArray:
    """Sum of octaves of value noise, each of half the period and amplitude; about [-1, 1]. ``period`` is the largest
    lattice spacing, in the unit of ``points``."""
    total, amplitude, norm = np.zeros(len(points)), 1.0, 0.0
    for octave in range(octaves):
        total += amplitude * value_noise(points * (2.0**octave / period) + 17.3 * octave, seed + octave)
        norm += amplitude
        amplitude *= 0.5
    return total / norm


def spots(points: FloatArray, spacing: float, radius: float, share: float, seed: int) -> FloatArray:
    """Round spots scattered in space, (N,) in [0, 1]: 1 in a spot's middle. One spot at most per cell of a lattice of
    ``spacing``, in a ``share`` of the cells, with radii of ``radius`` times 0.5 to 1.5."""
    base = np.floor(points / spacing).astype(np.int64)
    best = np.zeros(len(points))
    for offset in np.ndindex(3, 3, 3):
        cell = base + np.array(offset) - 1
        jitter = np.stack([lattice_value(cell, seed + axis) for axis in (1, 2, 3)], axis=-1)
        present = lattice_value(cell, seed + 4) < share
        size = radius * (0.5 + lattice_value(cell, seed + 5))
        distance = np.linalg.norm(points - (cell + jitter) * spacing, axis=-1)
        best = np.maximum(best, present * np.clip(1.5 - 1.5 * distance / size, 0.0, 1.0))
    return np.minimum(best, 1.0)


SIDES = ("left", "right")
_IBUG = {
    "chin": 8,
    "nose_bridge": 27,
    "nose_tip": 30,
    "upper_lip_mid": 51,
    "lower_lip_mid": 57,
    "right_mouth_corner": 48,
    "left_mouth_corner": 54,
    "right_eye_outer": 36,
    "right_eye_inner": 39,
    "left_eye_inner": 42,
    "left_eye_outer": 45,
    "right_brow_outer": 17,
    "right_brow_mid": 19,
    "right_brow_inner": 21,
    "left_brow_inner": 22,
    "left_brow_mid": 24,
    "left_brow_outer": 26,
}
_IBUG_LIPS = tuple(range(48, 60))  # outer contour, starting at the subject's right corner, upper lip first
_NOT_SKIN = {
    *("left_eyeball", "right_eyeball", "teeth", "teeth_upper", "teeth_lower", "gums_and_tongue"),
    *("eyelashes", "lacrimal_fluid", "eye_occlusion", "eye_blend"),
}
_REFERENCE_EYE_DISTANCE = 0.063  # adult interpupillary distance, metres


@dataclass(frozen=True, eq=False)
class Eye:
    """One eye: its ball and the outline of its opening as seen from the front. ``upper`` and ``lower`` are (n, 2)
    curves in x and y from the inner to the outer corner, at rest."""

    center: FloatArray
    radius: float
    upper: FloatArray
    lower: FloatArray

    @property
    def outline(self) -> FloatArray:
        """(2n, 2) closed outline."""
        return np.concatenate([self.upper, self.lower[::-1]])


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Named points (3,), eyes, and the lip outline of one subject at rest.

    ``scale`` is 1 for an adult head of average size; lengths in painting are multiples of it.
    ``skin_faces`` are the tracked triangles that are skin: no eyeballs, no teeth.
    ``lip_outline`` (n, 3) runs once around the red of the lips.
    """

    points: Mapping[str, FloatArray]
    eyes: Mapping[str, Eye]
    lip_outline: FloatArray
    skin_faces: IntArray
    scale: float

    def __getitem__(self, name: str) -> FloatArray:
        return self.points[name]


def measure(head: HeadAsset, vertices: FloatArray) -> Anatomy:
    """Find the anatomy of ``head`` in the neutral shape ``vertices`` (V, 3)."""
    landmarks: Mapping[str, int] = getattr(head, "landmarks", {})
    points = {name: vertices[landmark_index(landmarks, name)] for name in _IBUG}
    for region in ("left_eyeball", "right_eyeball"):
        if region not in head.regions:
            raise InputError(head.version, f"regions[{region!r}]", "the eyeball's vertices", "no such region")
    balls = {side: fit_sphere(vertices[head.regions[f"{side}_eyeball"]]) for side in SIDES}
    scale = float(np.linalg.norm(balls["left"][0] - balls["right"][0])) / _REFERENCE_EYE_DISTANCE
    skin = skin_triangles(head)
    eyes = {}
    for side in SIDES:
        center, radius = balls[side]
        corners = points[f"{side}_eye_inner"], points[f"{side}_eye_outer"]
        faces = head.faces[np.isin(head.faces[:, 0], head.regions[f"{side}_eyeball"])]
        upper, lower = _opening(vertices, skin, faces, corners, scale)
        eyes[side] = Eye(center, radius, upper, lower)
    points.update(_derived(points, vertices, skin, scale))
    return Anatomy(points, eyes, _lip_outline(head, landmarks, vertices), skin, scale)


def landmark_index(landmarks: Mapping[str, int], name: str) -> int:
    """Vertex of a landmark by our name, or by its number in iBUG's scheme ("ibug_08")."""
    for key in (name, f"ibug_{_IBUG[name]:02d}"):
        if key in landmarks:
            return landmarks[key]
    expected = f"the vertex, under this name or as ibug_{_IBUG[name]:02d}"
    found = f"{len(landmarks)} other landmarks"
    remedy = "Use the procedural head or an ICT-FaceKit file, or add landmarks to the head model."
    raise InputError("head model", f"landmarks[{name!r}]", expected, found, remedy)


def skin_triangles(head: HeadAsset) -> IntArray:
    """Triangles of ``head`` that are skin, turned outwards: no eyeballs, teeth, gums, tongue, lashes or tears."""
    other = np.zeros(len(head.template), bool)
    for name in _NOT_SKIN & head.regions.keys():
        other[head.regions[name]] = True
    skin = head.faces[~other[head.faces].any(axis=1)]
    # Light falls on fronts only, so a model whose triangles wind the other way is flipped: the sign
    # of the volume that they enclose decides (divergence theorem).
    a, b, c = head.template[skin].astype(np.float64).transpose(1, 0, 2)
    return skin if np.einsum("ni,ni->", np.cross(a, b), c) > 0 else skin[:, ::-1]


def _opening(
    vertices: FloatArray, skin: IntArray, ball: IntArray, corners: tuple[FloatArray, FloatArray], scale: float
) -> tuple[FloatArray, FloatArray]:
    """Upper and lower lid line: the outline of the visible eyeball in an orthographic front view."""
    step = 0.0003 * scale
    inner, outer = corners
    low = np.minimum(inner, outer)[:2] - np.array([0.006, 0.016]) * scale
    size = np.ceil((np.maximum(inner, outer)[:2] + np.array([0.006, 0.016]) * scale - low) / step).astype(int)
    seen = front_depth(vertices, ball, low, step, size) > front_depth(vertices, skin, low, step, size)
    contours = find_contours(np.pad(seen.astype(float), 1), 0.5)
    if not contours:
        raise InputError("head model", "eyes", "eyeballs visible between the lids", "closed or hidden eyes")
    outline = (max(contours, key=len)[:, ::-1] - 1.0) * step + low
    along = np.linspace(0.0, 1.0, 33)
    inward = np.sign(outer[0] - inner[0])
    span = np.sort(inward * outline[[outline[:, 0].argmin(), outline[:, 0].argmax()], 0])
    x = inward * (span[0] + (span[1] - span[0]) * along)
    curves = []
    for pick in (np.max, np.min):
        y = np.array([pick(outline[np.abs(outline[:, 0] - value) < 3.0 * step, 1]) for value in x])
        curves.append(np.stack([x, np.convolve(np.pad(y, 2, mode="edge"), np.full(5, 0.2), "valid")], axis=1))
    # Both lids share their corners.
    ends = 0.5 * (curves[0][[0, -1]] + curves[1][[0, -1]])
    for curve in curves:
        curve[[0, -1]] = ends
    return curves[0], curves[1]


def front_depth(
    vertices: FloatArray, faces: IntArray, low: FloatArray, step: float, size: IntArray
) -> FloatArray:
    """Largest z of ``faces`` over a grid of x and y, (rows along y, columns along x); -inf where there is none. Grid
    point (row, column) is at ``low + step * (column, row)``."""
    depth = np.full((size[1], size[0]), -np.inf)
    corner = vertices[faces]
    grid = (corner[..., :2] - low) / step
    first = np.clip(np.ceil(grid.min(axis=1)), 0, size).astype(int)
    last = np.clip(np.floor(grid.max(axis=1)) + 1, 0, size).astype(int)
    a, b, c = grid.transpose(1, 2, 0)
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    seen = np.flatnonzero((first < last).all(axis=1) & (np.abs(area) >= 1e-12))
    columns, rows = (last - first)[seen].T
    count = columns * rows
    index = np.repeat(seen, count)  # each triangle for every grid point of its box
    place = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
    row, column = np.divmod(place, np.repeat(columns, count))
    x, y = first[index].T + (column, row)
    a, b, c, area, z = a[:, index], b[:, index], c[:, index], area[index], corner[index, :, 2].T
    v = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
    w = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
    inside = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1.0 + 1e-9)
    depths = (1.0 - v - w) * z[0] + v * z[1] + w * z[2]
    np.maximum.at(depth, (y[inside], x[inside]), depths[inside])
    return depth


def _derived(
    points: Mapping[str, FloatArray], vertices: FloatArray, skin: IntArray, scale: float
) -> dict[str, FloatArray]:
    """Points that follow from the named ones."""
    surface = vertices[np.unique(skin)]
    tip, bridge = points["nose_tip"], points["nose_bridge"]
    brows = 0.5 * (points["left_brow_inner"] + points["right_brow_inner"])
    derived = {
        "vertex_top": surface[surface[:, 1].argmax()],
        "glabella": brows,
        "mouth": 0.5 * (points["upper_lip_mid"] + points["lower_lip_mid"]),
        "nose_base": tip + np.array([0.0, -0.013, -0.010]) * scale,
    }
    top = derived["vertex_top"][1]
    face_height = top - points["chin"][1]
    forehead = np.array([0.0, brows[1] + 0.14 * face_height, 0.0])
    derived["forehead"] = _front_point(surface, forehead)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        corner, eye = points[f"{side}_mouth_corner"], points[f"{side}_eye_outer"]
        derived[f"{side}_ala"] = tip + np.array([sign * 0.017, -0.006, -0.018]) * scale
        cheek = np.array([0.5 * (corner[0] + eye[0]) + sign * 0.012 * scale, 0.5 * (bridge[1] + tip[1]), 0.0])
        cheek[1] = 0.45 * eye[1] + 0.55 * corner[1] + 0.004 * scale
        derived[f"{side}_cheek"] = _front_point(surface, cheek)
        side_points = surface[
            (surface[:, 0] * sign > 0) & (surface[:, 1] > corner[1]) & (surface[:, 1] < brows[1])
        ]
        derived[f"{side}_ear"] = side_points[(side_points[:, 0] * sign).argmax()]
    return derived


def _front_point(surface: FloatArray, at: FloatArray) -> FloatArray:
    """The frontmost surface vertex near the x and y of ``at``."""
    distance = np.linalg.norm(surface[:, :2] - at[:2], axis=1)
    near = surface[distance <= max(0.006, float(distance.min()))]
    return near[near[:, 2].argmax()]


def _lip_outline(head: HeadAsset, landmarks: Mapping[str, int], vertices: FloatArray) -> FloatArray:
    """Closed outline of the lips' red, (n, 3)."""
    keys = [f"ibug_{index:02d}" for index in _IBUG_LIPS]
    if set(keys) <= landmarks.keys():
        return vertices[[landmarks[key] for key in keys]]
    rings = [head.regions.get(f"lip_outside_ring_{part}") for part in ("upper", "lower")]
    if rings[0] is None or rings[1] is None:
        expected = "lip_outside_ring_upper and _lower, or iBUG's lip landmarks"
        raise InputError(head.version, "regions", expected, "neither")
    ring = vertices[np.unique(np.concatenate([rings[0], rings[1]]))]
    middle, extent = 0.5 * (ring.max(axis=0) + ring.min(axis=0)), np.ptp(ring, axis=0)
    # The outline is star-shaped once its height is stretched to its width: sort it by angle.
    return ring[np.argsort(np.arctan2(*((ring - middle) / extent)[:, 1::-1].T))]


# Display colours (sRGB); the skin tones run roughly through Fitzpatrick's types I to VI.
SKIN = ("#eac6b2", "#e2b49a", "#d3a083", "#b98363", "#8f5f43", "#6a4430")
HAIR = ("#2a1d16", "#14100e", "#4a3020", "#7b5836", "#b08a56", "#8c4322", "#8f8a86")
IRIS = ("#5b3a1e", "#3f6f8f", "#6d7f45", "#7d7468", "#3a2414")


def linear(color: str | FloatArray) -> FloatArray:
    """Display colour (``#rrggbb`` or sRGB in [0, 1]) to linear light, (3,)."""
    if isinstance(color, str):
        color = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return srgb_to_linear(color)


@dataclass(frozen=True, eq=False)
class Person:
    """Traits of one subject. Colours are linear-light RGB.

    ``freckles``, ``stubble`` and ``lines`` (how strongly skin folds) are in [0, 1]-ish shares; ``dynamics`` scales all
    that expressions do to skin beyond moving it: 0 for nothing, 1 as drawn. ``lines_at_rest``,
    ``sag`` and ``spots`` of age, and ``oil``, are in [0, 1]-ish shares; ``recession`` of the hairline and length of the
    ``beard`` in metres; ``glasses`` are "metal", "plastic" or none.
    """

    name: str
    seed: int
    skin: FloatArray
    lips: FloatArray
    hair: FloatArray
    iris: FloatArray
    style: str
    brow_thickness: float
    freckles: float
    stubble: float
    lines: float
    dynamics: float = 1.0
    lines_at_rest: float = 0.0
    oil: float = 0.0
    sag: float = 0.0
    spots: float = 0.0
    recession: float = 0.0
    beard: float = 0.0
    glasses: str = ""
