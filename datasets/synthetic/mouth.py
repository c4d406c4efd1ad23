"""Teeth, gums and tongue: what shows when the mouth opens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ..head.geometry import smoothstep
from ..head.procedural.parts import render_parts
from .anatomy import Anatomy
from .noise import value_noise
from .people import Person

_TEETH = np.array([0.80, 0.74, 0.63])
_GUMS = np.array([0.42, 0.13, 0.12])
_TONGUE = np.array([0.45, 0.15, 0.14])
_NECK_JOINT, _JAW_JOINT = 1, 2
_LIP_ON_JAW = 0.9  # how much of the jaw's motion the lower lip, and the tongue on it, follow
_TRACKED: Mapping[str, tuple[FloatArray, str]] = {
    "teeth": (_TEETH, "teeth"),
    "gums_and_tongue": (_GUMS, "gums"),
}


@dataclass(frozen=True, eq=False)
class MouthPart:
    """A mesh in the mouth that the tracked mesh lacks.

    ``vertices`` (n, 3) at rest and ``out`` (n, 3), the same with the tongue put out; ``weights`` (n, J) bind
    it to the joints; ``albedo`` (n, 3) is linear. ``lift`` is how far (metres) the way out arches over the
    straight line from one to the other.
    """

    name: str
    vertices: FloatArray
    out: FloatArray
    faces: IntArray
    albedo: FloatArray
    weights: FloatArray
    material: str
    lift: float = 0.0

    def at(self, tongue_out: float) -> FloatArray:
        """Rest vertices for a tongue that is out by a share in [0, 1]."""
        arch = np.array([0.0, 4.0 * tongue_out * (1.0 - tongue_out) * self.lift, 0.0])
        return self.vertices + tongue_out * (self.out - self.vertices) + arch


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
    groove = 0.0016 * np.exp(-0.5 * (np.cos(pp) / 0.22) ** 2) * (np.sin(pp) > 0) * smoothstep(uu, 0.1, 0.4)

    def body(
        back: FloatArray, length: float, bend: float, half_width: float, half_height: float
    ) -> FloatArray:
        # The middle line runs straight over the lower teeth and lip, then turns down by ``bend`` radians.
        turn = bend * smoothstep(u, 0.62, 1.0)
        z = np.concatenate([[0.0], np.cumsum(np.cos(turn[1:]))]) * length / (along - 1)
        y = -np.concatenate([[0.0], np.cumsum(np.sin(turn[1:]))]) * length / (along - 1)
        turn, z, y = (np.repeat(line, around) for line in (turn, z, y))
        thick = half_height * section * np.sin(pp) - groove
        x = half_width * section * np.cos(pp)
        return back + s * np.stack([x, y + thick * np.cos(turn), z + thick * np.sin(turn)], axis=1)

    inside = body(mouth + np.array([0.0, -0.010, -0.062]) * s, 0.043, 0.0, 0.019, 0.007)
    # Its underside slides over the lower lip's rim, which ends where the lips meet, and not through the lip.
    out = body(mouth + np.array([0.0, 0.006, -0.050]) * s, 0.084, 1.15, 0.0180, 0.0050)
    index = np.arange(along * around).reshape(along, around)
    a, b = index[:-1], index[1:]
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate(
        [np.stack([a, a1, b1], -1).reshape(-1, 3), np.stack([a, b1, b], -1).reshape(-1, 3)]
    )
    buds = 1.0 + 0.14 * value_noise(inside / (0.0014 * s), person.seed + 95)
    weights = np.zeros((len(inside), joints))
    weights[:, _JAW_JOINT] = _LIP_ON_JAW * smoothstep(uu, -0.3, 0.35)
    weights[:, _NECK_JOINT] = 1.0 - weights[:, _JAW_JOINT]
    return MouthPart("tongue", inside, out, faces, _TONGUE * buds[:, None], weights, "tongue", 0.008 * s)


def procedural_parts(person: Person, head: HeadAsset, shape: FloatArray) -> tuple[MouthPart, ...]:
    """Teeth, gums and tongue that come with the procedural head, for a subject's identity (S,)."""
    colors = {"teeth": _TEETH, "gums": _GUMS, "tongue": _TONGUE}
    made = []
    for part, out in zip(render_parts(head, shape), render_parts(head, shape, tongue_out=1.0)):
        mottled = 1.0 + 0.08 * value_noise(part.vertices / 0.0014, person.seed + 95)
        albedo = colors[part.material] * mottled[:, None]
        made.append(
            MouthPart(
                part.name,
                part.vertices,
                out.vertices,
                part.faces,
                albedo,
                part.skinning_weights,
                part.material,
            )
        )
    return tuple(made)
