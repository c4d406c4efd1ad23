"""The skin's colour at rest, painted once per subject on the fine mesh.

Painting is a function of the neutral shape and the subject's traits alone; what expressions add is in
`Folds`. Colours are linear-light reflectances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray
from ..head.geometry import smoothstep
from .anatomy import (
    SIDES,
    Anatomy,
    Person,
    blob,
    fractal_noise,
    polygon_distance,
    polyline_distance,
    smooth_curve,
    spots,
    value_noise,
)
from .performance import Activations

_FRONT = 0.35  # z component of the normal from which on a point counts as facing front


@dataclass(frozen=True, eq=False)
class SkinPaint:
    """(N, 3) reflectance, and the (N,) share of the lips' red, which folds and flushes need."""

    albedo: FloatArray
    lips: FloatArray


def paint_skin(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray, cavity: FloatArray
) -> SkinPaint:
    """Paint the fine skin points (N, 3) of a neutral subject. ``normals`` (N, 3) point outwards; ``cavity`` (N,) is the
    share of each point in the mouth's wall."""
    s, seed = anatomy.scale, person.seed
    color = np.tile(person.skin, (len(points), 1))
    red = person.skin * np.array([1.02, 0.66, 0.62])
    color = _mix(color, red, 0.55 * _flush(anatomy, points))
    color = _mix(color, person.skin * np.array([0.62, 0.52, 0.55]), 0.4 * _around_eyes(anatomy, points))
    # Blotches, then pores.
    color *= (1.0 + 0.10 * fractal_noise(points, 0.03 * s, seed, 3))[:, None]
    color[:, 1:] *= (1.0 - 0.06 * fractal_noise(points, 0.012 * s, seed + 7, 3))[:, None]
    color *= (1.0 + 0.05 * value_noise(points / (0.0014 * s), seed + 8))[:, None]
    facing = smoothstep(normals[:, 2], 0.0, _FRONT)
    color = _mix(
        color, person.skin * np.array([0.62, 0.44, 0.34]), person.freckles * _freckles(anatomy, points, seed)
    )
    if person.spots:
        brown = 0.5 * person.spots * spots(points, 0.014 * s, 0.0026 * s, 0.3, seed + 32)
        color = _mix(color, person.skin * np.array([0.60, 0.46, 0.38]), brown)
    moles = spots(points, 0.045 * s, 0.0016 * s, 0.25, seed + 31)
    color = _mix(color, person.skin * np.array([0.22, 0.14, 0.12]), moles)
    beard = person.hair * 0.6 + person.skin * np.array([0.10, 0.12, 0.13])
    color = _mix(color, beard, 0.55 * person.stubble * stubble_share(anatomy, points, seed))
    if person.beard:
        color = _mix(color, 0.8 * beard, 0.9 * beard_share(person, anatomy, points))
    lips = lip_share(anatomy, points) * facing
    stripes = 1.0 + 0.10 * value_noise(points / (np.array([0.0012, 0.02, 0.02]) * s), seed + 40)
    color = _mix(color, person.lips[None] * stripes[:, None], 0.92 * lips)
    color = _mix(color, np.array([0.055, 0.012, 0.012]), cavity)
    color = _mix(color, person.skin * np.array([0.10, 0.05, 0.05]), 0.9 * _nostrils(anatomy, points, normals))
    lid = _lid_lines(anatomy, points)
    color = _mix(color, np.minimum(person.hair, 0.02) + np.array([0.012, 0.006, 0.005]), lid)
    brows = brow_share(person, anatomy, points) * facing
    color = _mix(color, brow_color(person), 0.85 * brows)
    return SkinPaint(np.clip(color, 0.004, 0.95), lips)


def brow_color(person: Person) -> FloatArray:
    """Brows are darker than hair, and never as light as skin."""
    return np.minimum(0.55 * person.hair, 0.35 * person.skin)


def brow_curve(anatomy: Anatomy, side: str, count: int = 24) -> FloatArray:
    """(count, 3) middle line of a brow from the nose outwards."""
    anchors = np.stack([anatomy[f"{side}_brow_{place}"] for place in ("inner", "mid", "outer")])
    return smooth_curve(anchors, count)


def brow_share(person: Person, anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Coverage by brow hair, (N,) in [0, 1]: full near the nose, tapering outwards, with strands."""
    total = np.zeros(len(points))
    for side in SIDES:
        curve = brow_curve(anatomy, side)
        distance, place = polyline_distance(points, curve)
        half = 0.0042 * anatomy.scale * person.brow_thickness * (1.0 - 0.75 * place**2)
        strands = value_noise(points / (np.array([0.0022, 0.0013, 0.0022]) * anatomy.scale), person.seed + 50)
        edge = distance / half + 0.28 * strands
        total = np.maximum(total, smoothstep(edge, 1.15, 0.55) * (0.80 + 0.2 * strands))
    return np.clip(total, 0.0, 1.0)


def lip_share(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Weight of a point in the red of the lips, by the outline seen from the front."""
    s, outline = anatomy.scale, anatomy.lip_outline
    near = _near(points, anatomy["mouth"], 0.06 * s)
    share = np.zeros(len(points))
    share[near] = smoothstep(polygon_distance(points[near, :2], outline[:, :2]), 0.0006 * s, -0.0010 * s)
    return share * (points[:, 2] > outline[:, 2].min() - 0.008 * s)


def sagging(person: Person, anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """(N,) metres along the normal between aged and young skin: jowls and bags, hollow temples and cheeks."""
    s, total = anatomy.scale, np.zeros(len(points))
    for side, sign in zip(SIDES, (1.0, -1.0)):
        corner, eye = anatomy[f"{side}_mouth_corner"], anatomy.eyes[side]
        jowl = corner + np.array([sign * 0.018, -0.024, -0.014]) * s
        total += 0.0042 * blob(points, jowl, np.array([0.011, 0.010, 0.014]) * s)
        cheek = 0.5 * (anatomy[f"{side}_cheek"] + corner) + np.array([sign * 0.016, 0.0, -0.010]) * s
        total -= 0.0030 * blob(points, cheek, np.array([0.010, 0.013, 0.014]) * s)
        bag = np.append(
            eye.lower[len(eye.lower) // 2] - np.array([0.0, 0.0085 * s]), anatomy[f"{side}_eye_inner"][2]
        )
        total += 0.0016 * blob(points, bag, np.array([0.010, 0.0035, 0.012]) * s)
        temple = anatomy[f"{side}_brow_outer"] + np.array([sign * 0.012, 0.010, -0.016]) * s
        total -= 0.0026 * blob(points, temple, np.array([0.012, 0.012, 0.016]) * s)
    return person.sag * s * total


def gloss_at_rest(person: Person, anatomy: Anatomy, points: FloatArray, lips: FloatArray) -> FloatArray:
    """(N,) factors on reflections: oily forehead, nose and chin by ``person.oil``, dull neck, moist lips."""
    s = anatomy.scale
    zone = 0.9 * blob(points, anatomy["forehead"], np.array([0.038, 0.022, 0.03]) * s)
    zone += blob(
        points, anatomy["nose_tip"] + np.array([0.0, 0.008, 0.0]) * s, np.array([0.011, 0.02, 0.02]) * s
    )
    zone += 0.6 * blob(points, anatomy["chin"] + np.array([0.0, 0.006, 0.0]) * s, 0.012 * s)
    for side in SIDES:
        zone += 0.5 * blob(points, anatomy[f"{side}_cheek"] + np.array([0.0, 0.008, 0.0]) * s, 0.015 * s)
    pores = 1.0 + 0.25 * fractal_noise(points, 0.005 * s, person.seed + 99, 2)
    return (0.6 + person.oil * np.minimum(zone, 1.2)) * pores * (1.0 - lips) + 1.3 * lips


def _mix(color: FloatArray, other: FloatArray, share: FloatArray) -> FloatArray:
    return color + share[:, None] * (other - color)


def _near(points: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    return np.linalg.norm(points - center, axis=1) < radius


def _flush(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Weight of visible blood: cheeks, nose, ears, chin."""
    s = anatomy.scale
    total = 0.9 * blob(points, anatomy["nose_tip"], 0.011 * s) + 0.35 * blob(
        points, anatomy["chin"], 0.014 * s
    )
    for side in SIDES:
        total += 0.75 * blob(points, anatomy[f"{side}_cheek"], 0.019 * s)
        total += 0.55 * blob(points, anatomy[f"{side}_ala"], 0.007 * s)
        total += 0.8 * blob(points, anatomy[f"{side}_ear"], 0.022 * s)
    return np.minimum(total, 1.0)


def _around_eyes(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Shade of the sockets: the upper lid and crease, the inner corner, the bag below."""
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        eye = anatomy.eyes[side]
        near = _near(points, np.append(eye.outline.mean(axis=0), eye.center[2] + eye.radius), 0.045 * s)
        flat = points[near, :2]
        crease, _ = polyline_distance(flat, eye.upper + np.array([0.0, 0.0055 * s]))
        bag, _ = polyline_distance(flat, eye.lower - np.array([0.0, 0.0060 * s]))
        share = 0.75 * np.exp(-0.5 * (crease / (0.0032 * s)) ** 2) + 0.38 * np.exp(
            -0.5 * (bag / (0.004 * s)) ** 2
        )
        inner = np.linalg.norm(flat - eye.upper[0], axis=1)
        total[near] = np.maximum(total[near], share + 0.5 * np.exp(-0.5 * (inner / (0.006 * s)) ** 2))
    return np.minimum(total, 1.0)


def _lid_lines(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """The roots of the lashes: a dark line along both lids, strongest on the upper."""
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        eye = anatomy.eyes[side]
        near = _near(points, np.append(eye.outline.mean(axis=0), eye.center[2] + eye.radius), 0.03 * s)
        for curve, width, strength in ((eye.upper, 0.0011, 0.95), (eye.lower, 0.0007, 0.55)):
            distance, place = polyline_distance(points[near, :2], curve)
            share = (
                strength
                * np.exp(-0.5 * (distance / (width * s)) ** 2)
                * (0.45 + 0.55 * smoothstep(place, 0.05, 0.5))
            )
            total[near] = np.maximum(total[near], share)
    return total


def _nostrils(anatomy: Anatomy, points: FloatArray, normals: FloatArray) -> FloatArray:
    """The two dark openings under the nose's tip."""
    s, total = anatomy.scale, np.zeros(len(points))
    for sign in (1.0, -1.0):
        middle = anatomy["nose_base"] + np.array([sign * 0.0068, 0.0025, 0.0]) * s
        total += blob(points, middle, np.array([0.0034, 0.0030, 0.0055]) * s)
    return np.minimum(1.6 * total, 1.0) * smoothstep(-normals[:, 1], 0.1, 0.55)


def _freckles(anatomy: Anatomy, points: FloatArray, seed: int) -> FloatArray:
    s = anatomy.scale
    where = sum(blob(points, anatomy[f"{side}_cheek"], 0.026 * s) for side in SIDES)
    where = np.minimum(where + blob(points, anatomy["nose_bridge"], 0.022 * s), 1.0)
    return 0.8 * where * spots(points, 0.0042 * s, 0.0013 * s, 0.55, seed + 21)


def stubble_share(anatomy: Anatomy, points: FloatArray, seed: int) -> FloatArray:
    """Weight of beard growth, grained as stubble."""
    s = anatomy.scale
    mouth, chin, ear = anatomy["mouth"], anatomy["chin"], anatomy["left_ear"]
    # Its upper edge rises from the mouth's corners to the hair in front of the ears.
    back = smoothstep(points[:, 2], ear[2] + 0.055 * s, ear[2] + 0.02 * s)
    edge, base = mouth[1] + (ear[1] - mouth[1]) * back, chin[1] + 0.035 * s * back
    low = smoothstep(points[:, 1], edge + 0.018 * s, edge - 0.006 * s) * smoothstep(
        points[:, 1], base - 0.03 * s, base
    )
    front = smoothstep(points[:, 2], ear[2] + 0.014 * s, ear[2] + 0.026 * s)
    cheeks = sum(blob(points, anatomy[f"{side}_cheek"], np.array([0.02, 0.026, 0.03]) * s) for side in SIDES)
    grain = 0.75 + 0.35 * value_noise(points / (0.0016 * s), seed + 60)
    return np.clip(low * front * (1.0 - 0.9 * np.minimum(cheeks, 1.0)) * grain, 0.0, 1.0)


def beard_share(person: Person, anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """(N,) coverage by a beard that is let grow: stubble's area and the upper lip, but neither lips nor what lies behind them."""
    s, mouth = anatomy.scale, anatomy["mouth"]
    upper = 0.5 * (anatomy["upper_lip_mid"] + anatomy["nose_base"]) - np.array([0.0, 0.002, 0.0]) * s
    share = np.maximum(
        stubble_share(anatomy, points, person.seed), blob(points, upper, np.array([0.020, 0.0055, 0.02]) * s)
    )
    near = _near(points, mouth, 0.07 * s)
    bare = np.zeros(len(points))
    distance = polygon_distance(points[near, :2], anatomy.lip_outline[:, :2])
    bare[near] = smoothstep(distance, 0.0022 * s, 0.0008 * s)
    behind = smoothstep(points[:, 2], mouth[2] - 0.062 * s, mouth[2] - 0.075 * s)
    bare = np.maximum(bare, behind * smoothstep(np.abs(points[:, 0]), 0.045 * s, 0.035 * s))
    return smoothstep(share, 0.22, 0.6) * (1.0 - bare)


_FOLD_WIDTH = 0.0013  # standard deviation of a line's groove, metres
_SHADE = 0.62  # darkening in the bottom of a fold of full strength


@dataclass(frozen=True, eq=False)
class Folds:
    """Groups of folds over N fine points, and flushes.

    ``height`` (G, N) metres along the normal at activation 1 (negative is a groove), ``shade`` (G, N)
    darkening in [0, 1]; ``flush`` (F, N) shares and ``tint`` (F, 3) colour factors at activation 1.
    """

    height: FloatArray
    shade: FloatArray
    flush: FloatArray
    tint: FloatArray

    def apply(self, fold: FloatArray, blood: FloatArray, albedo: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement (N,) in metres and reflectance (N, 3) of skin with folds of strengths (G,) and flushes (F,)."""
        color = albedo * (1.0 - np.clip(fold @ self.shade, 0.0, 0.9))[:, None] ** np.array([0.85, 1.1, 1.15])
        change = (blood[:, None] * self.flush).T @ np.log(self.tint)
        return fold @ self.height, np.clip(color * np.exp(change), 0.003, 0.95)


FOLDS = (
    *("forehead_mid", "forehead_left", "forehead_right", "glabella", "crow_left", "crow_right"),
    *("nasolabial_left", "nasolabial_right", "bunny", "under_eye_left", "under_eye_right"),
    *("chin", "dimple_left", "dimple_right", "lip_lines", "neck"),
)
FLUSHES = {
    "cheeks": (1.04, 0.83, 0.84),
    "forehead_pale": (1.10, 1.17, 1.18),
    "lips_pale": (1.05, 1.55, 1.5),
    "lips_full": (0.92, 0.62, 0.66),
    "anger": (1.04, 0.84, 0.85),
    "nose": (1.04, 0.80, 0.82),
}


def flush_strengths(a: Activations) -> FloatArray:
    """(F,) activation of each flush, from semantic controls."""
    smile = 0.5 * (a["smile_left"] + a["smile_right"])
    down = 0.5 * (a["brow_down_left"] + a["brow_down_right"])
    strengths = {
        "cheeks": smile + 0.7 * a["cheek_puff"],
        "forehead_pale": max(a["brow_inner_up"], 0.5 * (a["brow_outer_up_left"] + a["brow_outer_up_right"])),
        "lips_pale": max(a["lip_press"], 0.6 * smile, 0.6 * a["mouth_stretch_left"]),
        "lips_full": a["pucker"],
        "anger": down,
        "nose": 0.5 * (a["nose_sneer_left"] + a["nose_sneer_right"]),
    }
    return np.clip([strengths[name] for name in FLUSHES], 0.0, 1.2)


def make_folds(
    person: Person, anatomy: Anatomy, points: FloatArray, lips: FloatArray, bare: FloatArray
) -> Folds:
    """Define the folds on the neutral fine skin, (N, 3) points. ``lips`` (N,) is the share of the lips' red; ``bare``
    (N,) is 0 where hair hides the skin."""
    sketch = _Sketch(person, anatomy, points)
    groups = sketch.groups()
    height = np.stack([groups[name][0] for name in FOLDS]) * (person.lines * person.dynamics)
    shade = np.stack([groups[name][1] for name in FOLDS]) * (np.minimum(person.lines, 1.15) * person.dynamics)
    keep = (1.0 - 0.9 * lips) * bare
    keep_lip_lines = np.where(np.array([name == "lip_lines" for name in FOLDS])[:, None], 1.0, keep)
    flush = np.stack([sketch.flush(name, lips) for name in FLUSHES]) * (bare * person.dynamics)
    tint = np.array(list(FLUSHES.values()))
    return Folds(height * keep_lip_lines, shade * keep_lip_lines, flush, tint)


class _Sketch:
    """Draws groups of folds as (height, shade) pairs."""

    def __init__(self, person: Person, anatomy: Anatomy, points: FloatArray):
        self.person, self.anatomy, self.points, self.s = person, anatomy, points, anatomy.scale
        self._front = cKDTree(points)

    def groups(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        regions = self._forehead() | {"glabella": self._glabella(), "bunny": self._bunny()}
        regions |= {"chin": self._chin(), "lip_lines": self._lip_lines(), "neck": self._neck()}
        for side, sign in zip(SIDES, (1.0, -1.0)):
            regions[f"crow_{side}"] = self._crow(side, sign)
            regions[f"nasolabial_{side}"] = self._nasolabial(side, sign)
            regions[f"under_eye_{side}"] = self._under_eye(side)
            regions[f"dimple_{side}"] = self._dimple(side, sign)
        return regions

    def flush(self, name: str, lips: FloatArray) -> FloatArray:
        a, p, s = self.anatomy, self.points, self.s
        face = blob(p, a["nose_bridge"], np.array([0.055, 0.075, 0.05]) * s) * (1.0 - lips)
        if name == "cheeks":
            return np.minimum(sum(blob(p, a[f"{side}_cheek"], 0.020 * s) for side in SIDES), 1.0)
        if name == "forehead_pale":
            return blob(p, a["forehead"], np.array([0.045, 0.022, 0.04]) * s)
        if name in ("lips_pale", "lips_full"):
            return lips
        if name == "nose":
            return blob(p, a["nose_tip"], 0.014 * s)
        return face

    def _lines(
        self, lines: list[FloatArray], depth: float, width: float = _FOLD_WIDTH, bulge: float = 0.35
    ) -> tuple[FloatArray, FloatArray]:
        """Grooves along polylines that lie near the skin, fading at their ends, with raised banks."""
        height, shade = np.zeros(len(self.points)), np.zeros(len(self.points))
        for line in lines:
            _, nearest = self._front.query(line)
            on_skin = self.points[nearest]
            near = np.flatnonzero(
                np.linalg.norm(self.points - on_skin.mean(axis=0), axis=1)
                < np.linalg.norm(on_skin - on_skin.mean(axis=0), axis=1).max() + 8.0 * width * self.s
            )
            distance, place = polyline_distance(self.points[near], on_skin)
            end = smoothstep(place, 0.0, 0.22) * smoothstep(place, 1.0, 0.72)
            x = distance / (width * self.s)
            groove = np.exp(-0.5 * x * x)
            banks = np.exp(-0.5 * ((x - 2.6) / 1.2) ** 2)
            profile = depth * self.s * end * (bulge * banks - groove)
            height[near] = np.where(np.abs(profile) > np.abs(height[near]), profile, height[near])
            shade[near] = np.maximum(shade[near], _SHADE * end * np.exp(-0.5 * (x / 0.9) ** 2))
        return height, shade

    def _wobble(self, number: int, count: int) -> FloatArray:
        """Smooth irregularity in [-1, 1] along a line."""
        t = np.linspace(0.0, 3.0, count)
        return value_noise(
            np.stack([t, np.full(count, 3.1 * number), np.zeros(count)], 1), self.person.seed + 90
        )

    def _forehead(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        a, s = self.anatomy, self.s
        low = a["glabella"][1] + 0.013 * s
        wide = 1.05 * abs(a["left_brow_outer"][0])
        lines = []
        for number in range(4):
            x = np.linspace(-wide, wide, 41)
            arch = 0.0035 * np.cos(np.pi * x / wide) ** 2 + 0.0018 * self._wobble(number, 41)
            y = low + (0.0105 * number + 0.002) * s + arch * s
            cut = np.abs(x) < wide * (1.0 - 0.10 * number)
            z = np.array([a["glabella"][2] - 0.35 * x[i] ** 2 / wide for i in range(41)])
            lines.append(np.stack([x, y, z], axis=1)[cut])
        height, shade = self._lines(lines, 0.0009, bulge=0.2)
        x = self.points[:, 0]
        left = smoothstep(x, 0.006 * s, 0.026 * s)
        right = smoothstep(x, -0.006 * s, -0.026 * s)
        parts = {"forehead_mid": 1.0 - left - right, "forehead_left": left, "forehead_right": right}
        return {name: (height * share, shade * share) for name, share in parts.items()}

    def _glabella(self) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        lines = []
        for sign, tilt in ((1.0, 0.30), (-1.0, 0.22)):
            y = np.linspace(-0.010, 0.013, 15) * s
            x = sign * (0.0062 * s + tilt * y * 0.4)
            lines.append(np.stack([x, a["glabella"][1] + y, np.full(15, a["glabella"][2])], axis=1))
        x = np.linspace(-0.010, 0.010, 11) * s
        lines.append(
            np.stack([x, np.full(11, a["nose_bridge"][1] + 0.004 * s), np.full(11, a["nose_bridge"][2])], 1)
        )
        return self._lines(lines, 0.0014, 0.0014)

    def _crow(self, side: str, sign: float) -> tuple[FloatArray, FloatArray]:
        corner = self.anatomy[f"{side}_eye_outer"]
        lines = []
        for number, angle in enumerate(np.radians([34.0, 12.0, -10.0, -32.0])):
            reach = np.linspace(0.006, 0.026 - 0.002 * abs(number - 1.5), 13) * self.s
            bend = 0.0010 * self.s * self._wobble(10 + number, 13)
            line = corner + np.stack(
                [sign * reach * np.cos(angle), reach * np.sin(angle) + bend, -0.75 * reach], 1
            )
            lines.append(line)
        height, shade = self._lines(lines, 0.0005, 0.0009, bulge=0.2)
        return height, 0.45 * shade

    def _nasolabial(self, side: str, sign: float) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        ala, corner = a[f"{side}_ala"], a[f"{side}_mouth_corner"]
        line = smooth_curve(
            np.stack(
                [
                    ala + np.array([sign * 0.003, 0.006, 0.0]) * s,
                    0.55 * ala + 0.45 * corner + np.array([sign * 0.007, 0.002, 0.0]) * s,
                    corner + np.array([sign * 0.010, 0.002, 0.0]) * s,
                    corner + np.array([sign * 0.011, -0.012, -0.002]) * s,
                ]
            ),
            25,
        )
        height, shade = self._lines([line], 0.0020, 0.0021, bulge=0.5)
        cheek = blob(self.points, a[f"{side}_cheek"], 0.014 * s)
        return height + 0.0012 * s * cheek, 0.5 * shade

    def _bunny(self) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        lines = []
        for sign in (1.0, -1.0):
            for number in range(3):
                start = a["nose_bridge"] + np.array([sign * 0.004, -0.002 - 0.0055 * number, 0.0]) * s
                reach = np.linspace(0.0, 1.0, 9)[:, None]
                lines.append(start + reach * np.array([sign * 0.010, 0.0065, -0.008]) * s)
        return self._lines(lines, 0.0009, 0.0011)

    def _under_eye(self, side: str) -> tuple[FloatArray, FloatArray]:
        eye, s = self.anatomy.eyes[side], self.s
        z = self.anatomy[f"{side}_eye_inner"][2]
        lines = []
        for drop in (0.0055, 0.0095):
            curve = eye.lower[4:-3:2] - np.array([0.0, drop * s])
            lines.append(np.concatenate([curve, np.full((len(curve), 1), z)], axis=1))
        return self._lines(lines, 0.0007, 0.0011)

    def _chin(self) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        where = blob(
            self.points, a["chin"] + np.array([0.0, 0.012, 0.002]) * s, np.array([0.014, 0.010, 0.015]) * s
        )
        pits = smoothstep(value_noise(self.points / (0.0042 * s), self.person.seed + 91), 0.05, 0.6)
        return -0.0011 * s * where * pits, 0.45 * where * pits

    def _dimple(self, side: str, sign: float) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        corner = a[f"{side}_mouth_corner"]
        line = corner + np.linspace(-1.0, 1.0, 9)[:, None] * np.array([0.0, 0.007, 0.0]) * s
        return self._lines([line + np.array([sign * 0.0045, 0.001, 0.0]) * s], 0.0010, 0.0016)

    def _lip_lines(self) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        around = blob(self.points, a["mouth"], np.array([0.020, 0.013, 0.02]) * s)
        angle = np.arctan2(self.points[:, 1] - a["mouth"][1], self.points[:, 0] - a["mouth"][0])
        ray = smoothstep(
            np.cos(26.0 * angle + 1.5 * value_noise(self.points / (0.006 * s), self.person.seed + 92)),
            0.1,
            1.0,
        )
        return -0.0006 * s * around * ray, 0.40 * around * ray

    def _neck(self) -> tuple[FloatArray, FloatArray]:
        a, s = self.anatomy, self.s
        where = blob(
            self.points, a["chin"] + np.array([0.0, -0.055, -0.03]) * s, np.array([0.045, 0.028, 0.045]) * s
        )
        bands = np.cos(self.points[:, 0] / (0.0085 * s)) * smoothstep(
            a["chin"][1] - self.points[:, 1], 0.0, 0.02 * s
        )
        return 0.0014 * s * where * bands, 0.18 * where * smoothstep(-bands, 0.0, 1.0)
