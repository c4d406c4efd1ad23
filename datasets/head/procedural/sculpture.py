"""The head as an implicit surface: primitives, smooth booleans, strokes, and the parts of the head.

Every function works on points ``(N, 3)`` in metres and returns ``(N,)`` approximate signed distances,
negative inside. The bounds are those of I. Quilez, "Distance functions" and "Smooth minimum".

Anatomy of the sculpted head: positions, curves and frames shared by the sculptor and the rig. Metres, +y up, +z front,
subject's left at +x. Every curve is given for the left half; the right one is its mirror image. Proportions follow
adult means of Farkas, "Anthropometry of the Head and Face" (1994).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from ....bench.contracts import FloatArray

FLOOR = -0.19  # height of the flat cut at the base of the neck

EYE_CENTER = np.array([0.0315, 0.0200, 0.0535])
EYE_RADIUS = 0.0120
LID_CLEARANCE = 0.0004  # between the eyeball and the inner side of the lids
MEDIAL_CANTHUS = -0.0138  # along x from the centre of the eye
LATERAL_CANTHUS = 0.0132
UPPER_LID_HEIGHT = 0.0062  # above the line through the canthi
LOWER_LID_DEPTH = 0.0046

MOUTH_HALF_WIDTH = 0.0258
MOUTH_CAVITY = ((0.0, -0.0500, 0.0400), (0.0265, 0.0160, 0.0305))  # ellipsoid: centre, radii
SCULPTED_LIP_GAP = 0.0024  # the mouth is sculpted slightly open, to separate the lips
CLOSED_LIP_GAP = 0.0003  # gap left by `close_mouth`
LIP_RING_HEIGHT = (
    0.0025  # heights of the rings of the lips above and below the closed slit: on the red, just outside
)
LIP_RING_REACH = 0.93  # where the rings end, in half widths of the mouth


def canthal_height(x: FloatArray | float) -> FloatArray | float:
    """Height of the line through the canthi above the centre of the eye, at ``x`` from the centre."""
    return -0.0004 + 0.055 * x


def lid_curves(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Heights of the upper and lower lid margin above the centre of the eye, at ``x`` from the centre. The curves cross
    at the canthi, so that the aperture closes."""
    middle = (MEDIAL_CANTHUS + LATERAL_CANTHUS) / 2
    half = (LATERAL_CANTHUS - MEDIAL_CANTHUS) / 2
    u = (x - middle) / half
    line = canthal_height(x)
    # The upper margin peaks a little medially, the lower one sags laterally.
    upper = (1 - u**2) * (1 + 0.22 * u**2) * (1 - 0.14 * u)
    lower = (1 - u**2) * (1 + 0.25 * u**2) * (1 + 0.22 * u)
    return line + UPPER_LID_HEIGHT * upper, line - LOWER_LID_DEPTH * lower


def slit_height(x: FloatArray) -> FloatArray:
    """Height of the line between the lips at distance ``x`` from the midline: a flat cupid's bow."""
    u = np.abs(x) / MOUTH_HALF_WIDTH
    return -0.0512 - 0.0008 * np.exp(-((u / 0.16) ** 2)) - 0.0012 * u**3


def lip_arc(x: FloatArray) -> FloatArray:
    """Depth z of the line between the lips at ``x``: it follows the dental arch."""
    return 0.0785 - 17.0 * x**2


def eye_front(x: FloatArray, y: FloatArray, height: float) -> FloatArray:
    """(N, 3) points over the left eyeball at (x, y) from its centre, ``height`` above its surface."""
    depth = np.sqrt(np.maximum((EYE_RADIUS + height) ** 2 - x**2 - y**2, 1e-8))
    return np.column_stack([x, y, depth]) + EYE_CENTER


def close_mouth(vertices: FloatArray) -> FloatArray:
    """Close the lips of the head, which is sculpted with an open mouth; smooth, and the identity elsewhere."""
    x, y, z = vertices.T
    above = y - slit_height(x)
    lift = (SCULPTED_LIP_GAP - CLOSED_LIP_GAP) / 2
    along = np.clip((np.abs(x) - MOUTH_HALF_WIDTH) / 0.003, 0, 1)
    behind = np.clip((0.058 - z) / 0.010, 0, 1)
    fade = np.exp(-((np.maximum(np.abs(above) - 0.001, 0) / 0.009) ** 2)) * (1 - along) * (1 - behind)
    closed = vertices.copy()
    closed[:, 1] -= np.sign(above) * np.minimum(lift, np.abs(above)) * fade
    return closed


def lip_contour(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Heights of the upper and lower border of the lips' red at distance ``x`` >= 0 from the midline."""
    u = np.clip(x / MOUTH_HALF_WIDTH, 0, 1)
    bow = -0.0006 * np.exp(-((u / 0.10) ** 2)) + 0.0006 * np.exp(-(((u - 0.19) / 0.09) ** 2))
    line = slit_height(x)
    return line + 0.0072 * (1 - u**1.7) + bow + 0.0004, line - 0.0098 * (1 - u**2.4) - 0.0004


Point = Sequence[float]


def rotation_xyz(degrees: Point) -> FloatArray:
    """(3, 3) rotation about x, then y, then z; the angles are in degrees."""
    (a, b, c) = np.radians(np.asarray(degrees, float))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def local(points: FloatArray, center: Point, degrees: Point | None = None) -> FloatArray:
    """Points in the frame at ``center``, rotated by ``degrees`` (see `rotation_xyz`)."""
    relative = points - np.asarray(center, points.dtype)
    return relative if degrees is None else relative @ rotation_xyz(degrees).astype(points.dtype)


def ellipsoid(points: FloatArray, center: Point, radii: Point, degrees: Point | None = None) -> FloatArray:
    """Ellipsoid; exact on the surface and correct to first order near it."""
    scaled = local(points, center, degrees) / np.asarray(radii, points.dtype)
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / np.asarray(radii, points.dtype), axis=1)
    return length * (length - 1) / np.maximum(slope, 1e-6)


def capsule(points: FloatArray, a: Point, b: Point, radius_a: float, radius_b: float) -> FloatArray:
    """Capsule between two points with a radius from ``radius_a`` to ``radius_b``."""
    start = np.asarray(a, points.dtype)
    axis = np.asarray(b, points.dtype) - start
    relative = points - start
    along = np.clip(relative @ axis / (axis @ axis), 0, 1)
    distance = np.linalg.norm(relative - along[:, None] * axis, axis=1)
    return distance - (radius_a + along * (radius_b - radius_a))


def tube(points: FloatArray, knots: Sequence[Point], radii: Point, samples: int = 12) -> FloatArray:
    """Tube of varying radius along the cubic spline through ``knots``."""
    path = resample(np.column_stack([np.asarray(knots, float), np.asarray(radii, float)]), samples)
    pieces = [capsule(points, a[:3], b[:3], float(a[3]), float(b[3])) for a, b in itertools.pairwise(path)]
    return np.minimum.reduce(pieces)


def resample(knots: FloatArray, samples: int) -> FloatArray:
    """``samples`` rows at equal parameter steps on the chord-length cubic spline through ``knots``."""
    knots = np.asarray(knots, float)
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1))])
    return CubicSpline(chord / chord[-1], knots)(np.linspace(0, 1, samples))


def union(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """Smooth union (quadratic smooth minimum); ``blend`` metres is the width of the fillet."""
    overlap = np.maximum(blend - np.abs(a - b), 0)
    return np.minimum(a, b) - overlap**2 / (4 * blend)


def intersection(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """Smooth intersection; the convex edge is rounded over ``blend`` metres."""
    return -union(-a, -b, blend)


def subtraction(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """``a`` without ``b``, the edge rounded over ``blend`` metres."""
    return intersection(a, -b, blend)


def stroke(points: FloatArray, center: Point, sigma: Point, degrees: Point | None = None) -> FloatArray:
    """Weight in [0, 1] of a Gaussian clay stroke: subtract ``height * stroke`` to add clay."""
    scaled = local(points, center, degrees) / np.asarray(sigma, points.dtype)
    return np.exp(-0.5 * np.einsum("ij,ij->i", scaled, scaled))


def ridge(points: FloatArray, knots: Sequence[Point], width: float) -> FloatArray:
    """Weight in [0, 1] of a stroke along a spline: Gaussian of the distance with standard deviation ``width``."""
    distance = tube(points, knots, [0.0] * len(knots), 10)
    return np.exp(-0.5 * (distance / width) ** 2)


# One row per height, metres: midline depth of the face without nose and lips, half width, depth of the widest point,
# exponent of the connecting superellipse.
FACE_SECTIONS = np.array(
    [
        # y, front, half width, widest at, exponent
        [0.080, 0.0650, 0.0600, 0.000, 2.10],
        [0.060, 0.0690, 0.0625, 0.002, 2.05],
        [0.042, 0.0705, 0.0640, 0.004, 2.00],
        [0.020, 0.0660, 0.0655, 0.006, 2.05],
        [0.000, 0.0690, 0.0665, 0.008, 2.10],
        [-0.020, 0.0730, 0.0640, 0.006, 2.10],
        [-0.035, 0.0765, 0.0610, 0.004, 2.05],
        [-0.050, 0.0780, 0.0565, 0.002, 2.00],
        [-0.068, 0.0730, 0.0500, 0.002, 2.05],
        [-0.082, 0.0745, 0.0430, 0.006, 2.10],
        [-0.095, 0.0720, 0.0370, 0.012, 2.10],
        [-0.115, 0.0600, 0.0300, 0.015, 2.00],
    ]
)


def face_mass(points: FloatArray) -> FloatArray:
    """Face from brow to chin: superelliptic sections over height, cut below by the plane of the jaw."""
    x, y, z = points.T
    rows = FACE_SECTIONS[::-1]
    front, half, widest, power = PchipInterpolator(rows[:, 0], rows[:, 1:])(
        np.clip(y, rows[0, 0], rows[-1, 0])
    ).T.astype(points.dtype)
    u = np.abs(x) / half + 1e-6
    v = np.maximum(z - widest, 0) / (front - widest) + 1e-6
    radius = (u**power + v**power) ** (1 / power)
    slope = np.hypot((u / radius) ** (power - 1) / half, (v / radius) ** (power - 1) / (front - widest))
    section = (radius - 1) / np.maximum(slope, 1e-3)
    below = -0.900 * (y + 0.0960) - 0.436 * (z - 0.058)
    behind = -0.010 - z
    top = y - 0.075
    jaw = intersection(section, below, 0.016)
    return intersection(intersection(jaw, behind, 0.030), top, 0.030)


def neck_mass(points: FloatArray) -> FloatArray:
    """Neck with sternomastoid and larynx, and the slope of the shoulders."""
    mirrored = np.column_stack([np.abs(points[:, 0]), points[:, 1:]])
    neck = tube(
        points,
        [(0, -0.030, -0.038), (0, -0.090, -0.042), (0, -0.150, -0.049), (0, -0.210, -0.056)],
        [0.050, 0.0515, 0.055, 0.064],
        samples=6,
    )
    trapezius = tube(
        mirrored,
        [(0.015, -0.060, -0.078), (0.030, -0.120, -0.082), (0.060, -0.175, -0.078), (0.085, -0.215, -0.070)],
        [0.020, 0.022, 0.026, 0.030],
        samples=6,
    )
    mass = union(neck, trapezius, 0.04)
    sternomastoid = capsule(mirrored, (0.058, -0.028, -0.030), (0.016, -0.195, 0.004), 0.008, 0.0065)
    mass = union(mass, sternomastoid, 0.018)
    mass -= 0.0030 * stroke(points, (0, -0.128, 0.006), (0.009, 0.012, 0.012))
    return mass


def head_mass(points: FloatArray) -> FloatArray:
    """Cranium, face and neck joined."""
    skull = ellipsoid(points, (0, 0.052, -0.019), (0.0765, 0.083, 0.0950))
    occiput = ellipsoid(points, (0, 0.030, -0.055), (0.062, 0.062, 0.056))
    skull = union(skull, occiput, 0.03)
    forehead = ellipsoid(points, (0, 0.062, 0.006), (0.060, 0.056, 0.0640))
    skull = union(skull, forehead, 0.03)
    head = union(skull, face_mass(points), 0.022)
    return union(head, neck_mass(points), 0.022)


# Strokes on the left half: height (metres, positive adds), centre, deviations, turn in degrees.
PLANES: tuple[tuple[float, tuple[float, ...], tuple[float, ...], tuple[float, ...] | None], ...] = (
    (0.0010, (0.000, 0.042, 0.077), (0.012, 0.009, 0.020), None),  # glabella
    (0.0022, (0.024, 0.039, 0.070), (0.013, 0.0060, 0.020), (0, 0, 6)),  # brow ridge
    (0.0022, (0.044, 0.036, 0.056), (0.009, 0.008, 0.014), (0, 0, -25)),  # outer brow
    (-0.0030, (0.066, 0.040, 0.030), (0.020, 0.018, 0.016), None),  # temple
    (-0.0040, (0.032, 0.0300, 0.062), (0.0130, 0.0050, 0.014), None),  # under the brow
    (-0.0050, (0.031, 0.0235, 0.060), (0.0150, 0.0085, 0.016), None),  # orbit
    (-0.0120, (0.0180, 0.0210, 0.063), (0.0058, 0.0085, 0.014), None),  # inner corner of the orbit
    (0.0030, (0.052, -0.004, 0.046), (0.014, 0.011, 0.020), (0, 0, 20)),  # cheekbone
    (0.0022, (0.034, -0.016, 0.064), (0.013, 0.013, 0.015), None),  # front of the cheek
    (-0.0030, (0.054, -0.043, 0.032), (0.014, 0.018, 0.018), None),  # hollow of the cheek
    (0.0025, (0.051, -0.060, 0.002), (0.010, 0.012, 0.014), None),  # angle of the jaw
    (0.0030, (0.000, -0.084, 0.075), (0.013, 0.009, 0.014), None),  # chin
    (-0.0018, (0.000, -0.0685, 0.0745), (0.016, 0.0040, 0.010), None),  # mentolabial sulcus
    (0.0016, (0.000, -0.052, 0.078), (0.024, 0.016, 0.020), None),  # mound of the mouth
    (-0.0016, (0.030, -0.054, 0.062), (0.005, 0.007, 0.010), None),  # hollow beside the mouth
)


def planes(points: FloatArray) -> FloatArray:
    """Height of the strokes at each point, metres."""
    total = np.zeros(len(points), points.dtype)
    for height, center, sigma, degrees in PLANES:
        total += height * stroke(points, center, sigma, degrees)
    fold = [(0.0195, -0.018, 0.073), (0.0260, -0.032, 0.070), (0.0305, -0.048, 0.065), (0.031, -0.060, 0.060)]
    total -= 0.0010 * ridge(points, fold, 0.0035)
    philtrum = [(0, -0.031, 0.080), (0, -0.0435, 0.083)]
    total -= 0.0012 * ridge(points, philtrum, 0.0022)
    column = [(0.0035, -0.031, 0.080), (0.0052, -0.0435, 0.082)]
    return total + 0.0008 * ridge(points, column, 0.0016)


def add_eyes(head: FloatArray, points: FloatArray) -> FloatArray:
    """Lids over the eyeball, crease, aperture and the cavity the eyeball sits in."""
    radius = EYE_RADIUS + LID_CLEARANCE
    lid = ellipsoid(points, EYE_CENTER.tolist(), (radius + 0.0022, radius + 0.0016, radius + 0.0016))
    head = union(head, lid, 0.0050)
    x, y, z = (points - EYE_CENTER.astype(points.dtype)).T
    span = np.linspace(MEDIAL_CANTHUS + 0.001, LATERAL_CANTHUS + 0.003, 7)
    upper, lower = lid_curves(span)
    head = head + 0.0015 * _crease(points, span, 0.80 * upper + 0.0036, 0.0009)
    head = head - 0.0014 * _crease(points, span, 0.70 * upper + 0.0066, 0.0018)
    head = head - 0.0004 * _crease(points, span, upper + 0.0008, 0.0009)
    head = head - 0.0005 * _crease(points, span, lower - 0.0010, 0.0010)
    head = head + 0.0007 * _crease(points, span[:5], 0.8 * lower[:5] - 0.0062, 0.0016)
    top, bottom = lid_curves(x)
    lens = intersection(y - top, bottom - y, 0.0016)
    # Outside the ball, at the corners, the opening has a floor, which blends into the cavity without slivers.
    floor = radius - 0.0006 - np.linalg.norm(np.stack([x * 0.80, y, z], 1), axis=1)
    opening = intersection(np.maximum(lens, -0.001 - z), floor, 0.001)
    cavity = np.linalg.norm(np.stack([x, y, z], 1), axis=1) - radius
    return subtraction(head, union(cavity, opening, 0.0020), 0.0010)


def _crease(points: FloatArray, x: FloatArray, y: FloatArray, width: float) -> FloatArray:
    """Weight of a stroke in front view, along (x, y) from the centre of the eye, for any depth."""
    center = EYE_CENTER.astype(points.dtype)
    flat = (points - center) * np.array([1, 1, 0], points.dtype)
    weight = ridge(flat, [(a, b, 0.0) for a, b in zip(x, y, strict=True)], width)
    return weight * np.clip((points[:, 2] - center[2]) / 0.004, 0, 1)


def add_nose(head: FloatArray, points: FloatArray) -> FloatArray:
    """Bridge, tip, alae, columella and nostrils."""
    bridge = tube(
        points,
        [(0, 0.026, 0.0635), (0, 0.006, 0.0730), (0, -0.011, 0.0840), (0, -0.0190, 0.0885)],
        [0.0060, 0.0062, 0.0068, 0.0085],
        samples=8,
    )
    wall = tube(
        points,
        [(0.0050, 0.012, 0.0620), (0.0090, -0.004, 0.0660), (0.0110, -0.018, 0.0720)],
        [0.0040, 0.0060, 0.0065],
        samples=5,
    )
    nose = union(bridge, wall, 0.010)
    head = union(head, nose, 0.010)
    lobule = ellipsoid(points, (0.0030, -0.0195, 0.0895), (0.0065, 0.0065, 0.0075))
    head = union(head, lobule, 0.004)
    ala = ellipsoid(points, (0.0116, -0.0212, 0.0775), (0.0060, 0.0072, 0.0095), (0, -20, 0))
    head = union(head, ala, 0.0035)
    columella = tube(points, [(0, -0.0245, 0.0890), (0, -0.0300, 0.0785)], [0.0042, 0.0036], samples=3)
    head = union(head, columella, 0.004)
    groove = [(0.0165, -0.0130, 0.0735), (0.0190, -0.0190, 0.0725), (0.0185, -0.0260, 0.0725)]
    head = head + 0.0009 * ridge(points, groove, 0.0013)
    nostril = ellipsoid(points, (0.0068, -0.0290, 0.0825), (0.0030, 0.0060, 0.0052), (15, 0, 24))
    return subtraction(head, nostril, 0.0016)


def add_mouth(head: FloatArray, points: FloatArray) -> FloatArray:
    """Lips, the slit between them and the cavity behind."""
    upper = tube(
        points,
        [
            (-0.0045, -0.0462, 0.0786),
            (0, -0.0472, 0.0790),
            (0.0045, -0.0462, 0.0786),
            (0.0100, -0.0474, 0.0768),
            (0.0175, -0.0496, 0.0722),
            (0.0242, -0.0515, 0.0668),
        ],
        [0.0041, 0.0040, 0.0041, 0.0038, 0.0029, 0.0016],
        samples=16,
    )
    lower = tube(
        points,
        [
            (-0.0080, -0.0566, 0.0760),
            (0, -0.0570, 0.0768),
            (0.0080, -0.0566, 0.0760),
            (0.0165, -0.0550, 0.0715),
            (0.0242, -0.0529, 0.0662),
        ],
        [0.0047, 0.0050, 0.0047, 0.0034, 0.0016],
        samples=14,
    )
    head = union(head, union(upper, lower, 0.001), 0.0035)
    x, y, z = points.T
    slab = np.abs(y - slit_height(x)) - SCULPTED_LIP_GAP / 2
    reach = np.abs(x) - MOUTH_HALF_WIDTH
    slit = np.maximum(intersection(slab, reach, 0.002), 0.035 - z)
    cavity = ellipsoid(points, *MOUTH_CAVITY)
    return subtraction(head, union(slit, cavity, 0.004), 0.0025)


EAR_ORIGIN = (0.0690, 0.0060, -0.0130)
EAR_TURN = (-14.0, -24.0, -3.0)  # leaning back, flaring out


def add_ears(head: FloatArray, points: FloatArray) -> FloatArray:
    """Auricle in its own frame: x out, y up, z front (so the rim is at negative z)."""
    turn = EAR_TURN

    def at(back: float, up: float, out: float) -> tuple[float, float, float]:
        offset = np.array([out, up, -back]) * 1e-3
        return tuple(np.asarray(EAR_ORIGIN) + rotation_xyz(turn) @ offset)

    plate = ellipsoid(points, at(12, 6, 0.5), (0.0038, 0.0295, 0.0165), turn)
    lobe = ellipsoid(points, at(6, -19, 1.5), (0.0032, 0.0085, 0.0070), turn)
    ear: FloatArray = union(plate, lobe, 0.006)
    helix = tube(
        points,
        [
            at(5, 3, 1),
            at(0, 11, 2.5),
            at(2, 23, 3),
            at(10, 31, 3),
            at(20, 29, 3),
            at(25.5, 20, 3.6),
            at(26, 6, 3.6),
            at(20.5, -8, 3),
            at(12, -19, 3),
        ],
        [0.0016, 0.0022, 0.0025, 0.0026, 0.0027, 0.0027, 0.0026, 0.0022, 0.0018],
        samples=24,
    )
    ear = union(ear, helix, 0.0022)
    fossa = tube(
        points, [at(9, 25, 5.2), at(16, 23, 5.2), at(21, 14, 5.6), at(21, 4, 5.6)], [0.0022] * 4, samples=8
    )
    ear = subtraction(ear, fossa, 0.0025)
    antihelix = tube(
        points,
        [at(11, 20, 2.5), at(16, 12, 4), at(18, 2, 4.5), at(15, -7, 4), at(9, -12, 4)],
        [0.0022, 0.0024, 0.0024, 0.0023, 0.0024],
        samples=10,
    )
    ear = union(ear, antihelix, 0.002)
    ear = union(ear, ellipsoid(points, at(-2, 0, 2.5), (0.0026, 0.0050, 0.0032), turn), 0.003)
    head = union(head, ear, 0.004)
    back = ellipsoid(points, at(8, 2, -2.0), (0.0060, 0.0130, 0.0100), turn)
    head = union(head, back, 0.003)
    concha = ellipsoid(points, at(8, 0.5, 5.0), (0.0058, 0.0095, 0.0066), turn)
    cymba = ellipsoid(points, at(9, 10, 5.0), (0.0045, 0.0050, 0.0060), turn)
    return subtraction(head, union(concha, cymba, 0.002), 0.0022)


# Feature, and lower and upper corner of its bounding box.
FEATURES: tuple[tuple[Callable[[FloatArray, FloatArray], FloatArray], Point, Point], ...] = (
    (add_eyes, (-0.01, -0.01, 0.02), (0.065, 0.055, 0.10)),
    (add_nose, (-0.01, -0.05, 0.04), (0.04, 0.045, 0.13)),
    (add_mouth, (-0.01, -0.085, -0.01), (0.045, -0.02, 0.12)),
    (add_ears, (0.045, -0.045, -0.075), (0.13, 0.065, 0.02)),
)


def sculpture(points: FloatArray) -> FloatArray:
    """Approximate signed distance of ``points`` (N, 3) with x >= 0 to the head; mirror for the other half."""
    head: FloatArray = head_mass(points) - planes(points)
    for add, low, high in FEATURES:
        inside = np.all((points > np.asarray(low)) & (points < np.asarray(high)), axis=1)
        if inside.any():
            head[inside] = add(head[inside], points[inside])
    return head
