"""Teeth, gums and tongue: what shows when the mouth opens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from .anatomy import Anatomy
from .curves import ramp
from .noise import value_noise
from .people import Person

_TEETH = np.array([0.80, 0.74, 0.63])
_GUMS = np.array([0.42, 0.13, 0.12])
_TONGUE = np.array([0.45, 0.15, 0.14])
_NECK_JOINT, _JAW_JOINT = 1, 2
_TRACKED: Mapping[str, tuple[FloatArray, str]] = {
    "teeth": (_TEETH, "teeth"),
    "gums_and_tongue": (_GUMS, "gums"),
}


@dataclass(frozen=True, eq=False)
class MouthPart:
    """A mesh in the mouth that the tracked mesh lacks.

    ``vertices`` (n, 3) at rest and ``out`` (n, 3), the same with the tongue put out; ``weights`` (n, J) bind
    it to the joints; ``albedo`` (n, 3) is linear.
    """

    name: str
    vertices: FloatArray
    out: FloatArray
    faces: IntArray
    albedo: FloatArray
    weights: FloatArray
    material: str

    def at(self, tongue_out: float) -> FloatArray:
        """Rest vertices for a tongue that is out by a share in [0, 1]."""
        return self.vertices + tongue_out * (self.out - self.vertices)


@dataclass(frozen=True, eq=False)
class TrackedPart:
    """Triangles of the tracked mesh that are no skin: ``vertices`` (n,) numbers them, ``faces`` (m, 3) are local."""

    name: str
    vertices: IntArray
    faces: IntArray
    albedo: FloatArray
    material: str


def tracked_parts(head: HeadAsset) -> tuple[TrackedPart, ...]:
    """Teeth and gums that belong to the tracked mesh."""
    made = []
    for region, (color, material) in _TRACKED.items():
        if region not in head.regions:
            continue
        faces = head.faces[np.isin(head.faces, head.regions[region]).all(axis=1)]
        used, local = np.unique(faces, return_inverse=True)
        made.append(TrackedPart(region, used, local.reshape(-1, 3), np.tile(color, (len(used), 1)), material))
    return tuple(made)


def tongue(person: Person, anatomy: Anatomy, joints: int) -> MouthPart:
    """A tongue that lies behind the lower teeth and can be put out over the lower lip; it follows the jaw."""
    s, mouth = anatomy.scale, anatomy["mouth"]
    along, around = 26, 20
    u = np.linspace(0.0, 1.0, along)
    phi = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    uu, pp = (grid.ravel() for grid in np.meshgrid(u, phi, indexing="ij"))
    section = np.sqrt(np.clip(1.0 - np.clip((uu - 0.72) / 0.28, 0.0, 1.0) ** 2.4, 0.0, 1.0))
    groove = 0.0016 * np.exp(-0.5 * (np.cos(pp) / 0.22) ** 2) * (np.sin(pp) > 0) * ramp(uu, 0.1, 0.4)

    def body(
        back: FloatArray, length: float, bend: float, half_width: float, half_height: float
    ) -> FloatArray:
        # The middle line runs straight over the lower teeth and lip, then turns down by ``bend`` radians.
        turn = bend * ramp(u, 0.62, 1.0)
        z = np.concatenate([[0.0], np.cumsum(np.cos(turn[1:]))]) * length / (along - 1)
        y = -np.concatenate([[0.0], np.cumsum(np.sin(turn[1:]))]) * length / (along - 1)
        turn, z, y = (np.repeat(line, around) for line in (turn, z, y))
        thick = half_height * section * np.sin(pp) - groove
        x = half_width * section * np.cos(pp)
        return back + s * np.stack([x, y + thick * np.cos(turn), z + thick * np.sin(turn)], axis=1)

    inside = body(mouth + np.array([0.0, -0.014, -0.062]) * s, 0.043, 0.0, 0.019, 0.007)
    out = body(mouth + np.array([0.0, -0.0045, -0.050]) * s, 0.084, 1.15, 0.0180, 0.0050)
    index = np.arange(along * around).reshape(along, around)
    a, b = index[:-1], index[1:]
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate(
        [np.stack([a, a1, b1], -1).reshape(-1, 3), np.stack([a, b1, b], -1).reshape(-1, 3)]
    )
    buds = 1.0 + 0.14 * value_noise(inside / (0.0014 * s), person.seed + 95)
    weights = np.zeros((len(inside), joints))
    weights[:, _JAW_JOINT] = ramp(uu, -0.3, 0.35)
    weights[:, _NECK_JOINT] = 1.0 - weights[:, _JAW_JOINT]
    return MouthPart("tongue", inside, out, faces, _TONGUE * buds[:, None], weights, "tongue")


def teeth(anatomy: Anatomy, joints: int) -> tuple[MouthPart, MouthPart]:
    """Upper and lower teeth in their gums, on arches fitted behind the lips; upper ones hang on the head."""
    s, outline = anatomy.scale, anatomy.lip_outline
    wide = min(0.5 * float(np.ptp(outline[:, 0])), 0.028 * s) - 0.002 * s
    contact = anatomy["left_mouth_corner"][1] * 0.5 + anatomy["right_mouth_corner"][1] * 0.5
    front = outline[:, 2].max() - 0.0115 * s
    made = []
    for name, sign, joint, back in (
        ("teeth_upper", 1.0, _NECK_JOINT, 0.0),
        ("teeth_lower", -1.0, _JAW_JOINT, 0.0024),
    ):
        made.append(
            _arch(name, sign, joint, wide - back * s, contact - 0.0004 * s, front - back * s, s, joints)
        )
    return made[0], made[1]


def _arch(
    name: str, sign: float, joint: int, wide: float, edge: float, front: float, s: float, joints: int
) -> MouthPart:
    """A sheet bent along a dental arch: crowns from the biting edge, gums above them (``sign`` +1 is up)."""
    count, columns, rows = 14, 12, 22
    u = np.linspace(-1.0, 1.0, count * columns + 1)
    v = np.linspace(0.0, 1.0, rows)
    vv, uu = (grid.ravel() for grid in np.meshgrid(v, u, indexing="ij"))
    # Front teeth are wider on screen than molars: equal steps of angle on an ellipse of arch 52 by 46 mm.
    angle = 0.5 * np.pi * uu * 0.96
    tooth = np.abs(np.mod((uu + 1.0) * 0.5 * count, 1.0) * 2.0 - 1.0)  # 0 amid a tooth, 1 between two
    crown = 0.0088 * (1.0 - 0.22 * np.abs(uu))  # height of the crown, metres
    gum_line = crown * (0.86 + 0.14 * (1.0 - tooth**2))
    height = 0.0175 * vv
    on_gum = ramp(height - gum_line, -0.0002, 0.0004)
    bulge = (1.0 - on_gum) * (
        0.0011 * (1.0 - tooth**4) - 0.0009 * ramp(height, 0.0018, 0.0)
    ) + on_gum * 0.0009
    ragged = (1.0 - on_gum) * 0.0007 * tooth**3
    x = (wide + bulge * s) * np.sin(angle)
    z = front - 0.046 * s * (1.0 - np.cos(angle)) + bulge * s * np.cos(angle)
    y = edge + sign * s * (np.maximum(height, ragged) - (0.0016 if sign > 0 else 0.0002))
    vertices = np.stack([x, y, z], axis=1)
    index = np.arange(len(vertices)).reshape(rows, len(u))
    a, b, c, d = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    gap = 1.0 - 0.75 * ramp(tooth, 0.86, 1.0)
    color = _TEETH * (gap * (0.85 + 0.15 * ramp(height, 0.008, 0.002)))[:, None]
    color = color + on_gum[:, None] * (_GUMS - color)
    weights = np.zeros((len(vertices), joints))
    weights[:, joint] = 1.0
    return MouthPart(name, vertices, vertices, faces if sign > 0 else faces[:, ::-1], color, weights, "teeth")
