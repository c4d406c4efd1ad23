"""Visible but untracked parts of the mouth: teeth, gums and tongue of the default head.

They are rendered in synthetic captures and are not in the head model: as in a real capture, methods must learn them
from the images. The wall of the mouth is part of the skin (region ``mouth_socket``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from .sculpture import resample
from .surface import JAW, NECK, PARENTS

# Mesiodistal widths from the midline, millimetres (Wheeler's Dental Anatomy), incisors to second premolar:
# molars would intersect the wall of the mouth.
UPPER_WIDTHS = (8.5, 6.5, 7.5, 7.0, 7.0)
LOWER_WIDTHS = (5.2, 5.7, 7.0, 7.0, 7.2)
ARCH_REACH = 0.029  # half width of the dental arch, metres
COLUMNS = 7  # of vertices across a tooth
TONGUE_SECTIONS, TONGUE_SECTORS = 18, 16


@dataclass(frozen=True, eq=False)
class MouthMesh:
    """A mesh that moves with the head's joints and has no expression of its own.

    Attributes
    ----------
    name : str
        "upper_teeth", "lower_teeth", "upper_gums", "lower_gums" or "tongue".
    vertices : FloatArray
        (n, 3) in the neutral shape, metres.
    faces : IntArray
        (f, 3), counter-clockwise seen from outside.
    """

    name: str
    vertices: FloatArray
    faces: IntArray
    skinning_weights: FloatArray
    material: str


def render_parts(
    head: HeadAsset, shape: FloatArray | None = None, tongue_out: float = 0.0
) -> list[MouthMesh]:
    """Teeth, gums and tongue in a subject's neutral shape.

    Parameters
    ----------
    shape : FloatArray | None
        (S,) identity coefficients; the mean head if None. Parts follow the surrounding wall of the mouth.
    tongue_out : float
        0 places the tongue behind the lower teeth, 1 over the lower lip (the jaw should be open).
    """
    if "mouth_socket" not in head.regions or not head.version.startswith("procedural"):
        raise InputError(f"head model {head.version!r}", "regions", "a procedural head", "another head")
    if not 0 <= tongue_out <= 1:
        raise InputError("render_parts", "tongue_out", "a number in [0, 1]", str(tongue_out))
    meshes = {
        "upper_teeth": (*_teeth(UPPER_WIDTHS, 0.0690, edge=-0.0530, root=-0.0430), NECK, "teeth"),
        "lower_teeth": (*_teeth(LOWER_WIDTHS, 0.0662, edge=-0.0518, root=-0.0600), JAW, "teeth"),
        "upper_gums": (*_gums(0.0690, near=-0.0446, far=-0.0365), NECK, "gums"),
        "lower_gums": (*_gums(0.0662, near=-0.0587, far=-0.0650), JAW, "gums"),
        "tongue": (*tongue(tongue_out), JAW, "tongue"),
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
    """Points (n, 3) at arc ``length`` from the midline along the arch, y = 0, and outward normals (n, 3).

    ``length`` is in metres and ends at ``arch_length()`` on either side.
    """
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


def tongue(out: float) -> tuple[FloatArray, IntArray]:
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
