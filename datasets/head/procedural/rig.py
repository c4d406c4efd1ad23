"""How the surface hangs on its joints: skinning weights, joint regressor, pose correctives."""

from __future__ import annotations

import numpy as np

from ....bench.contracts import FloatArray
from ..geometry import smoothstep
from .anatomy import EYE_CENTER, FLOOR, MOUTH_HALF_WIDTH, lip_arc
from .surface import MIRROR, Surface

PARENTS = np.array([-1, 0, 1, 1, 1])
ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)
JOINTS = np.array(
    [[0, -0.165, -0.052], [0, -0.080, -0.030], [0, 0.000, -0.004], EYE_CENTER, EYE_CENTER * MIRROR]
)


def jaw_weight(surface: Surface) -> FloatArray:
    """(V,) share of the jaw: the lower lip and chin wholly, fading over cheek, throat and mouth."""
    x, y, z = surface.vertices.T
    u = np.abs(x) / MOUTH_HALF_WIDTH
    around = np.arctan2(np.abs(x), z + 0.002)  # 0.36 at the corner of the mouth, about 1.4 at the jaw's angle
    rise = 0.022 * smoothstep(around, 0.36, 1.4)
    below = rise - surface.above_slit
    # The lips part like a cut in the middle; towards the corners and the cheek the change is gradual.
    width = 0.0002 + 0.0075 * smoothstep(u, 0.74, 1.05) + 0.022 * smoothstep(around, 0.36, 0.80)
    depth = 0.0002 + 0.0095 * smoothstep(lip_arc(x) - z, 0.012, 0.050)
    width = np.where(surface.in_mouth & (u < 0.97), np.maximum(depth, width), width)
    weight = smoothstep(below, -width, width)
    under = 0.900 * (y + 0.096) + 0.436 * (z - 0.058)
    weight = weight * (1 - smoothstep(-under, 0.002, 0.052))
    weight = weight * smoothstep(z, -0.034, 0.012)
    return weight * surface.skin * (1 - surface.in_socket)


def skinning_weights(surface: Surface) -> FloatArray:
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


def joint_regressor(surface: Surface) -> FloatArray:
    """(5, V) rows of sum 1 that give `JOINTS` at rest.

    Each row is the evenest weighting of some vertices around its joint that reproduces it exactly; an eye's
    joint is the mean of its ball.
    """
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
        rows = np.vstack([np.ones(len(support)), vertices[support].T])
        even = np.full(len(support), 1 / len(support))
        missing = np.concatenate([[1], JOINTS[joint]]) - rows @ even
        regressor[joint, support] = even + np.linalg.pinv(rows) @ missing
    return regressor


def pose_basis(surface: Surface) -> FloatArray:
    """(V, 3, 36) correctives: as the jaw opens the cheeks hollow and the corners of the mouth draw in.

    They follow the sine of the opening angle, from the entries (2, 1) and (1, 2) of the jaw's R - I.
    """
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
