"""Eyeballs and parts of the mouth to render. Eyeballs are finer than the tracked ones, with painted cornea, iris and veins.

Visible but untracked parts of the mouth: teeth, gums and tongue of the default head. They are rendered in synthetic
captures and are not in the head model: as in a real capture, methods must learn them from the images. The wall of the
mouth is part of the skin (region ``mouth_socket``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ..head.geometry import smoothstep
from ..head.procedural.sculpture import resample
from ..head.procedural.surface import JAW, NECK, PARENTS
from .anatomy import Anatomy, Eye, Person, front_depth, value_noise

# Mesiodistal widths from the midline, millimetres (Wheeler's Dental Anatomy), incisors to second premolar:
# molars would intersect the wall of the mouth.
UPPER_WIDTHS = (8.5, 6.5, 7.5, 7.0, 7.0)
LOWER_WIDTHS = (5.2, 5.7, 7.0, 7.0, 7.2)
ARCH_REACH = 0.029  # half width of the dental arch, metres
COLUMNS = 7  # of vertices across a tooth
TONGUE_SECTIONS, TONGUE_SECTORS = 18, 16


@dataclass(frozen=True, eq=False)
class MouthMesh:
    """A mesh that moves with the head's joints and has no expression of its own."""

    name: str
    """"upper_teeth", "lower_teeth", "upper_gums", "lower_gums" or "tongue"."""
    vertices: FloatArray
    """(n, 3) in the neutral shape, metres."""
    faces: IntArray
    """(f, 3), counter-clockwise seen from outside."""
    skinning_weights: FloatArray
    material: str


def render_parts(
    head: HeadAsset, shape: FloatArray | None = None, tongue_out: float = 0.0
) -> list[MouthMesh]:
    """Teeth, gums and tongue of a procedural head in a subject's neutral shape.

    ``shape``: (S,) identity coefficients; the mean head if None. Parts follow the surrounding wall of the mouth.
    ``tongue_out``: 0 places the tongue behind the lower teeth, 1 over the lower lip (the jaw should be open).
    """
    meshes = {
        "upper_teeth": (*_teeth(UPPER_WIDTHS, 0.0690, edge=-0.0530, root=-0.0430), NECK, "teeth"),
        "lower_teeth": (*_teeth(LOWER_WIDTHS, 0.0662, edge=-0.0518, root=-0.0600), JAW, "teeth"),
        "upper_gums": (*_gums(0.0690, near=-0.0446, far=-0.0365), NECK, "gums"),
        "lower_gums": (*_gums(0.0662, near=-0.0587, far=-0.0650), JAW, "gums"),
        "tongue": (*tongue_mesh(tongue_out), JAW, "tongue"),
    }
    parts = []
    for name, (vertices, faces, joint, material) in meshes.items():
        if shape is not None:
            vertices = vertices + _follow(head, shape, vertices)
        weights = np.zeros((len(vertices), len(PARENTS)))
        weights[:, joint] = 1
        parts.append(MouthMesh(name, vertices, faces, weights, material))
    return parts


def dental_arch(length: FloatArray, front: float) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) at arc ``length`` from the midline along the arch, y = 0, and outward normals (n, 3). ``length`` is
    in metres and ends at ``arch_length()`` on either side."""
    x = np.linspace(-ARCH_REACH, ARCH_REACH, 401)
    px = np.interp(length, _parabola_length(x), x)
    points = np.column_stack([px, 0 * px, front - 26.0 * px**2])
    normals = np.column_stack([52.0 * px, 0 * px, np.ones_like(px)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def arch_length() -> float:
    """Length of one half of the dental arch, metres."""
    return float(_parabola_length(np.array([ARCH_REACH]))[0])


def _parabola_length(x: FloatArray) -> FloatArray:
    """Signed length of z = -26 x^2 from the vertex to ``x``, in closed form."""
    slope = 52.0 * x
    return (slope * np.sqrt(1.0 + slope**2) + np.arcsinh(slope)) / 104.0


def _teeth(
    widths: tuple[float, ...], front: float, *, edge: float, root: float
) -> tuple[FloatArray, IntArray]:
    """One row of teeth from ``root`` to ``edge`` heights along an arch, with separate convex crowns."""
    half = np.array(widths) * 1e-3
    every = np.concatenate([half[::-1], half])
    starts = np.concatenate([[0], np.cumsum(every)])[:-1] - half.sum()
    share = np.linspace(0, 1, COLUMNS, endpoint=False)  # where a tooth ends the next one begins
    length = (starts[:, None] + every[:, None] * share).ravel()
    across = np.tile(2 * share - 1, len(every))
    # 0.5, 1.5 ... from the midline
    order = np.abs(np.repeat(np.arange(len(every)) - len(half) + 0.5, COLUMNS))
    place, normal = dental_arch(length, front)
    bulge = 0.0009 * (1 - np.abs(across) ** 3)
    shorter = np.where((order > 1) & (order < 2), 0.0007, 0.0) + 0.0005 * np.abs(across) ** 4
    towards_root = np.sign(root - edge)
    rows = []
    # (share of the way from edge to root, outward offset): front from root to edge, then back up.
    for height, out in ((1.0, 0.0), (0.75, 0.0006), (0.45, 0.0008), (0.15, 0.0004), (0.0, -0.0002),
                        (0.0, -0.0012), (0.4, -0.0030), (1.0, -0.0045)):  # fmt: skip
        y = edge + height * (root - edge) + towards_root * shorter * (1 - height)
        offset = out + (bulge if out > -0.001 else -bulge)
        rows.append(place + normal * np.asarray(offset)[:, None] + np.column_stack([0 * y, y, 0 * y]))
    return _strip(rows, flip=towards_root < 0)


def _gums(front: float, *, near: float, far: float) -> tuple[FloatArray, IntArray]:
    """Gum from just above the necks of the teeth (``near``) to the roof or floor of the mouth (``far``)."""
    end = arch_length()
    place, normal = dental_arch(np.linspace(-end, end, 81), front)
    rows = []
    profile = ((1.0, -0.0010), (0.6, 0.0010), (0.2, 0.0014), (0.0, 0.0002), (0.0, -0.0046), (1.0, -0.0075))
    for height, out in profile:
        y = np.full(len(place), near + height * (far - near))
        rows.append(place + out * normal + np.column_stack([0 * y, y, 0 * y]))
    return _strip(rows, flip=far < near)


def _strip(rows: list[FloatArray], *, flip: bool) -> tuple[FloatArray, IntArray]:
    """Quads between rows of equal length, as triangles."""
    count = len(rows[0])
    base = (np.arange(len(rows) - 1)[:, None] * count + np.arange(count - 1)).ravel()
    first = np.column_stack([base, base + count, base + 1])
    faces = np.concatenate([first, np.column_stack([base + 1, base + count, base + count + 1])])
    return np.concatenate(rows), faces[:, ::-1] if flip else faces


def tongue_mesh(out: float) -> tuple[FloatArray, IntArray]:
    """Tongue from rest (0) to extended (1): a flattened tube with a groove, closed at both ends."""
    rest = np.array(
        # x, y, z of the middle, half width, half height
        [[0, -0.062, 0.016, 0.015, 0.0065], [0, -0.0565, 0.032, 0.017, 0.0072],
         [0, -0.0560, 0.048, 0.0155, 0.0058],
         [0, -0.0570, 0.0605, 0.0095, 0.0035]]
    )  # fmt: skip
    put_out = np.array(
        [[0, -0.062, 0.020, 0.015, 0.0065], [0, -0.0535, 0.045, 0.0165, 0.0062],
         [0, -0.0500, 0.068, 0.0170, 0.0048],
         [0, -0.0555, 0.094, 0.0120, 0.0036]]
    )  # fmt: skip
    path = resample((1 - out) * rest + out * put_out, TONGUE_SECTIONS)
    # Round both ends: the last few sections shrink like a half ellipse.
    end = np.minimum(np.arange(TONGUE_SECTIONS), np.arange(TONGUE_SECTIONS)[::-1])
    taper = np.sqrt(1 - (1 - np.clip((end + 0.25) / 4, 0, 1)) ** 2)
    around = np.linspace(0, 2 * np.pi, TONGUE_SECTORS, endpoint=False)
    side = np.sign(np.cos(around)) * np.abs(np.cos(around)) ** 0.8
    groove = 1 - 0.28 * np.exp(-((np.cos(around) / 0.25) ** 2)) * (np.sin(around) > 0)
    rings = [
        center + np.column_stack([share * width * side, share * height * np.sin(around) * groove, 0 * side])
        for center, width, height, share in zip(path[:, :3], path[:, 3], path[:, 4], taper, strict=True)
    ]
    vertices = np.concatenate([*rings, path[[0, -1], :3]])
    here = np.arange(TONGUE_SECTORS)
    after = (here + 1) % TONGUE_SECTORS
    faces = []
    for section in range(TONGUE_SECTIONS - 1):
        a, b = section * TONGUE_SECTORS, (section + 1) * TONGUE_SECTORS
        faces += [
            np.column_stack([a + here, a + after, b + here]),
            np.column_stack([a + after, b + after, b + here]),
        ]
    back, tip = len(vertices) - 2, len(vertices) - 1
    last = (TONGUE_SECTIONS - 1) * TONGUE_SECTORS
    faces += [
        np.column_stack([0 * here + back, after, here]),
        np.column_stack([0 * here + tip, last + here, last + after]),
    ]
    return vertices, np.concatenate(faces)


def _follow(head: HeadAsset, shape: FloatArray, points: FloatArray, reach: float = 0.012) -> FloatArray:
    """Displacement by identity at points inside the mouth: a Gaussian mean over the wall."""
    wall = head.regions["mouth_socket"]
    moved = head.shape_basis[wall] @ shape
    squared = ((points[:, None] - head.template[wall][None]) ** 2).sum(axis=2)
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / reach**2)
    return (weight / weight.sum(axis=1, keepdims=True)) @ moved


_IRIS_ANGLE = 0.485  # radians; an iris of 5.9 mm radius on a ball of 12 mm
_PUPIL_SHARE = 0.40
_CORNEA_LIFT = 0.035  # of the ball's radius


@dataclass(frozen=True, eq=False)
class EyeMesh:
    """(n, 3) vertices at rest looking along +z, (m, 3) faces, (n, 3) linear reflectance."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray


def eye_mesh(person: Person, eye: Eye) -> EyeMesh:
    """Build the ball around ``eye``, its pole on the gaze axis."""
    rings, spokes = 72, 96
    # Rings crowd where the iris is.
    polar = np.pi * np.linspace(0.0, 1.0, rings) ** 1.8
    around = np.linspace(0.0, 2.0 * np.pi, spokes, endpoint=False)
    theta, phi = np.meshgrid(polar[1:-1], around, indexing="ij")
    theta, phi = (np.concatenate([[0.0], a.ravel(), [b]]) for a, b in ((theta, np.pi), (phi, 0.0)))
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    lift = 1.0 + _CORNEA_LIFT * smoothstep(theta, 1.15 * _IRIS_ANGLE, 0.0)
    vertices = eye.center + eye.radius * lift[:, None] * unit
    return EyeMesh(vertices, _ball_faces(rings, spokes), _paint(person, eye, theta, phi, unit))


def _ball_faces(rings: int, spokes: int) -> IntArray:
    index = 1 + np.arange((rings - 2) * spokes).reshape(rings - 2, spokes)
    a, b = index[:-1], index[1:]
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    strips = [np.stack([a, b, b1], -1).reshape(-1, 3), np.stack([a, b1, a1], -1).reshape(-1, 3)]
    last = 1 + (rings - 2) * spokes
    first_row, last_row = index[0], index[-1]
    caps = [
        np.stack([np.zeros(spokes, int), first_row, np.roll(first_row, -1)], -1),
        np.stack([np.full(spokes, last), np.roll(last_row, -1), last_row], -1),
    ]
    return np.concatenate(strips + caps)


def _paint(person: Person, eye: Eye, theta: FloatArray, phi: FloatArray, unit: FloatArray) -> FloatArray:
    radius = theta / _IRIS_ANGLE  # 1 at the limbus
    white = np.tile(np.array([0.70, 0.66, 0.63]), (len(theta), 1))
    # Veins and warmth grow towards the corners.
    side = smoothstep(np.abs(unit[:, 0]), 0.35, 0.8)
    veins = smoothstep(np.abs(value_noise(unit * np.array([4.0, 14.0, 4.0]), person.seed + 71)), 0.08, 0.0)
    white *= (
        1.0
        - side[:, None] * np.array([0.10, 0.26, 0.28])
        - (side * veins * 0.5)[:, None] * np.array([0.2, 0.7, 0.7])
    )
    ring = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=1)
    fibres = value_noise(np.concatenate([ring[:, :2] * 9.0, radius[:, None] * 1.5], axis=1), person.seed + 72)
    glow = 0.8 + 0.55 * smoothstep(radius, 0.9, 0.45) + 0.35 * fibres
    iris = person.iris[None] * np.clip(glow, 0.3, 2.0)[:, None]
    iris *= (1.0 - 0.75 * smoothstep(radius, 0.80, 1.0))[:, None]  # limbal ring
    color = white + smoothstep(radius, 1.06, 0.96)[:, None] * (iris - white)
    return np.clip(
        color * (1.0 - 0.985 * smoothstep(radius, _PUPIL_SHARE + 0.05, _PUPIL_SHARE - 0.05))[:, None],
        0.002,
        0.9,
    )


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
    """A mesh in the mouth that is not in the tracked mesh.

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
        """Vertices at rest for a tongue put out by a fraction in [0, 1]."""
        arch = np.array([0.0, 4.0 * tongue_out * (1.0 - tongue_out) * self.lift, 0.0])
        return self.vertices + tongue_out * (self.out - self.vertices) + arch


@dataclass(frozen=True, eq=False)
class TrackedPart:
    """Non-skin triangles of the tracked mesh: ``vertices`` (n,) are its vertex indices, ``faces`` (m, 3) refer to these."""

    name: str
    vertices: IntArray
    faces: IntArray
    albedo: FloatArray
    material: str


def tracked_parts(head: HeadAsset) -> tuple[TrackedPart, ...]:
    """Teeth and gums that belong to the tracked mesh."""
    parts = []
    for region, (color, material) in _TRACKED.items():
        if region not in head.regions:
            continue
        faces = head.faces[np.isin(head.faces, head.regions[region]).all(axis=1)]
        used, local = np.unique(faces, return_inverse=True)
        parts.append(
            TrackedPart(region, used, local.reshape(-1, 3), np.tile(color, (len(used), 1)), material)
        )
    return tuple(parts)


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
    rows = []
    for part, out in zip(render_parts(head, shape), render_parts(head, shape, tongue_out=1.0)):
        mottled = 1.0 + 0.08 * value_noise(part.vertices / 0.0014, person.seed + 95)
        albedo = colors[part.material] * mottled[:, None]
        rows.append(
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
    return tuple(rows)


HIDES = 20e-6
"""Square metres of lower lip and chin, seen from straight ahead, that a tongue hides when it is out: 4 x 5 mm."""

_STEP = 0.0005  # metres between lines of sight
_AROUND = np.array(
    [[-0.040, -0.055], [0.040, 0.025]]
)  # metres from the mouth's middle: right below, left above
_BISECTIONS = 7


def share_that_shows(parts: Sequence[MouthPart], anatomy: Anatomy, neutral: FloatArray) -> float:
    """The least ``tongue_out`` at which the tongue among ``parts`` hides `HIDES` of the neutral skin, to 1 %.

    Tongue and lower lip both follow the jaw, so the closed mouth is representative of the open one; the upper lip, which
    the tongue would then cross, is left out. Infinity for a subject without a tongue, or with one that stays
    behind the lips.
    """
    tongues = [part for part in parts if part.name == "tongue"]
    low = anatomy["mouth"][:2] + _AROUND[0] * anatomy.scale
    size = np.ceil((_AROUND[1] - _AROUND[0]) * anatomy.scale / _STEP).astype(int)
    skin = front_depth(neutral, anatomy.skin_faces, low, _STEP, size)

    def hidden(share: float) -> float:
        covered = np.zeros(skin.shape, bool)
        for tongue in tongues:
            covered |= front_depth(tongue.at(share), tongue.faces, low, _STEP, size) > skin
        return float((covered & np.isfinite(skin)).sum()) * _STEP**2

    if hidden(1.0) < HIDES:
        return float("inf")
    behind, out = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (behind + out)
        behind, out = (behind, middle) if hidden(middle) >= HIDES else (middle, out)
    return out
