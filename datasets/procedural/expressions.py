"""Semantic expression shapes, named after the action units they play, and the model's own basis of them.

The model's expression directions are principal components of these shapes under a distribution of activations
(another one for each version), so its coefficients are orthogonal, ordered by variance and mean nothing
by name, as FLAME's do. `semantic_to_coefficients` leads from names to coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from .anatomy import MOUTH_HALF_WIDTH, lip_arc
from .eyelids import blink, keep_off_eyes, lid_turn
from .rig import jaw_weight, smoothstep
from .surface import Surface

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

    ``names`` are the K shapes the basis plays; a version with eyelid bases leaves the blinks to those.
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
    With activations a ~ N(0, L L'), displacements are a'D. The SVD L'D = U S W' gives directions S W',
    orthogonal and in order of variance, whose coefficients are N(0, 1); activations a have the coefficients
    a inv(L') U.
    """
    stack = np.stack([field.ravel() for field in shapes.values()])
    random = np.random.default_rng(seed)
    mixing = np.eye(len(stack)) + 0.35 * random.standard_normal((len(stack),) * 2) / np.sqrt(len(stack))
    root = deviation[:, None] * mixing
    u, s, w = np.linalg.svd(root.T @ stack, full_matrices=False)
    sign = np.sign(w[np.arange(len(w)), np.abs(w).argmax(axis=1)])  # an SVD's signs are arbitrary: fix them
    directions = (s * sign)[:, None] * w
    vertices = len(next(iter(shapes.values())))
    return ExpressionBasis(
        directions=directions.reshape(-1, vertices, 3).transpose(1, 2, 0),
        names=tuple(shapes),
        from_semantic=np.linalg.solve(root.T, u * sign),
    )
