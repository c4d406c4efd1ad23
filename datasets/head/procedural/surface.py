"""The sculpted surface at rest: skin and eyeballs, with vertex properties for the rig."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....bench.contracts import FloatArray, IntArray
from ....bench.io.arrays import Member, read_arrays
from ..geometry import border_edges, even_weights, smoothstep, vertex_normals
from .sculpture import (
    EAR_ORIGIN,
    EYE_CENTER,
    EYE_RADIUS,
    FLOOR,
    LATERAL_CANTHUS,
    LID_CLEARANCE,
    LIP_RING_HEIGHT,
    LIP_RING_REACH,
    MEDIAL_CANTHUS,
    MOUTH_CAVITY,
    MOUTH_HALF_WIDTH,
    canthal_height,
    head_mass,
    lip_arc,
    lip_contour,
    slit_height,
)

MIRROR = np.array([-1.0, 1.0, 1.0])
PACKAGED = Path(__file__).with_name("head.npz")


@dataclass(frozen=True, eq=False)
class SculptedHead:
    """Skin, left eyeball, right eyeball, in this order."""

    vertices: FloatArray
    """(V, 3) float64, metres."""
    faces: IntArray
    """(F, 3) int64, counter-clockwise seen from outside."""
    mirror: IntArray
    """(V,) index of the mirror image of each vertex."""
    skin_count: int
    """Number of skin vertices; each eyeball has half of the rest."""

    @cached_property
    def eyeballs(self) -> tuple[IntArray, IntArray]:
        """Vertices of the left and the right eyeball."""
        left, right = np.split(np.arange(self.skin_count, len(self.vertices)), 2)
        return left, right

    @cached_property
    def skin(self) -> FloatArray:
        """(V,) 1 on the skin, 0 on the eyeballs."""
        return (np.arange(len(self.vertices)) < self.skin_count).astype(float)

    @cached_property
    def in_mouth(self) -> NDArray[np.bool_]:
        """(V,) bool: on the wall of the mouth's cavity."""
        center, radii = (np.asarray(part) for part in MOUTH_CAVITY)
        inside = np.linalg.norm((self.vertices - center) / (radii + 0.0012), axis=1) < 1
        return inside & (self.skin > 0)

    @cached_property
    def in_socket(self) -> NDArray[np.bool_]:
        """(V,) bool: on the wall of the cavity behind a lid."""
        from_eye = np.linalg.norm(
            np.abs(self.vertices) * [1, 0, 0] + self.vertices * [0, 1, 1] - EYE_CENTER, axis=1
        )
        return (from_eye < EYE_RADIUS + LID_CLEARANCE + 0.0004) & (self.skin > 0)

    @cached_property
    def outside(self) -> NDArray[np.bool_]:
        """(V,) bool: skin that is seen from outside."""
        return (self.skin > 0) & ~self.in_mouth & ~self.in_socket

    @cached_property
    def above_slit(self) -> FloatArray:
        """(V,) height over the line between the lips, metres."""
        return self.vertices[:, 1] - slit_height(self.vertices[:, 0])

    @cached_property
    def normals(self) -> FloatArray:
        """(V, 3) unit normals, outward, weighted by area."""
        return vertex_normals(self.vertices, self.faces)

    def mirrored(self, field: FloatArray) -> FloatArray:
        """A displacement field (V, 3), or values (V,), mirrored to the other side."""
        return field[self.mirror] * MIRROR if field.ndim == 2 else field[self.mirror]

    def nearest(self, point: FloatArray, among: IntArray | None = None) -> int:
        """Vertex nearest to a point, among those outside by default."""
        candidates = np.flatnonzero(self.outside) if among is None else among
        return int(candidates[np.argmin(np.linalg.norm(self.vertices[candidates] - point, axis=1))])


def eyeball() -> tuple[FloatArray, IntArray]:
    """Unit sphere around the z axis, a pole in front: vertices (2 + (rings-1) sectors, 3) and triangles."""
    rings, sectors = 16, 24
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    body = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], -1
    )
    vertices = np.concatenate([[[0, 0, 1]], body.reshape(-1, 3), [[0, 0, -1]]])
    here = np.arange(sectors)
    after = (here + 1) % sectors
    last = len(vertices) - 1
    triangles = [np.column_stack([0 * here, 1 + here, 1 + after])]
    for ring in range(rings - 2):
        a, b = 1 + ring * sectors, 1 + (ring + 1) * sectors
        triangles += [np.column_stack([a + here, b + here, b + after])]
        triangles += [np.column_stack([a + here, b + after, a + after])]
    base = 1 + (rings - 2) * sectors
    triangles.append(np.column_stack([base + here, 0 * here + last, base + after]))
    return vertices, np.concatenate(triangles)


def assemble(skin: FloatArray, faces: IntArray, mirror: IntArray) -> SculptedHead:
    """Add the eyeballs to the skin."""
    ball, triangles = eyeball()
    left = EYE_CENTER + EYE_RADIUS * ball
    right = left * MIRROR
    start, size = len(skin), len(ball)
    return SculptedHead(
        vertices=np.concatenate([skin, left, right]),
        faces=np.concatenate([faces, start + triangles, start + size + triangles[:, ::-1]]).astype(np.int64),
        mirror=np.concatenate([mirror, start + size + np.arange(size), start + np.arange(size)]),
        skin_count=start,
    )


def load_sculpture(path: Path = PACKAGED) -> SculptedHead:
    """The surface that `sculpt` wrote: the packaged one, or the one at ``path``."""
    members = {
        "vertices": Member("f", ("V", 3)),
        "faces": Member("iu", ("F", 3)),
        "mirror": Member("iu", ("V",)),
    }
    stored = read_arrays(path, members)
    vertices, faces, mirror = (stored[name] for name in members)
    return assemble(vertices.astype(np.float64), faces.astype(np.int64), mirror.astype(np.int64))


PARENTS = np.array([-1, 0, 1, 1, 1])
ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)
JOINTS = np.array(
    [[0, -0.165, -0.052], [0, -0.080, -0.030], [0, 0.000, -0.004], EYE_CENTER, EYE_CENTER * MIRROR]
)


def jaw_weight(surface: SculptedHead) -> FloatArray:
    """(V,) weight of the jaw: 1 at the lower lip and chin, decreasing over cheek, throat and mouth."""
    x, y, z = surface.vertices.T
    u = np.abs(x) / MOUTH_HALF_WIDTH
    around = np.arctan2(np.abs(x), z + 0.002)  # 0.36 at the corner of the mouth, about 1.4 at the jaw's angle
    rise = 0.022 * smoothstep(around, 0.36, 1.4)
    below = rise - surface.above_slit
    # In the middle the weight jumps between the lips; towards the corners and the cheek it is gradual.
    width = 0.0002 + 0.0075 * smoothstep(u, 0.74, 1.05) + 0.022 * smoothstep(around, 0.36, 0.80)
    depth = 0.0002 + 0.0095 * smoothstep(lip_arc(x) - z, 0.012, 0.050)
    width = np.where(surface.in_mouth & (u < 0.97), np.maximum(depth, width), width)
    weight = smoothstep(below, -width, width)
    under = 0.900 * (y + 0.096) + 0.436 * (z - 0.058)
    weight = weight * (1 - smoothstep(-under, 0.002, 0.052))
    weight = weight * smoothstep(z, -0.034, 0.012)
    return weight * surface.skin * (1 - surface.in_socket)


def skinning_weights(surface: SculptedHead) -> FloatArray:
    """(V, 5) weights; rows sum to 1."""
    weights = np.zeros((len(surface.vertices), len(PARENTS)))
    head = smoothstep(surface.vertices[:, 1], FLOOR + 0.012, -0.070)
    jaw = jaw_weight(surface)
    weights[:, JAW] = jaw
    weights[:, NECK] = (1 - jaw) * head
    weights[:, ROOT] = (1 - jaw) * (1 - head)
    for joint, ball in zip((LEFT_EYE, RIGHT_EYE), surface.eyeballs, strict=True):
        weights[ball] = 0
        weights[ball, joint] = 1
    return weights


def joint_regressor(surface: SculptedHead) -> FloatArray:
    """(5, V) joint regressor, rows sum to 1, that gives `JOINTS` at rest. Each row is the most even weighting of
    vertices around its joint that reproduces it exactly; an eye's joint is the mean of its ball."""
    vertices = surface.vertices
    _x, y, z = vertices.T
    supports = {
        ROOT: np.flatnonzero(surface.outside & (np.abs(y - JOINTS[ROOT, 1]) < 0.012)),
        NECK: np.flatnonzero(surface.outside & (np.abs(y - JOINTS[NECK, 1]) < 0.014) & (z < 0.02)),
        JAW: np.flatnonzero(
            surface.outside & (np.linalg.norm(vertices[:, 1:] - JOINTS[JAW, 1:], axis=1) < 0.016)
        ),
        LEFT_EYE: surface.eyeballs[0],
        RIGHT_EYE: surface.eyeballs[1],
    }
    regressor = np.zeros((len(PARENTS), len(vertices)))
    for joint, support in supports.items():
        regressor[joint, support] = even_weights(vertices[support], JOINTS[joint])
    return regressor


def pose_basis(surface: SculptedHead) -> FloatArray:
    """(V, 3, 36) correctives: when the jaw opens, the cheeks become hollow and the corners of the mouth move inwards.
    They follow the sine of the opening angle, from the entries (2, 1) and (1, 2) of the jaw's R - I."""
    x, y, z = surface.vertices.T
    basis = np.zeros((len(surface.vertices), 3, 9 * (len(PARENTS) - 1)))
    side = np.tanh(x / 0.010)

    def near(center: tuple[float, float, float], sigma: float) -> FloatArray:
        distance = np.linalg.norm(np.column_stack([np.abs(x), y, z]) - center, axis=1)
        return np.exp(-0.5 * (distance / sigma) ** 2) * surface.skin

    corner = near((MOUTH_HALF_WIDTH, -0.052, 0.066), 0.012)
    cheek = near((0.050, -0.035, 0.040), 0.018)
    sine = np.zeros((len(x), 3))
    sine[:, 0] = -side * (0.010 * corner + 0.008 * cheek)
    sine[:, 2] = -0.006 * corner
    block = 9 * (JAW - 1)
    basis[:, :, block + 3 * 2 + 1] = 0.5 * sine
    basis[:, :, block + 3 * 1 + 2] = -0.5 * sine
    return basis


RING_LENGTH = 15

# Landmarks in front view: (x, y) of the left one for pairs.
_FRONT = {
    "nose_tip": (0, -0.0200),
    "nose_bridge": (0, 0.0200),
    "glabella": (0, 0.0410),
    "forehead_mid": (0, 0.0720),
    "subnasale": (0, -0.0315),
    "chin": (0, -0.0860),
    "upper_lip_mid": (0, lip_contour(np.zeros(1))[0][0]),
    "lower_lip_mid": (0, lip_contour(np.zeros(1))[1][0]),
}
_FRONT_PAIRED = {
    "eye_inner": (EYE_CENTER[0] + MEDIAL_CANTHUS, EYE_CENTER[1] + canthal_height(MEDIAL_CANTHUS)),
    "eye_outer": (EYE_CENTER[0] + LATERAL_CANTHUS, EYE_CENTER[1] + canthal_height(LATERAL_CANTHUS)),
    "brow_inner": (0.0120, 0.0385),
    "brow_mid": (0.0300, 0.0430),
    "brow_outer": (0.0485, 0.0370),
    "mouth_corner": (MOUTH_HALF_WIDTH, slit_height(np.array([MOUTH_HALF_WIDTH]))[0]),
    "cheek": (0.0400, -0.0160),
    "nasolabial": (0.0270, -0.0340),
    "ala": (0.0175, -0.0220),
}
# iBUG's numbers (Sagonas et al. 2013) of the lips' outer contour, as shares of the mouth's half width.
_CONTOUR = (
    {49: -0.62, 50: -0.20, 51: 0.0, 52: 0.20, 53: 0.62},
    {55: 0.62, 56: 0.28, 57: 0.0, 58: -0.28, 59: -0.62},
)


def regions(surface: SculptedHead) -> dict[str, IntArray]:
    """Vertex indices by region, sorted except for the rings, which run from the right corner to the left."""
    x, y, z = surface.vertices.T
    around = np.arctan2(np.abs(x), z + 0.020)  # 0 in front, pi behind
    hairline = np.interp(
        around, [0, 0.75, 1.10, 1.45, 1.75, 2.3], [0.086, 0.078, 0.045, 0.020, -0.010, -0.050]
    )
    under = 0.900 * (y + 0.096) + 0.436 * (z - 0.058)  # negative below the plane of the jaw
    folded = np.column_stack([np.abs(x), y, z])
    by_ear = np.all(
        np.abs(folded - np.add(EAR_ORIGIN, (0.012, 0.005, -0.012))) < (0.024, 0.040, 0.032), axis=1
    )
    ear = surface.outside & by_ear & (head_mass(folded.astype(np.float64)) > 0.0010)
    skull = surface.outside & ~ear
    face = skull & (around < 1.32) & (y < hairline + 0.004) & (under > 0)
    face |= surface.in_socket
    scalp = skull & (y > hairline)
    neck = skull & ~face & ~scalp
    from_eye = (folded - EYE_CENTER) / (0.0240, 0.0175, 0.030)
    near_eye = face & (np.linalg.norm(from_eye, axis=1) < 1)
    eyes = face & (np.abs(y - 0.022) < 0.0235) & (np.abs(x) < 0.057) & (z > 0.025)
    top, bottom = lip_contour(np.abs(x))
    red = surface.outside & (np.abs(x) < MOUTH_HALF_WIDTH + 0.0005) & (y < top) & (y > bottom) & (z > 0.055)
    inner = surface.in_mouth & (lip_arc(x) - z < 0.009) & (np.abs(x) < MOUTH_HALF_WIDTH)
    nose = face & (np.abs(x) < 0.0135 + np.clip(0.006 - y, 0, 0.02) * 0.30) & (y > -0.0325) & (y < 0.026)
    nose &= z > 0.058
    masks = {
        "face": face | red,
        "eye_region": eyes | near_eye,
        "left_eye_region": near_eye & (x > 0),
        "right_eye_region": near_eye & (x < 0),
        "forehead": face & (y > 0.048),
        "lips": red | inner,
        "nose": nose,
        "scalp": scalp,
        "neck": neck,
        "left_ear": ear & (x > 0),
        "right_ear": ear & (x < 0),
        "mouth_socket": surface.in_mouth,
    }
    named: dict[str, IntArray] = {name: np.flatnonzero(mask) for name, mask in masks.items()}
    named["left_eyeball"], named["right_eyeball"] = surface.eyeballs
    rim = np.unique(border_edges(surface.faces))
    named["boundary"] = rim[np.abs(y[rim] - FLOOR) < 1e-4]
    named["lip_outside_ring_upper"], named["lip_outside_ring_lower"] = lip_rings(surface)
    return named


def lip_rings(surface: SculptedHead) -> tuple[IntArray, IntArray]:
    """Upper and lower ring, `RING_LENGTH` vertices each from the right corner of the mouth to the left."""
    across = MOUTH_HALF_WIDTH * np.linspace(-LIP_RING_REACH, LIP_RING_REACH, RING_LENGTH)
    depth = lip_arc(across) + 0.004
    rings = []
    for side in (1, -1):
        candidates = np.flatnonzero(surface.outside & (surface.above_slit * side > 0))
        targets = np.column_stack([across, slit_height(across) + side * LIP_RING_HEIGHT, depth])
        rings.append(np.array([surface.nearest(target, candidates) for target in targets]))
    return rings[0], rings[1]


def landmarks(surface: SculptedHead) -> dict[str, int]:
    """Vertex by name; the lips' outer contour also by iBUG's numbers, ``ibug_48`` to ``ibug_59``."""
    vertices = surface.vertices
    facing = np.flatnonzero(surface.outside & (surface.normals[:, 2] > 0.1) & (vertices[:, 2] > 0.02))

    def front(x: float, y: float) -> int:
        distance = np.hypot(vertices[facing, 0] - x, vertices[facing, 1] - y)
        return int(facing[np.argmin(distance)])

    named = {name: front(*place) for name, place in _FRONT.items()}
    for name, (x, y) in _FRONT_PAIRED.items():
        named[f"left_{name}"] = front(x, y)
        named[f"right_{name}"] = int(surface.mirror[named[f"left_{name}"]])
    named["left_ear"] = surface.nearest(np.add(EAR_ORIGIN, (0.006, 0.0, 0.004)))
    named["right_ear"] = int(surface.mirror[named["left_ear"]])
    named["vertex_top"] = int(np.argmax(vertices[:, 1]))
    named["menton"] = surface.nearest(np.array([0, -0.098, 0.062]))
    named["ibug_48"], named["ibug_54"] = named["right_mouth_corner"], named["left_mouth_corner"]
    for side, numbers in enumerate(_CONTOUR):
        for number, share in numbers.items():
            x = share * MOUTH_HALF_WIDTH
            named[f"ibug_{number}"] = front(x, lip_contour(np.array([abs(x)]))[side][0])
    return named
