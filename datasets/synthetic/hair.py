"""Hair on the head: a hairline, a thick cap under it, and combed locks over the cap.

The cap is the scalp itself pushed outwards, so that no skin shows between the locks and the mask stays
whole; the locks give strands, shine and a soft outline. Both move with the head.

Static offset of hair, beard and sagging skin, like that of a tracker with vertex offsets such as VHAP. VHAP fits one
offset a vertex to all frames under a Laplacian penalty: the hair's volume without its locks. Here it is a part of the
mean thickness of hair over the head model's own vertices, smoothed over its edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ..head.geometry import LENGTH_BITS, mesh_edges, on_grid, smoothstep, vertex_normals
from .anatomy import SIDES, Anatomy, Eye, Person, fractal_noise, value_noise
from .skin import beard_share, brow_color, brow_curve, sagging


@dataclass(frozen=True)
class Style:
    """A hair style; lengths in metres.

    ``locks`` ribbons of ``width``, standing out by ``rise`` at the tip; ``cap`` is the thickness under them.
    ``fall`` pulls down, ``sweep`` away from the parting (at x = ``parting``), ``back`` backwards; ``curl`` is
    the amplitude of waves relative to the growth direction.
    """

    length: float
    cap: float
    locks: int
    width: float
    rise: float
    fall: float
    sweep: float
    back: float
    curl: float
    parting: float


STYLES = {
    "crop": Style(0.011, 0.0040, 5800, 0.0020, 0.0008, 0.05, 0.10, -0.30, 0.25, 0.0),
    "short": Style(0.042, 0.0100, 2800, 0.0046, 0.0030, 0.30, 0.80, 0.55, 0.20, 0.028),
    "bob": Style(0.105, 0.0120, 1600, 0.0070, 0.0060, 0.85, 0.90, 0.70, 0.12, -0.020),
    "swept": Style(0.068, 0.0100, 2300, 0.0055, 0.0035, 0.20, 0.15, 1.30, 0.16, 0.0),
    "curly": Style(0.036, 0.0150, 4000, 0.0038, 0.0130, 0.10, 0.35, 0.40, 1.10, 0.015),
    "long": Style(0.180, 0.0120, 1600, 0.0075, 0.0060, 0.90, 0.80, 0.75, 0.14, 0.010),
}

_COLOURED = 0.3  # coverage from which on the skin has the colour of hair, and locks grow
_TOO_SHORT_TO_HANG = 0.02  # metres; shorter hair cannot reach the face

# Hairline: height above the brows (m) by azimuth from the front (degrees), for a head of average size.
_AZIMUTH = np.radians([0.0, 25.0, 42.0, 54.0, 63.0, 74.0, 84.0, 100.0, 118.0, 180.0])
_HEIGHT = np.array([0.060, 0.058, 0.050, 0.024, -0.008, -0.036, -0.026, -0.052, -0.085, -0.098])


@dataclass(frozen=True, eq=False)
class Hair:
    """``cap`` (N,) thickness over the fine skin points in metres, ``share`` (N,) of hair in their colour, and locks."""

    cap: FloatArray
    share: FloatArray
    strands: Strands


def hair_share(person: Person, anatomy: Anatomy, points: FloatArray, ears: FloatArray) -> FloatArray:
    """Coverage of the skin by hair roots, (N,); ``ears`` (N,) is 1 on the ears."""
    s = anatomy.scale
    middle_z = 0.5 * (anatomy["glabella"][2] + anatomy["vertex_top"][2]) - 0.045 * s
    azimuth = np.arctan2(np.abs(points[:, 0]), points[:, 2] - middle_z)
    line = anatomy["glabella"][1] + s * np.interp(azimuth, _AZIMUTH, _HEIGHT)
    line = line + person.recession * s * smoothstep(azimuth, 1.15, 0.6)
    ragged = 0.0035 * s * fractal_noise(points, 0.012 * s, person.seed + 80, 3)
    density = smoothstep(points[:, 1] - line + ragged, -0.002 * s, 0.016 * s)
    return density * (1.0 - ears) * (1.0 - _around_lobes(points, ears, s))


def _around_lobes(points: FloatArray, ears: FloatArray, s: float) -> FloatArray:
    """1 close to the lower half of the ears, (N,): hair there would hang from the lobes like earrings."""
    ear = points[ears > 0.5]
    if not len(ear):
        return np.zeros(len(points))
    middle = ear[:, 1].mean()
    distance, _ = cKDTree(ear[ear[:, 1] <= middle]).query(points)
    return smoothstep(distance, 0.016 * s, 0.010 * s) * smoothstep(
        points[:, 1], middle + 0.004 * s, middle - 0.008 * s
    )


def make_hair(
    person: Person,
    anatomy: Anatomy,
    points: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    ears: FloatArray,
) -> Hair:
    """Grow the subject's hair on the neutral fine skin."""
    style, s = STYLES[person.style], anatomy.scale
    share = hair_share(person, anatomy, points, ears)
    uneven = 1.0 + 0.35 * fractal_noise(points, 0.03 * s, person.seed + 81, 2)
    # The cap rises only where its colour is that of hair, so that no raised skin is visible.
    cap = style.cap * s * smoothstep(share, _COLOURED, 1.0) * uneven
    rng = np.random.default_rng(person.seed + 82)
    chosen = _sample(points, faces, share, style.locks, rng)
    weights = rng.dirichlet(np.ones(3), len(chosen))
    surface = points + cap[:, None] * normals
    roots = np.einsum("nk,nki->ni", weights, surface[faces[chosen]])
    lengths = style.length * s * rng.uniform(0.7, 1.15, len(roots))
    # Hair close to the hairline is shorter on short heads; long hair keeps its length.
    edge = np.einsum("nk,nk->n", weights, share[faces[chosen]])
    lengths *= 0.45 + 0.55 * edge if style.length < 0.1 else 1.0
    tree = cKDTree(points)
    layer = rng.uniform(0.3, 1.0, len(roots))

    limit = _face_limit(anatomy)
    # Locks at the temples have roots in front of the limit.
    temple = roots[:, 1] < anatomy["glabella"][1] + 0.05 * s
    foremost = np.where(temple, roots[:, 2], -np.inf)

    def keep_out(place: FloatArray, along: float) -> FloatArray:
        _, nearest = tree.query(place, k=4)
        normal = normals[nearest].mean(axis=1)
        height = np.einsum("ni,ni->n", place - points[nearest].mean(axis=1), normal)
        wanted = cap[nearest].mean(axis=1) + (0.0005 * s + style.rise * along) * layer
        place = place + np.maximum(wanted - height, 0.0)[:, None] * normal
        if style.length > _TOO_SHORT_TO_HANG:
            place[:, 2] = np.minimum(place[:, 2], np.maximum(limit(place), foremost))
        return place

    parting = style.parting * s
    phase = rng.integers(0, 3, (len(roots), 1)) * 31.7

    def field(place: FloatArray, along: float) -> FloatArray:
        _, nearest = tree.query(place)
        normal = normals[nearest]
        side = np.where(place[:, 0] < parting, -1.0, 1.0)
        top = smoothstep(normal[:, 1], 0.1, 0.8)
        front = smoothstep(place[:, 2], anatomy["vertex_top"][2] - 0.02 * s, anatomy["glabella"][2])
        wish = np.stack(
            [
                style.sweep * side * (0.3 + 0.7 * top),
                np.full(len(place), -style.fall),
                -style.back * (0.25 + 0.75 * front),
            ],
            axis=1,
        )
        away = place - (anatomy["vertex_top"] + np.array([0.0, 0.0, -0.03]) * s)
        wish += 0.35 * away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        # Away from the skull, hair hangs down.
        free = smoothstep(place[:, 1], anatomy["nose_tip"][1] + 0.02 * s, anatomy["mouth"][1])[:, None]
        wish = (1.0 - free) * wish + free * np.array([0.0, -1.0, -0.10])
        wish -= (1.0 - free) * np.einsum("ni,ni->n", wish, normal)[:, None] * normal
        wish /= np.maximum(np.linalg.norm(wish, axis=1, keepdims=True), 1e-9)
        wave = [value_noise(place / (0.03 * s) + phase + 7.0 * axis, person.seed + 83) for axis in range(3)]
        return wish + 0.10 * (1.0 - along) * normal + style.curl * np.stack(wave, axis=1)

    segments = int(np.clip(round(style.length / 0.010), 4, 15))
    paths = grow(roots, lengths, field, keep_out, segments)
    _, nearest = tree.query(paths)
    facing = normals[nearest] + rng.normal(0.0, 0.10, (len(roots), 1, 3))
    columns = 3
    tone = 0.55 * fractal_noise(roots, 0.02 * s, person.seed + 84, 2)[:, None] + 0.20 * rng.standard_normal(
        (len(roots), columns)
    )
    color = person.hair * np.exp(0.6 * tone)[:, :, None]
    width = style.width * s * rng.uniform(0.7, 1.3, len(roots))
    locks = ribbons(paths, facing, width, color, tip_shade=1.3, tip_width=0.2, root_width=0.3, arch=0.16)
    return Hair(cap, smoothstep(share, 0.0, _COLOURED), locks)


def _face_limit(anatomy: Anatomy) -> Callable[[FloatArray], FloatArray]:
    """Largest z that hair may have at points (n, 3), so that none hangs into the face."""
    s, brow = anatomy.scale, anatomy["glabella"][1]
    high, low = anatomy["forehead"][2] + 0.03 * s, anatomy["left_ear"][2] + 0.042 * s

    def limit(points: FloatArray) -> FloatArray:
        return low + (high - low) * smoothstep(points[:, 1], brow + 0.018 * s, brow + 0.062 * s)

    return limit


def ear_share(anatomy: Anatomy, points: FloatArray, labelled: FloatArray) -> FloatArray:
    """1 on the ears, 0 elsewhere, (N,): ``labelled`` (N,) where the head names its ears, else by their place."""
    if labelled.any():
        return (labelled > 0.5).astype(float)
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        middle = anatomy[f"{side}_ear"] * np.array([0.93, 1.0, 1.0]) + np.array([0.0, -0.008, 0.008]) * s
        distance = np.sqrt(((((points - middle) / s) / np.array([0.018, 0.034, 0.024])) ** 2).sum(axis=1))
        total = np.maximum(total, smoothstep(distance, 1.15, 0.9))
    return total


def _sample(
    points: FloatArray, faces: IntArray, share: FloatArray, count: int, rng: np.random.Generator
) -> IntArray:
    """Draw triangles by area where hair grows, most densely at its edge, which no locks from elsewhere cover."""
    corner = points[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    density = share[faces].mean(axis=1)
    chance = area * np.where(density > _COLOURED, 3.0 - 2.0 * density, 0.0)
    return rng.choice(len(faces), count, p=chance / chance.sum())


GrowthField = Callable[[FloatArray, float], FloatArray]
"""Growth direction (n, 3) at points (n, 3), for a share in [0, 1] of the strand's length."""


@dataclass(frozen=True, eq=False)
class Strands:
    """Ribbons at rest. ``strand`` (n,) is the number of each vertex's strand."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray
    strand: IntArray

    def joined(self, other: Strands) -> Strands:
        """Concatenation; the strands of ``other`` are numbered after these."""
        return Strands(
            np.concatenate([self.vertices, other.vertices]),
            np.concatenate([self.faces, other.faces + len(self.vertices)]),
            np.concatenate([self.albedo, other.albedo]),
            np.concatenate([self.strand, other.strand + 1 + self.strand.max(initial=-1)]),
        )


def grow(
    roots: FloatArray,
    lengths: FloatArray,
    field: GrowthField,
    keep_out: Callable[[FloatArray, float], FloatArray],
    segments: int,
) -> FloatArray:
    """Polylines (n, segments + 1, 3) from ``roots`` along ``field``, each of its own length. ``keep_out(points,
    share)`` moves points inside the head out of it."""
    path = [roots]
    step = (lengths / segments)[:, None]
    for index in range(segments):
        share = (index + 1) / segments
        direction = field(path[-1], share)
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        path.append(keep_out(path[-1] + step * direction, share))
    return np.stack(path, axis=1)


def ribbons(
    paths: FloatArray,
    outward: FloatArray,
    width: FloatArray,
    color: FloatArray,
    *,
    tip_shade: float = 1.0,
    tip_width: float = 0.25,
    root_width: float = 1.0,
    arch: float = 0.0,
) -> Strands:
    """Tapered ribbons around paths (n, k, 3).

    ``outward``: (n, k, 3) or (n, 1, 3) direction that a ribbon's flat side faces. ``width``: (n,) metres, at the widest.
    ``color``: (n, c, 3) linear reflectance across each ribbon, c >= 2 columns. ``tip_shade``: Factor on the colour at the
    tip (above 1 for sun-bleached tips). ``tip_width``, ``root_width``: Width at the ends relative to the widest. ``arch``:
    Height of the middle above the edges, relative to the width.
    """
    count, points = paths.shape[:2]
    columns = color.shape[1]
    outward = np.broadcast_to(outward, paths.shape)
    across = np.cross(np.gradient(paths, axis=1), outward)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    taper = np.interp(np.linspace(0.0, 1.0, points), [0.0, 0.2, 0.6, 1.0], [root_width, 1.0, 0.9, tip_width])
    wide = (width[:, None] * taper)[:, :, None, None]
    u = np.linspace(-1.0, 1.0, columns)[None, None, :, None]
    vertices = paths[:, :, None] + wide * (
        0.5 * u * across[:, :, None] + arch * (1.0 - u * u) * outward[:, :, None]
    )
    index = np.arange(count * points * columns).reshape(count, points, columns)
    a, b, c, d = (index[:, :-1, :-1], index[:, :-1, 1:], index[:, 1:, :-1], index[:, 1:, 1:])
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    shade = np.linspace(1.0, tip_shade, points)[None, :, None, None]
    albedo = np.clip(color[:, None] * shade, 0.003, 0.9)
    strand = np.repeat(np.arange(count), points * columns)
    return Strands(vertices.reshape(-1, 3), faces, albedo.reshape(-1, 3), strand)


_BROW_HAIRS = 260
_UPPER_LASHES, _LOWER_LASHES = 70, 40


@dataclass(frozen=True, eq=False)
class RootedStrands:
    """Ribbons at rest and the fine skin point (n,) that each grows from."""

    strands: Strands
    root: IntArray


def make_brows_and_lashes(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray
) -> RootedStrands:
    """Both brows and all four rows of lashes of a neutral subject."""
    rng = np.random.default_rng(person.seed + 70)
    tree, made, roots = cKDTree(points), None, []
    for side, sign in zip(SIDES, (1.0, -1.0)):
        for paths, width, color in (
            _brow(person, anatomy, side, sign, rng, points, normals, tree),
            *_lashes(person, anatomy, anatomy.eyes[side], sign, rng, points, tree),
        ):
            _, root = tree.query(paths[:, 0])
            shades = color[None] * np.exp(0.2 * rng.standard_normal((len(paths), 1)))
            facing = normals[root][:, None] + rng.normal(0.0, 0.3, (len(paths), 1, 3))
            widths = np.full(len(paths), width * anatomy.scale)
            strands = ribbons(paths, facing, widths, np.repeat(shades[:, None], 2, axis=1))
            made = strands if made is None else made.joined(strands)
            roots.append(root)
    assert made is not None
    return RootedStrands(made, np.concatenate(roots))


def _brow(
    person: Person,
    anatomy: Anatomy,
    side: str,
    sign: float,
    rng: np.random.Generator,
    points: FloatArray,
    normals: FloatArray,
    tree: cKDTree,
) -> tuple[FloatArray, float, FloatArray]:
    """Hairs that start along the brow's curve, rise near the nose and lie down outwards."""
    s = anatomy.scale
    curve = brow_curve(anatomy, side, 64)
    place = rng.uniform(0.0, 0.95, _BROW_HAIRS)
    half = 0.0034 * s * person.brow_thickness * (1.0 - 0.75 * place**2)
    at = np.stack([np.interp(place, np.linspace(0, 1, 64), curve[:, axis]) for axis in range(3)], axis=1)
    at[:, 1] += half * rng.uniform(-1.0, 0.8, _BROW_HAIRS)
    _, root = tree.query(at)
    start, normal = points[root], normals[root]
    lean = np.stack([sign * (0.45 + 0.9 * place), 0.85 - 1.25 * place, -0.25 * place], axis=1)
    lean += 0.18 * rng.standard_normal(lean.shape)
    lean -= np.einsum("ni,ni->n", lean, normal)[:, None] * normal
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    length = 0.0068 * s * rng.uniform(0.6, 1.1, _BROW_HAIRS)
    t = np.linspace(0.0, 1.0, 4)[None, :, None]
    rise = (0.0002 + 0.0009 * t * (1.0 - 0.5 * t)) * s
    paths = start[:, None] + t * length[:, None, None] * lean[:, None] + rise * normal[:, None]
    return paths, 0.00055, brow_color(person)


def _lashes(
    person: Person,
    anatomy: Anatomy,
    eye: Eye,
    sign: float,
    rng: np.random.Generator,
    points: FloatArray,
    tree: cKDTree,
) -> list[tuple[FloatArray, float, FloatArray]]:
    """Upper lashes curve up and outwards, lower ones down and are shorter and thinner."""
    s, made = anatomy.scale, []
    color = np.minimum(0.4 * person.hair, 0.03)
    for curve, up, count, reach in (
        (eye.upper, 1.0, _UPPER_LASHES, 0.0070),
        (eye.lower, -1.0, _LOWER_LASHES, 0.0038),
    ):
        place = np.sort(rng.uniform(0.12, 0.98, count))
        flat = np.stack(
            [np.interp(place, np.linspace(0, 1, len(curve)), curve[:, axis]) for axis in (0, 1)], 1
        )
        depth = eye.radius**2 - ((flat - eye.center[:2]) ** 2).sum(axis=1)
        z = eye.center[2] + np.sqrt(np.maximum(depth, 0.0)) + 0.0006 * s
        _, root = tree.query(np.concatenate([flat, z[:, None]], axis=1))
        start = points[root]
        outwards = np.stack([sign * 1.1 * (place - 0.35), np.zeros(count), np.ones(count)], axis=1)
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        length = reach * s * (0.55 + 0.45 * place) * rng.uniform(0.8, 1.1, count)
        t = np.linspace(0.0, 1.0, 4)[None, :, None]
        rise = np.array([0.0, up, 0.0])
        paths = start[:, None] + length[:, None, None] * (
            0.85 * t * outwards[:, None] + (0.1 * t + 0.75 * t**2) * rise
        )
        made.append((paths, 0.00042 if up > 0 else 0.0003, color))
    return made


_BEARD_LOCKS = 1900
_MOUSTACHE = 0.008  # metres, at most: longer hairs above the mouth would hang into it


def make_beard(
    person: Person,
    anatomy: Anatomy,
    points: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    cavity: FloatArray,
) -> RootedStrands | None:
    """A beard that grows from cheeks, chin and upper lip and moves with them, or none."""
    if not person.beard:
        return None
    s, rng = anatomy.scale, np.random.default_rng(person.seed + 86)
    share = np.where(cavity > 0.0, 0.0, beard_share(person, anatomy, points))
    fine = 0.65 if person.beard < _MOUSTACHE else 1.0
    chosen = _sample(points, faces, share, int(_BEARD_LOCKS / fine), rng)
    root = faces[chosen, rng.integers(0, 3, len(chosen))]
    root = root[share[root] > 0.15]
    start, normal, count = points[root], normals[root], len(root)
    above = smoothstep(start[:, 1], anatomy["mouth"][1] - 0.001 * s, anatomy["mouth"][1] + 0.005 * s)
    aside = np.sign(start[:, 0]) * smoothstep(np.abs(start[:, 0]), 0.0, 0.012 * s)
    lean = np.stack([(0.15 + 0.9 * above) * aside, -np.ones(count), np.full(count, -0.1)], axis=1)
    lean += 0.22 * rng.standard_normal(lean.shape)
    lean -= 0.85 * np.einsum("ni,ni->n", lean, normal)[:, None] * normal
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    length = person.beard * rng.uniform(0.6, 1.1, count) * (0.4 + 0.6 * share[root])
    length = s * np.where(above > 0.5, np.minimum(length, _MOUSTACHE), length)
    ear = anatomy["left_ear"][2]
    length *= 1.0 - 0.7 * smoothstep(start[:, 2], ear + 0.06 * s, ear + 0.03 * s)
    t = np.linspace(0.0, 1.0, 4)[None, :, None]
    out = (0.35 + 0.25 * rng.random((count, 1, 1))) * t * (1.0 - 0.45 * t)
    paths = start[:, None] + length[:, None, None] * (t * lean[:, None] + out * normal[:, None])
    tone = (
        0.35 * rng.standard_normal((count, 2))
        + 0.3 * fractal_noise(start, 0.012 * s, person.seed + 87, 2)[:, None]
    )
    color = 0.9 * person.hair * np.exp(tone)[:, :, None]
    facing = normal[:, None] + rng.normal(0.0, 0.25, (count, 1, 3))
    width = 0.0024 * fine * s * rng.uniform(0.7, 1.3, count)
    return RootedStrands(ribbons(paths, facing, width, color, tip_shade=1.2, tip_width=0.3), root)


FOUND = 0.8
"""Fraction of the thickness in the offset, which penalties reduce."""
_ROUNDS = 6  # of averaging over neighbours
_LOCKS = 0.6  # mean height of locks over the cap, as a part of their rise
_BEARD = 0.35  # mean thickness of a beard, as a part of its length


def tracked_volume(person: Person, anatomy: Anatomy, head: HeadAsset, neutral: FloatArray) -> FloatArray:
    """(V, 3) offsets, metres, of a subject's neutral vertices (V, 3); 0 without skin. Joints do not move."""
    s, style = anatomy.scale, STYLES[person.style]
    named = np.zeros(len(neutral))
    for ear in ("left_ear", "right_ear"):
        named[head.regions.get(ear, [])] = 1.0
    thickness = (
        (style.cap + _LOCKS * style.rise)
        * s
        * hair_share(person, anatomy, neutral, ear_share(anatomy, neutral, named))
    )
    thickness = thickness + _BEARD * person.beard * s * beard_share(person, anatomy, neutral)
    thickness = thickness + sagging(person, anatomy, neutral)
    skin = np.zeros(len(neutral), bool)
    skin[anatomy.skin_faces] = True
    offset = FOUND * np.where(skin, thickness, 0.0)[:, None] * vertex_normals(neutral, anatomy.skin_faces)
    return without_joints(head, smoothed(offset, anatomy.skin_faces, _ROUNDS) * skin[:, None])


def smoothed(values: FloatArray, faces: IntArray, rounds: int) -> FloatArray:
    """(V, n) values at vertices, averaged ``rounds`` times with those of their neighbours."""
    edges = mesh_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    around = np.bincount(both[:, 0], minlength=len(values))
    for _ in range(rounds):
        mean = [np.bincount(both[:, 0], column[both[:, 1]], len(values)) for column in values.T]
        values = 0.5 * (values + np.stack(mean, axis=1) / np.maximum(around, 1)[:, None])
    return values


def without_joints(head: HeadAsset, offset: FloatArray) -> FloatArray:
    """(V, 3) offsets with the least change that leaves the joints, which are regressed from these vertices, in place."""
    regressor = np.asarray(head.joint_regressor, np.float64)
    return on_grid(offset - np.linalg.pinv(regressor) @ (regressor @ offset), LENGTH_BITS)
