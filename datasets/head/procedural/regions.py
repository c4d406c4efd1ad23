"""Regions by the names of ``FLAME_masks.pkl``, the rings of the lips, and named landmarks."""

from __future__ import annotations

import numpy as np

from ....bench.contracts import IntArray
from ..geometry import border_edges
from .anatomy import (
    EYE_CENTER,
    FLOOR,
    LATERAL_CANTHUS,
    LIP_RING_HEIGHT,
    LIP_RING_REACH,
    MEDIAL_CANTHUS,
    MOUTH_HALF_WIDTH,
    canthal_height,
    lip_arc,
    lip_contour,
    slit_height,
)
from .cranium import head_mass
from .features import EAR_ORIGIN
from .surface import Surface

RING_LENGTH = 15

# Landmarks seen from the front: (x, y) of the left one where there are two.
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


def regions(surface: Surface) -> dict[str, IntArray]:
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


def lip_rings(surface: Surface) -> tuple[IntArray, IntArray]:
    """Upper and lower ring, `RING_LENGTH` vertices each from the right corner of the mouth to the left."""
    across = MOUTH_HALF_WIDTH * np.linspace(-LIP_RING_REACH, LIP_RING_REACH, RING_LENGTH)
    depth = lip_arc(across) + 0.004
    rings = []
    for side in (1, -1):
        candidates = np.flatnonzero(surface.outside & (surface.above_slit * side > 0))
        targets = np.column_stack([across, slit_height(across) + side * LIP_RING_HEIGHT, depth])
        rings.append(np.array([surface.nearest(target, candidates) for target in targets]))
    return rings[0], rings[1]


def landmarks(surface: Surface) -> dict[str, int]:
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
