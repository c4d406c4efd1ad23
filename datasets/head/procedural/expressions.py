"""Semantic expression shapes, named after the action units they play, and the model's own basis of them.

The model's expression directions are principal components of these shapes under a distribution of activations
(another one for each version), so its coefficients are orthogonal, ordered by variance and mean nothing
by name, as FLAME's do. `semantic_to_coefficients` leads from names to coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ....bench.contracts import FloatArray
from ...rounding import COEFFICIENT_BITS, LENGTH_BITS, on_grid
from ..geometry import smoothstep
from .anatomy import MOUTH_HALF_WIDTH, lip_arc
from .eyelids import blink, keep_off_eyes, lid_turn
from .rig import jaw_weight
from .surface import Surface

_MIXING_BITS = 25  # 2**-25 times 2**-27 m leaves two metres of room in a float64
_SWEEPS = 12  # of Jacobi rotations; 40 x 40 matrices need 8

CORNER = (MOUTH_HALF_WIDTH, -0.0520, 0.0665)
Vector = tuple[float, float, float]
Shape = Callable[["Clay"], FloatArray]


@dataclass(frozen=True, eq=False)
class Clay:
    """The surface with the strokes that shapes are made of. All act on the skin only."""

    surface: Surface

    def pull(self, center: Vector, sigma: Vector | float, millimetres: Vector) -> FloatArray:
        """Move a Gaussian neighbourhood of a point by a vector given in millimetres."""
        scaled = (self.surface.vertices - center) / np.broadcast_to(sigma, 3)
        weight = np.exp(-0.5 * (scaled**2).sum(axis=1)) * self.surface.skin
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
        """Press the lips: heights over the slit shrink by ``share``, the red moves ``back`` millimetres."""
        x, _, z = self.surface.vertices.T
        above = self.surface.above_slit
        near = np.exp(-((above / 0.0085) ** 2)) * (1 - smoothstep(np.abs(x) / MOUTH_HALF_WIDTH, 0.7, 1.15))
        near = near * smoothstep(z, 0.050, 0.064) * self.surface.skin
        return np.column_stack([0 * x, -share * above * near, -back * 1e-3 * near])


def _smile(c: Clay) -> FloatArray:
    field = c.pull(CORNER, (0.011, 0.010, 0.016), (6.5, 5.5, -4.5))
    field = field + c.pull((0.016, -0.050, 0.072), (0.007, 0.009, 0.016), (1.8, 1.2, -1.2))
    field = field + c.swell((0.042, -0.020, 0.056), (0.013, 0.012, 0.016), 4.0)
    field = field + c.pull((0.040, -0.016, 0.058), 0.013, (0.5, 2.5, 0))
    return field - c.swell((0.029, -0.034, 0.068), (0.0035, 0.010, 0.008), 1.6)


def _squint(c: Clay) -> FloatArray:
    return lid_turn(c.surface, -0.10, 0.20) + c.pull(
        (0.038, 0.004, 0.058), (0.014, 0.006, 0.012), (0, 2.2, 0.8)
    )


def _brow_down(c: Clay) -> FloatArray:
    field = c.pull((0.017, 0.040, 0.075), (0.011, 0.008, 0.015), (-2.2, -4.2, 0.8))
    return field + c.pull((0.036, 0.040, 0.066), (0.010, 0.008, 0.015), (-0.5, -2.8, 0.3))


def _brow_outer_up(c: Clay) -> FloatArray:
    field = c.pull((0.042, 0.040, 0.060), (0.012, 0.009, 0.016), (0.2, 5.5, -0.8))
    return field + c.pull((0.040, 0.060, 0.060), (0.015, 0.014, 0.020), (0, 2.5, -0.4))


def _cheek_raise(c: Clay) -> FloatArray:
    field = c.swell((0.042, -0.006, 0.056), (0.013, 0.010, 0.016), 2.5)
    return field + c.pull((0.040, -0.008, 0.058), 0.013, (0.3, 3.5, 0)) + lid_turn(c.surface, 0.0, 0.12)


def _nose_sneer(c: Clay) -> FloatArray:
    field = c.pull((0.0165, -0.020, 0.078), (0.007, 0.009, 0.010), (0.8, 3.2, -0.6))
    field = field + c.pull((0.012, 0.002, 0.070), (0.007, 0.010, 0.010), (-0.3, 1.6, 0.9))
    return field + c.pull((0.016, -0.037, 0.076), (0.009, 0.007, 0.012), (0, 2.0, 0.3))


def _puff(c: Clay) -> FloatArray:
    return c.swell((0.043, -0.042, 0.048), (0.016, 0.016, 0.020), 8.0) + c.pull(CORNER, 0.010, (-1.0, 0, 1.0))


def _stretch(c: Clay) -> FloatArray:
    return c.pull(CORNER, (0.011, 0.011, 0.016), (6.0, -1.5, -3.5)) + c.pull(
        (0.040, -0.075, 0.040), 0.016, (2.0, -1.5, 0)
    )


def _frown(c: Clay) -> FloatArray:
    field = c.pull(CORNER, (0.010, 0.010, 0.015), (1.0, -6.0, -1.2))
    return field + c.pull((0.024, -0.068, 0.064), 0.010, (0.5, -1.8, 0.6))


def _pucker(c: Clay) -> FloatArray:
    field = c.pull(CORNER, (0.012, 0.012, 0.018), (-7.5, 0, 5.0)) + c.pull(
        (0.014, -0.051, 0.073), 0.009, (-1.8, 0, 2.2)
    )
    return field + 0.5 * c.pull((0, -0.051, 0.078), (0.012, 0.009, 0.020), (0, 0, 5.0))


def _funnel(c: Clay) -> FloatArray:
    field = c.pull(CORNER, (0.012, 0.012, 0.018), (-5.5, 0, 4.0))
    field = field + 0.5 * c.lip(True, 0, 0.015, (0, 3.4, 4.0)) + 0.5 * c.lip(False, 0, 0.015, (0, -4.0, 4.0))
    return field


def _roll(c: Clay) -> FloatArray:
    return 0.5 * c.compress(0.45, 3.2)


def _chin_raise(c: Clay) -> FloatArray:
    field = c.pull((0, -0.080, 0.075), (0.016, 0.010, 0.020), (0, 3.4, 1.2))
    field = field + c.pull((0, -0.050, 0.078), (0.018, 0.012, 0.022), (0, 2.2, 1.0))
    return 0.5 * field


def _wide(c: Clay) -> FloatArray:
    return lid_turn(c.surface, 0.16, -0.05)


def _dimple(c: Clay) -> FloatArray:
    return c.pull(CORNER, (0.008, 0.009, 0.012), (2.2, 0.3, -4.0)) + c.swell(
        (0.032, -0.050, 0.062), 0.006, -1.2
    )


def _neck_tense(c: Clay) -> FloatArray:
    return c.swell((0.035, -0.135, 0.005), (0.012, 0.030, 0.030), 3.0) + c.pull(CORNER, 0.012, (1.5, -2.0, 0))


def _jaw_forward(c: Clay) -> FloatArray:
    return 0.5 * jaw_weight(c.surface)[:, None] * np.array([0, -0.0006, 0.0050])


# Shapes of the left side; each has its mirror image on the right.
PAIRED: dict[str, Shape] = {
    "brow_down": _brow_down,
    "brow_outer_up": _brow_outer_up,
    "blink": lambda c: blink(c.surface),
    "squint": _squint,
    "eye_wide": _wide,
    "cheek_raise": _cheek_raise,
    "nose_sneer": _nose_sneer,
    "smile": _smile,
    "mouth_stretch": _stretch,
    "upper_lip_up": lambda c: c.lip(True, 0.011, 0.009, (0.3, 4.6, 0.8)),
    "lower_lip_down": lambda c: c.lip(False, 0.011, 0.009, (0.3, -4.8, 0.6)),
    "dimple": _dimple,
    "nostril_flare": lambda c: c.pull((0.0170, -0.0235, 0.0775), (0.005, 0.007, 0.009), (2.2, 0.6, 0)),
}
# Halves of symmetric shapes: left half plus its mirror image.
SINGLE: dict[str, Shape] = {
    "brow_inner_up": lambda c: c.pull((0.012, 0.041, 0.076), (0.011, 0.011, 0.018), (0.3, 5.0, -0.5)),
    "cheek_puff": _puff,
    "mouth_frown": _frown,
    "pucker": _pucker,
    "funnel": _funnel,
    "lip_press": lambda c: 0.5 * c.compress(0.30, 0.6),
    "lip_roll": _roll,
    "chin_raise": _chin_raise,
    "lips_part": lambda c: (
        0.5 * c.lip(True, 0, 0.016, (0, 2.5, 0.3)) + 0.5 * c.lip(False, 0, 0.016, (0, -3.5, 0))
    ),
    "neck_tense": _neck_tense,
    "jaw_forward": _jaw_forward,
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


def semantic_shapes(surface: Surface) -> dict[str, FloatArray]:
    """Displacements (V, 3), metres, at activation 1 of every shape in `SEMANTIC_NAMES`."""
    clay = Clay(surface)
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
    """A version's expression directions (V, 3, E) and the matrix (K, E) from its shapes' activations to them.

    ``names`` are the K shapes the basis plays, E at most K; a version with eyelid bases leaves the blinks to those.
    """

    directions: FloatArray
    names: tuple[str, ...]
    from_semantic: FloatArray


def principal_basis(shapes: dict[str, FloatArray], deviation: FloatArray, seed: int) -> ExpressionBasis:
    """Principal components of ``shapes`` under correlated normal activations.

    Parameters
    ----------
    shapes : K displacements (V, 3).
    deviation : (K,) standard deviation of each activation.
    seed : draws the correlations.

    Notes
    -----
    With activations a ~ N(0, L L'), displacements are a'D. The SVD L'D = U S W' gives directions S W' = U'L'D,
    orthogonal and in order of variance, whose coefficients are N(0, 1); activations a have the coefficients
    a inv(L') U. U are the eigenvectors of L'DD'L. The shapes are rounded first, and nothing that follows but the last
    line depends on the order of a sum, so that all machines find the same directions: DD' and U'L'D are exact.
    """
    stack = on_grid(np.stack([field.ravel() for field in shapes.values()]), LENGTH_BITS)
    random = np.random.default_rng(seed)
    mixing = np.eye(len(stack)) + 0.35 * random.standard_normal((len(stack),) * 2) / np.sqrt(len(stack))
    root = deviation[:, None] * mixing
    u = _eigenvectors(_product(_product(root.T, stack @ stack.T), root))
    directions = on_grid(_product(u.T, root.T), _MIXING_BITS) @ stack
    # An eigenvector's sign is arbitrary: fix it.
    sign = np.sign(directions[np.arange(len(u)), np.abs(directions).argmax(axis=1)])
    directions *= sign[:, None]
    # Where shapes depend on each other, one combination moves nothing.
    moving = on_grid(directions, LENGTH_BITS).any(axis=1)
    directions, u, sign = directions[moving], u[:, moving], sign[moving]
    vertices = len(next(iter(shapes.values())))
    return ExpressionBasis(
        directions=directions.reshape(-1, vertices, 3).transpose(1, 2, 0),
        names=tuple(shapes),
        from_semantic=on_grid(np.linalg.solve(root.T, u * sign), COEFFICIENT_BITS),
    )


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of small matrices, summed in one order everywhere, as BLAS's is not."""
    product: FloatArray = (a[:, :, None] * b[None]).sum(axis=1)
    return product


def _eigenvectors(matrix: FloatArray) -> FloatArray:
    """Eigenvectors of a symmetric (K, K) matrix, in columns, the largest eigenvalue's first.

    Jacobi rotations of disjoint pairs (Golub and Van Loan, "Matrix Computations", 4th edition, 8.5.3), in elementary
    operations alone: the last digits of LAPACK's differ between machines, and small gaps between eigenvalues would
    enlarge them.
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
        for array in (rotated, rotated.T, vectors):  # of .T the columns are the rows
            at_p, at_q = array[:, p], array[:, q]
            array[:, p], array[:, q] = cosine * at_p - sine * at_q, sine * at_p + cosine * at_q
        order = np.concatenate([order[:1], np.roll(order[1:], 1)])  # every pair meets once a sweep
    largest_first = np.argsort(-np.diag(rotated)[:size], kind="stable")
    return vectors[:size, largest_first]
