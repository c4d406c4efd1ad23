"""The features of the face: eyes, nose, lips, ears, and the clay strokes that model the planes between."""

from __future__ import annotations

import numpy as np

from ....bench.contracts import FloatArray
from .anatomy import (
    EYE_CENTER,
    EYE_RADIUS,
    LATERAL_CANTHUS,
    LID_CLEARANCE,
    MEDIAL_CANTHUS,
    MOUTH_CAVITY,
    MOUTH_HALF_WIDTH,
    SCULPTED_LIP_GAP,
    lid_curves,
    slit_height,
)
from .cranium import head_mass
from .fields import ellipsoid, intersection, ridge, rotation_xyz, stroke, subtraction, tube, union, within

# Clay strokes on the left half: height (metres, positive adds), centre, deviations, turn in degrees.
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


@within((-0.01, -0.01, 0.02), (0.065, 0.055, 0.10))
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
    # Beyond the ball, at the corners, the opening has a floor; the cavity melts into it without a sliver.
    floor = radius - 0.0006 - np.linalg.norm(np.stack([x * 0.80, y, z], 1), axis=1)
    opening = intersection(np.maximum(lens, -0.001 - z), floor, 0.001)
    cavity = np.linalg.norm(np.stack([x, y, z], 1), axis=1) - radius
    return subtraction(head, union(cavity, opening, 0.0020), 0.0010)


def _crease(points: FloatArray, x: FloatArray, y: FloatArray, width: float) -> FloatArray:
    """Weight of a stroke seen from the front, along (x, y) from the centre of the eye, whatever the depth."""
    center = EYE_CENTER.astype(points.dtype)
    flat = (points - center) * np.array([1, 1, 0], points.dtype)
    weight = ridge(flat, [(a, b, 0.0) for a, b in zip(x, y, strict=True)], width)
    return weight * np.clip((points[:, 2] - center[2]) / 0.004, 0, 1)


@within((-0.01, -0.05, 0.04), (0.04, 0.045, 0.13))
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


@within((-0.01, -0.085, -0.01), (0.045, -0.02, 0.12))
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


@within((0.045, -0.045, -0.075), (0.13, 0.065, 0.02))
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
    shell = ellipsoid(points, at(8, 2, -2.0), (0.0060, 0.0130, 0.0100), turn)
    head = union(head, shell, 0.003)
    concha = ellipsoid(points, at(8, 0.5, 5.0), (0.0058, 0.0095, 0.0066), turn)
    cymba = ellipsoid(points, at(9, 10, 5.0), (0.0045, 0.0050, 0.0060), turn)
    return subtraction(head, union(concha, cymba, 0.002), 0.0022)


def sculpture(points: FloatArray) -> FloatArray:
    """Signed distance, about, of the head to ``points`` (N, 3) with x >= 0; mirror for the other half."""
    head: FloatArray = head_mass(points) - planes(points)
    head = add_eyes(head, points)
    head = add_nose(head, points)
    head = add_mouth(head, points)
    return add_ears(head, points)
