"""Semantic expression shapes, named after their action units, and the model's basis of them.

The model's expression directions are principal components of these shapes under a distribution of activations
(a different one for each version), so its coefficients are orthogonal, ordered by variance and without names, as in
FLAME. `semantic_to_coefficients` converts names to coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from ....bench.contracts import FloatArray
from ..geometry import COEFFICIENT_BITS, LENGTH_BITS, mesh_edges, on_grid, smoothstep, unique_pairs
from .sculpture import EYE_CENTER, EYE_RADIUS, MOUTH_HALF_WIDTH, eye_front, lid_curves, lip_arc
from .surface import MIRROR, SculptedHead, jaw_weight

_MIXING_BITS = 25  # 2**-25 times 2**-27 m: exact up to two metres in float64
_SWEEPS = 12  # of Jacobi rotations; 40 x 40 matrices need 8

CORNER = (MOUTH_HALF_WIDTH, -0.0520, 0.0665)
Vector = tuple[float, float, float]
Shape = Callable[["Strokes"], FloatArray]


def _gaussian(points: FloatArray, center: Vector | FloatArray, sigma: Vector | float) -> FloatArray:
    """(N,) weights, 1 at the centre."""
    return np.exp(-0.5 * (((points - center) / np.broadcast_to(sigma, 3)) ** 2).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Strokes:
    """The surface with the strokes that form shapes. They act only on the skin."""

    surface: SculptedHead

    def pull(self, center: Vector, sigma: Vector | float, millimetres: Vector) -> FloatArray:
        """Move a Gaussian neighbourhood of a point by a vector given in millimetres."""
        weight = _gaussian(self.surface.vertices, center, sigma) * self.surface.skin
        return weight[:, None] * np.array(millimetres) * 1e-3

    def swell(self, center: Vector, sigma: Vector | float, millimetres: float) -> FloatArray:
        """Move a Gaussian neighbourhood along the normals."""
        amount = self.pull(center, sigma, (millimetres, 0, 0))[:, :1]
        return amount * self.surface.normals

    def lip(self, upper: bool, at: float, width: float, millimetres: Vector) -> FloatArray:
        """Move the upper or the lower lip around x = ``at``; nothing at the corners of the mouth."""
        x, _, z = self.surface.vertices.T
        above = self.surface.above_slit * (1 if upper else -1)
        deep = np.maximum(lip_arc(x) - z, 0)
        weight = (above > 0) * np.exp(-0.5 * (np.maximum(above - 0.004, 0) / 0.0065) ** 2)
        weight = weight * np.exp(-0.5 * ((x - at) / width) ** 2) * np.exp(-0.5 * (deep / 0.014) ** 2)
        weight = weight * (1 - smoothstep(np.abs(x) / MOUTH_HALF_WIDTH, 0.45, 1.0)) * self.surface.skin
        return weight[:, None] * np.array(millimetres) * 1e-3

    def compress(self, share: float, back: float) -> FloatArray:
        """Press the lips: heights above the slit shrink by ``share``, the red moves ``back`` millimetres."""
        x, _, z = self.surface.vertices.T
        above = self.surface.above_slit
        near = np.exp(-((above / 0.0085) ** 2)) * (1 - smoothstep(np.abs(x) / MOUTH_HALF_WIDTH, 0.7, 1.15))
        near = near * smoothstep(z, 0.050, 0.064) * self.surface.skin
        return np.column_stack([0 * x, -share * above * near, -back * 1e-3 * near])


# Shapes of the left side; each has its mirror image on the right.
PAIRED: dict[str, Shape] = {
    "brow_down": lambda c: (
        c.pull((0.017, 0.040, 0.075), (0.011, 0.008, 0.015), (-2.2, -4.2, 0.8))
        + c.pull((0.036, 0.040, 0.066), (0.010, 0.008, 0.015), (-0.5, -2.8, 0.3))
    ),
    "brow_outer_up": lambda c: (
        c.pull((0.042, 0.040, 0.060), (0.012, 0.009, 0.016), (0.2, 5.5, -0.8))
        + c.pull((0.040, 0.060, 0.060), (0.015, 0.014, 0.020), (0, 2.5, -0.4))
    ),
    "blink": lambda c: blink(c.surface),
    "squint": lambda c: (
        lid_turn(c.surface, -0.10, 0.20) + c.pull((0.038, 0.004, 0.058), (0.014, 0.006, 0.012), (0, 2.2, 0.8))
    ),
    "eye_wide": lambda c: lid_turn(c.surface, 0.16, -0.05),
    "cheek_raise": lambda c: (
        c.swell((0.042, -0.006, 0.056), (0.013, 0.010, 0.016), 2.5)
        + c.pull((0.040, -0.008, 0.058), 0.013, (0.3, 3.5, 0))
        + lid_turn(c.surface, 0.0, 0.12)
    ),
    "nose_sneer": lambda c: (
        c.pull((0.0165, -0.020, 0.078), (0.007, 0.009, 0.010), (0.8, 3.2, -0.6))
        + c.pull((0.012, 0.002, 0.070), (0.007, 0.010, 0.010), (-0.3, 1.6, 0.9))
        + c.pull((0.016, -0.037, 0.076), (0.009, 0.007, 0.012), (0, 2.0, 0.3))
    ),
    "smile": lambda c: (
        c.pull(CORNER, (0.011, 0.010, 0.016), (6.5, 5.5, -4.5))
        + c.pull((0.016, -0.050, 0.072), (0.007, 0.009, 0.016), (1.8, 1.2, -1.2))
        + c.swell((0.042, -0.020, 0.056), (0.013, 0.012, 0.016), 4.0)
        + c.pull((0.040, -0.016, 0.058), 0.013, (0.5, 2.5, 0))
        - c.swell((0.029, -0.034, 0.068), (0.0035, 0.010, 0.008), 1.6)
    ),
    "mouth_stretch": lambda c: (
        c.pull(CORNER, (0.011, 0.011, 0.016), (6.0, -1.5, -3.5))
        + c.pull((0.040, -0.075, 0.040), 0.016, (2.0, -1.5, 0))
    ),
    "upper_lip_up": lambda c: c.lip(True, 0.011, 0.009, (0.3, 4.6, 0.8)),
    "lower_lip_down": lambda c: c.lip(False, 0.011, 0.009, (0.3, -4.8, 0.6)),
    "dimple": lambda c: (
        c.pull(CORNER, (0.008, 0.009, 0.012), (2.2, 0.3, -4.0)) + c.swell((0.032, -0.050, 0.062), 0.006, -1.2)
    ),
    "nostril_flare": lambda c: c.pull((0.0170, -0.0235, 0.0775), (0.005, 0.007, 0.009), (2.2, 0.6, 0)),
}
# Halves of symmetric shapes: left half plus its mirror image.
SINGLE: dict[str, Shape] = {
    "brow_inner_up": lambda c: c.pull((0.012, 0.041, 0.076), (0.011, 0.011, 0.018), (0.3, 5.0, -0.5)),
    "cheek_puff": lambda c: (
        c.swell((0.043, -0.042, 0.048), (0.016, 0.016, 0.020), 8.0) + c.pull(CORNER, 0.010, (-1.0, 0, 1.0))
    ),
    "mouth_frown": lambda c: (
        c.pull(CORNER, (0.010, 0.010, 0.015), (1.0, -6.0, -1.2))
        + c.pull((0.024, -0.068, 0.064), 0.010, (0.5, -1.8, 0.6))
    ),
    "pucker": lambda c: (
        c.pull(CORNER, (0.012, 0.012, 0.018), (-7.5, 0, 5.0))
        + c.pull((0.014, -0.051, 0.073), 0.009, (-1.8, 0, 2.2))
        + 0.5 * c.pull((0, -0.051, 0.078), (0.012, 0.009, 0.020), (0, 0, 5.0))
    ),
    "funnel": lambda c: (
        c.pull(CORNER, (0.012, 0.012, 0.018), (-5.5, 0, 4.0))
        + 0.5 * c.lip(True, 0, 0.015, (0, 3.4, 4.0))
        + 0.5 * c.lip(False, 0, 0.015, (0, -4.0, 4.0))
    ),
    "lip_press": lambda c: 0.5 * c.compress(0.30, 0.6),
    "lip_roll": lambda c: 0.5 * c.compress(0.45, 3.2),
    "chin_raise": lambda c: (
        0.5
        * (
            c.pull((0, -0.080, 0.075), (0.016, 0.010, 0.020), (0, 3.4, 1.2))
            + c.pull((0, -0.050, 0.078), (0.018, 0.012, 0.022), (0, 2.2, 1.0))
        )
    ),
    "lips_part": lambda c: (
        0.5 * c.lip(True, 0, 0.016, (0, 2.5, 0.3)) + 0.5 * c.lip(False, 0, 0.016, (0, -3.5, 0))
    ),
    "neck_tense": lambda c: (
        c.swell((0.035, -0.135, 0.005), (0.012, 0.030, 0.030), 3.0) + c.pull(CORNER, 0.012, (1.5, -2.0, 0))
    ),
    "jaw_forward": lambda c: 0.5 * jaw_weight(c.surface)[:, None] * np.array([0, -0.0006, 0.0050]),
}
# Shapes with a direction, to the subject's left; the right one is the mirror image.
SIDEWAYS: dict[str, Shape] = {
    "mouth": lambda c: c.pull((0.0, -0.052, 0.076), (0.026, 0.014, 0.030), (6.5, 0, 0)),
}

SEMANTIC_NAMES: tuple[str, ...] = (
    *(f"{name}_{side}" for name in PAIRED for side in ("left", "right")),
    *SINGLE,
    *(f"{name}_{side}" for name in SIDEWAYS for side in ("left", "right")),
)
"""Names of the expression shapes; 1 is the natural extreme of each."""

LIDS = ("blink_left", "blink_right")


def semantic_shapes(surface: SculptedHead) -> dict[str, FloatArray]:
    """Displacements (V, 3), metres, at activation 1 of every shape in `SEMANTIC_NAMES`."""
    clay = Strokes(surface)
    shapes: dict[str, FloatArray] = {}
    for name, shape in {**PAIRED, **SIDEWAYS}.items():
        field = shape(clay)
        field = field if name == "blink" else keep_off_eyes(surface, field)
        shapes[f"{name}_left"] = field
        shapes[f"{name}_right"] = surface.mirrored(field)
    for name, shape in SINGLE.items():
        half = shape(clay)
        shapes[name] = keep_off_eyes(surface, half + surface.mirrored(half))
    return {name: shapes[name] for name in SEMANTIC_NAMES}


@dataclass(frozen=True, eq=False)
class ExpressionBasis:
    """A version's expression directions (V, 3, E) and the matrix (K, E) from its shapes' activations to them. ``names``
    are the K shapes of the basis, E at most K; a version with eyelid bases has the blinks in these."""

    directions: FloatArray
    names: tuple[str, ...]
    from_semantic: FloatArray


def principal_basis(shapes: dict[str, FloatArray], deviation: FloatArray, seed: int) -> ExpressionBasis:
    """Principal components of ``shapes`` under correlated normal activations.

    ``shapes``: K displacements (V, 3).

    Notes
    -----
    With activations a ~ N(0, L L'), displacements are a'D. The SVD L'D = U S W' gives directions S W' = U'L'D,
    orthogonal and in order of variance, whose coefficients are N(0, 1); activations a have the coefficients
    a inv(L') U. U are the eigenvectors of L'DD'L. The shapes are rounded first, and only the last line depends on the
    order of summation, so that all machines find the same directions: DD' and U'L'D are exact.
    """
    stack = on_grid(np.stack([field.ravel() for field in shapes.values()]), LENGTH_BITS)
    random = np.random.default_rng(seed)
    mixing = np.eye(len(stack)) + 0.35 * random.standard_normal((len(stack),) * 2) / np.sqrt(len(stack))
    root = deviation[:, None] * mixing
    u = _eigenvectors(_product(_product(root.T, stack @ stack.T), root))
    directions = on_grid(_product(u.T, root.T), _MIXING_BITS) @ stack
    # The sign of an eigenvector is arbitrary, so fix it.
    sign = np.sign(directions[np.arange(len(u)), np.abs(directions).argmax(axis=1)])
    directions *= sign[:, None]
    # If shapes are linearly dependent, one combination has no effect.
    moving = on_grid(directions, LENGTH_BITS).any(axis=1)
    directions, u, sign = directions[moving], u[:, moving], sign[moving]
    vertices = len(next(iter(shapes.values())))
    return ExpressionBasis(
        directions=directions.reshape(-1, vertices, 3).transpose(1, 2, 0),
        names=tuple(shapes),
        from_semantic=on_grid(np.linalg.solve(root.T, u * sign), COEFFICIENT_BITS),
    )


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of small matrices with a fixed order of summation, unlike BLAS."""
    product: FloatArray = (a[:, :, None] * b[None]).sum(axis=1)
    return product


def _eigenvectors(matrix: FloatArray) -> FloatArray:
    """Eigenvectors of a symmetric (K, K) matrix, in columns, the largest eigenvalue's first.

    Jacobi rotations of disjoint pairs (Golub and Van Loan, "Matrix Computations", 4th edition, 8.5.3), in elementary
    operations, because LAPACK's last digits differ between machines, and small gaps between eigenvalues would amplify
    the differences.
    """
    size = len(matrix)
    even = size + size % 2
    rotated, vectors = np.zeros((even, even)), np.eye(even)
    rotated[:size, :size] = matrix
    order = np.arange(even)
    for _ in range(_SWEEPS * (even - 1)):
        p, q = order[: even // 2], order[even // 2 :][::-1]
        difference, twice = rotated[q, q] - rotated[p, p], 2.0 * rotated[p, q]
        length = np.abs(difference) + np.sqrt(difference**2 + twice**2)
        tangent = np.where(difference < 0.0, -twice, twice) / np.where(length > 0.0, length, 1.0)
        cosine = 1.0 / np.sqrt(1.0 + tangent**2)
        sine = tangent * cosine
        for array in (rotated, rotated.T, vectors):  # columns of the transpose are rows
            at_p, at_q = array[:, p], array[:, q]
            array[:, p], array[:, q] = cosine * at_p - sine * at_q, sine * at_p + cosine * at_q
        order = np.concatenate([order[:1], np.roll(order[1:], 1)])  # every pair once per sweep
    largest_first = np.argsort(-np.diag(rotated)[:size], kind="stable")
    return vectors[:size, largest_first]


MEETING = 0.14  # where closing lids meet: fraction of the way from the lower to the upper margin
LID_DEPTH = 0.0009  # height of the middle of a lid's margin above the eyeball


def margin_angles(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles about the eye's x axis, from straight ahead and up, of the upper and lower margin at ``x``."""
    angles = []
    for height in lid_curves(x):
        point = eye_front(x, height, LID_DEPTH) - EYE_CENTER
        angles.append(np.arctan2(point[:, 1], point[:, 2]))
    return angles[0], angles[1]


def lid_turn(surface: SculptedHead, upper: FloatArray | float, lower: FloatArray | float) -> FloatArray:
    """(V, 3) displacement that rotates the lid margins of the left eye.

    The margins and the inner sides of the lids rotate rigidly about the eyeball; the surrounding skin follows by the
    harmonic field between the margins and fixed vertices.

    ``upper``, ``lower``: Rotation of each margin, radians, positive up; a number, or one for each vertex.
    """
    relative = surface.vertices - EYE_CENTER
    x, y, z = relative.T
    top, bottom = margin_angles(x)
    angle = np.arctan2(y, z)
    on_upper = angle > (top + bottom) / 2
    beyond = np.where(on_upper, angle - top, bottom - angle)
    distance = np.linalg.norm(relative, axis=1)
    margin = (surface.skin > 0) & (beyond < 0.16) & (distance < EYE_RADIUS + 0.0030) & (np.abs(x) < 0.0165)
    inner = surface.in_socket & (surface.vertices[:, 0] > 0)
    fade = np.where(inner, 1 - smoothstep(beyond, 0.2, 1.2), 1) * (1 - smoothstep(np.abs(x), 0.0145, 0.0165))
    turn = np.where(on_upper, upper, lower) * fade
    radius = np.hypot(y, z)
    turned = np.column_stack([x, radius * np.sin(angle + turn), radius * np.cos(angle + turn)]) - relative
    held = margin | inner
    turned[~held] = 0
    free = (surface.skin > 0) & ~held & (np.linalg.norm(relative * [0.85, 1, 1], axis=1) < 0.021)
    return keep_off_eyes(surface, harmonic(surface, turned, free))


def harmonic(surface: SculptedHead, field: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
    """The field with values at ``free`` vertices replaced by the mean of their neighbours (uniform weights)."""
    count = len(surface.vertices)
    edges = mesh_edges(surface.faces)
    pairs, _, _ = unique_pairs(np.concatenate([edges, edges[:, ::-1]]))
    adjacency = coo_matrix((np.ones(len(pairs)), pairs.T), (count, count)).tocsr()
    inside, known = np.flatnonzero(free), np.flatnonzero(~free)
    laplacian = diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    system = laplacian[inside][:, inside].tocsc()
    filled = field.copy()
    filled[inside] = splu(system).solve(-(laplacian[inside][:, known] @ field[known]))
    return filled


def blink(surface: SculptedHead) -> FloatArray:
    """(V, 3) displacement that closes the left eye."""
    x = surface.vertices[:, 0] - EYE_CENTER[0]
    top, bottom = margin_angles(x)
    opening = np.maximum(top - bottom, 0)
    closed = lid_turn(surface, -(1 - MEETING) * opening, MEETING * opening)
    # A shape moves along chords, which are closer to the eye half way, so the lid ends slightly in front of the ball.
    relative = surface.vertices + closed - EYE_CENTER
    distance = np.linalg.norm(relative, axis=1, keepdims=True)
    moved = np.linalg.norm(closed, axis=1, keepdims=True)
    return closed + relative / distance * np.minimum(0.09 * moved, 0.0006)


def keep_off_eyes(surface: SculptedHead, field: FloatArray, clearance: float = 0.0003) -> FloatArray:
    """The displacement, corrected where skin would enter an eyeball at rest."""
    held = field.copy()
    for ball in (EYE_CENTER, EYE_CENTER * [-1, 1, 1]):
        relative = surface.vertices + held - ball
        distance = np.linalg.norm(relative, axis=1)
        inside = (distance < EYE_RADIUS + clearance) & (surface.skin > 0)
        inside &= np.linalg.norm(field, axis=1) > 0
        push = (EYE_RADIUS + clearance) / np.maximum(distance, 1e-6)
        held[inside] = (ball + relative * push[:, None] - surface.vertices)[inside]
    return held


Displacement = Callable[[FloatArray], FloatArray]


def _along(axis: int, profile: Callable[[FloatArray], FloatArray]) -> Displacement:
    """Displacement along an axis with a magnitude given by a profile of position, (N, 3) -> (N,) metres."""
    return lambda points: profile(points)[:, None] * np.eye(3)[axis]


def _pull(
    center: Vector,
    sigma: Vector | float,
    millimetres: Vector,
    sides: Sequence[FloatArray] = (np.ones(3), MIRROR),
) -> Displacement:
    """Gaussian pull around a point and its mirror image; the x component is outward on either side."""

    def displacement(points: FloatArray) -> FloatArray:
        out = np.zeros_like(points)
        for side in sides:
            weight = _gaussian(points, side * center, sigma)
            out += weight[:, None] * side * np.array(millimetres) * (1e-3 if center[0] else 1e-3 / len(sides))
        return out

    return displacement


_LEFT_ALONE = (np.ones(3),)  # asymmetry of faces

# One standard deviation of each trait; Farkas (1994) gives about 4-5 % for the large measures.
TRAITS: dict[str, Displacement] = {
    "size": lambda p: 0.030 * p,
    "breadth": _along(0, lambda p: 0.040 * p[:, 0]),
    "depth": _along(2, lambda p: 0.035 * p[:, 2]),
    "face_length": _along(
        1, lambda p: 0.060 * np.minimum(p[:, 1] - 0.02, 0) * smoothstep(p[:, 1], -0.22, -0.09)
    ),
    "skull_height": _along(1, lambda p: 0.060 * np.maximum(p[:, 1] - 0.04, 0)),
    "jaw_width": _pull((0.050, -0.060, 0.015), (0.022, 0.025, 0.030), (3.2, 0, 0)),
    "chin_forward": _pull((0, -0.086, 0.072), (0.022, 0.015, 0.024), (0, -0.5, 3.0)),
    "chin_height": _pull((0, -0.092, 0.066), (0.030, 0.014, 0.035), (0, -3.0, 0)),
    "chin_width": _pull((0.018, -0.086, 0.066), 0.012, (2.2, 0, 0)),
    "cheekbones": _pull((0.054, 0.000, 0.045), (0.016, 0.014, 0.022), (2.2, 0.3, 1.0)),
    "cheek_fullness": _pull((0.046, -0.036, 0.046), (0.018, 0.020, 0.022), (3.0, 0, 1.6)),
    "brow_ridge": _pull((0.020, 0.040, 0.073), (0.018, 0.009, 0.016), (0, 0, 1.8)),
    "brow_height": _pull((0.026, 0.040, 0.070), (0.020, 0.009, 0.018), (0, 1.8, 0)),
    "forehead_slope": _pull((0, 0.085, 0.060), (0.050, 0.026, 0.040), (0, 0, 3.2)),
    "temple": _pull((0.066, 0.040, 0.030), (0.020, 0.025, 0.028), (2.2, 0, 0)),
    "eye_spacing": _pull((0.0315, 0.020, 0.055), (0.014, 0.014, 0.025), (1.5, 0, 0)),
    "eye_depth": _pull((0.0315, 0.020, 0.055), (0.016, 0.014, 0.025), (0, 0, -1.3)),
    "nose_length": _pull((0, -0.022, 0.088), (0.016, 0.011, 0.018), (0, -2.2, 0.3)),
    "nose_projection": _pull((0, -0.017, 0.094), (0.014, 0.014, 0.018), (0, 0.3, 2.0)),
    "nose_width": _pull((0.0155, -0.021, 0.080), (0.008, 0.010, 0.012), (1.5, 0, 0)),
    "nose_bridge": _pull((0, 0.004, 0.076), (0.009, 0.011, 0.012), (0, 0, 1.6)),
    "nose_tip": _pull((0, -0.020, 0.096), 0.008, (0, 1.6, 0.3)),
    "mouth_width": _pull((0.0258, -0.052, 0.067), (0.012, 0.010, 0.016), (2.0, 0, -0.9)),
    "mouth_height": _pull((0, -0.051, 0.076), (0.030, 0.012, 0.025), (0, 1.6, 0)),
    "mouth_forward": _pull((0, -0.051, 0.078), (0.024, 0.016, 0.022), (0, 0, 1.6)),
    "lip_fullness": lambda p: (
        _pull((0, -0.0455, 0.080), (0.014, 0.0042, 0.010), (0, 0.8, 1.0))(p)
        + _pull((0, -0.0580, 0.078), (0.013, 0.0045, 0.010), (0, -0.9, 1.1))(p)
    ),
    "ear_flare": _pull((0.083, 0.014, -0.034), (0.013, 0.028, 0.014), (3.0, 0, 0.8)),
    "ear_size": _pull((0.078, 0.038, -0.028), (0.014, 0.016, 0.018), (0, 2.6, -0.5)),
    "neck_girth": lambda p: p * [0.07, 0, 0.07] * smoothstep(-p[:, 1], 0.070, 0.125)[:, None],
    "nose_aside": _pull((0, -0.014, 0.090), (0.012, 0.016, 0.016), (1.0, 0, 0), _LEFT_ALONE),
    "jaw_aside": _pull((0, -0.080, 0.060), (0.040, 0.024, 0.040), (1.6, 0, 0), _LEFT_ALONE),
    "brow_uneven": _pull((0.028, 0.040, 0.070), (0.018, 0.010, 0.018), (0, 1.0, 0), _LEFT_ALONE),
}


def trait_field(name: str, points: FloatArray) -> FloatArray:
    """(N, 3) displacement by one standard deviation of a trait, metres; each eye moves together with its lids."""
    field = TRAITS[name](points)
    for ball in (EYE_CENTER, EYE_CENTER * MIRROR):
        rigid = TRAITS[name](ball[None])[0]
        distance = np.linalg.norm(points - ball, axis=1)
        share = (1 - smoothstep(distance, 0.0175, 0.0300))[:, None]
        field = share * rigid + (1 - share) * field
    return field


def identity_basis(surface: SculptedHead, seed: int) -> FloatArray:
    """(V, 3, S) orthogonal directions; coefficients drawn from N(0, 1) give plausible people."""
    fields = {name: trait_field(name, surface.vertices) for name in TRAITS}
    return principal_basis(fields, np.ones(len(fields)), seed).directions
