"""The least-squares problem of one timestep, reduced to a cost independent of the number of vertices.

In the frame of the head (neck joint at rest), with x = X z the unposed vertices for
z = (expression, eyelids, correctives, 1), linear blend skinning is

    v = x + lids + sum_j w_j (R_j - I) (x - c_j),      c_j = K_j z the pivot of joint j,

for the jaw, the eyes and, if the neck rotates, the root relative to the head. With D_j = R_j - I that is linear in z
and in the entries of D_j: row r of v is ``(X_r + sum_jc D_j[r, c] F_jc) z`` with ``F_jc = w_j (X_c - K_jc)``.
So the squared distance to a target is a quadratic in z whose matrix is a sum of constant Gram matrices, each times
a product of at most two entries of D. They are computed once per subject; a timestep contributes the products of its
target with X and F. For given angles the best coefficients then follow in closed form (variable projection: Golub
and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables
separate", SIAM J. Numer. Anal. 10, 1973), and by the envelope theorem the gradient with respect to the angles is the
partial one. At most nine angles are searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ..arrays import JOINT_NAMES
from ..rotations import matrices_and_derivatives
from .settings import RefitSettings

ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(len(JOINT_NAMES))
SEARCHED = (JAW, LEFT_EYE, RIGHT_EYE)
"""Joints whose angles are searched, three components each, in this order."""
_PARENTS = (-1, ROOT, NECK, NECK, NECK)
_MILLIMETRES = 1e3


class FrameTerms(NamedTuple):
    """Terms of a timestep: products of its target with the bases, and the neck's rotation."""

    products: FloatArray  # (1 + 9 M, N), mm^2
    square: float  # mean squared length of the target, mm^2
    neck: FloatArray  # (3, 3)


class Evaluation(NamedTuple):
    """The problem at given angles."""

    value: float
    """Weighted mean of squared distances plus the prior, mm^2."""
    gradient: FloatArray
    """(9,) by the angles, mm^2 per radian."""
    coefficients: FloatArray
    """(E + L,) best expression, then eyelids."""


@dataclass(frozen=True, eq=False)
class _Terms:
    """Constant symmetric matrices, lower triangles packed in rows, and the product of entries of D for each.

    The first row is multiplied by 1, the next ones by single entries of D, the rest by entries of A'A, where A is the
    D_j side by side, (3, 3 M).
    """

    packed: FloatArray
    single: IntArray
    double: IntArray


class FitProblem:
    """The fit of one subject's head: expression, eyelids and angles to targets of some vertices.

    ``canonical``: (V, 3) unposed neutral head, metres. ``vertices``: (n,) vertices with targets. ``weights``: (n,)
    non-negative weights of the squared distances; only their ratios matter.
    """

    def __init__(
        self,
        head: HeadAsset,
        canonical: FloatArray,
        vertices: IntArray,
        weights: FloatArray,
        settings: RefitSettings,
    ):
        if tuple(int(parent) for parent in head.parents) != _PARENTS:
            found = str([int(parent) for parent in head.parents])
            raise InputError(f"head model {head.version!r}", "parents", f"FLAME's, {_PARENTS}", found)
        self.vertices = vertices
        self._share = np.asarray(weights, dtype=np.float64) / np.sum(weights)
        self.expression_size = head.expression_basis.shape[2]
        lids = 0 if head.eyelid_basis is None else head.eyelid_basis.shape[2]
        self._free_size = self.expression_size + lids
        keep = settings.neck == "keep"
        self._correctives = _used_correctives(head, vertices, keep)
        self._prior = settings.prior_mm**2
        limits = [settings.coefficient_bound] * self.expression_size + [settings.eyelid_bound] * lids
        self.bound = np.array(limits, dtype=np.float64)

        unposed, lid_part, pivots = self._columns(head, canonical)
        self._plain = unposed + lid_part  # (n, 3, N), millimetres, like all following values
        skin = np.asarray(head.skinning_weights[vertices], dtype=np.float64)
        turning = ([ROOT] if keep else []) + list(SEARCHED)
        self._turning = [joint for joint in turning if skin[:, joint].any()]
        self.searched = np.repeat([joint in self._turning for joint in SEARCHED], 3)
        self._turned: list[tuple[IntArray, FloatArray]] = []  # rows of a joint's vertices, (rows, 3, N)
        for joint in self._turning:
            rows = np.flatnonzero(skin[:, joint])
            pivot = pivots[NECK if joint == ROOT else joint]
            self._turned.append((rows, skin[rows, joint, None, None] * (unposed[rows] - pivot)))
        self.scale = self._angle_scale()
        size = self._plain.shape[2]
        self._lower = np.tril_indices(size)
        self._twice = np.where(self._lower[0] == self._lower[1], 1.0, 2.0)
        self._terms = self._gram_terms()

    def frames(self, targets: FloatArray, necks: FloatArray) -> list[FrameTerms]:
        """Reduce the targets of T timesteps. ``targets``: (T, n, 3) metres, in the frame of the head. ``necks``: (T, 3,
        3) rotations of the neck joint; used only if the settings keep them."""
        wanted = _MILLIMETRES * np.asarray(targets, dtype=np.float64)
        weighted = wanted * self._share[:, None]
        count, size = len(wanted), self._plain.shape[2]
        products = [(weighted.reshape(count, -1) @ self._plain.reshape(-1, size))[:, None]]
        for rows, turned in self._turned:
            rows_of_head = weighted[:, rows].transpose(0, 2, 1).reshape(3 * count, -1)
            block = rows_of_head @ turned.reshape(len(rows), -1)  # row: target's component; columns: (c, N)
            products.append(block.reshape(count, 9, size))
        stacked = np.concatenate(products, axis=1)
        squares = np.einsum("tni,tni->t", weighted, wanted)
        return [FrameTerms(*parts) for parts in zip(stacked, squares.tolist(), necks, strict=True)]

    def evaluate(self, frame: FrameTerms, angles: FloatArray) -> Evaluation:
        """Find the best coefficients for ``angles``, (9,) of the joints `SEARCHED`, and the value there."""
        rotations, derivatives = matrices_and_derivatives(angles.reshape(-1, 3))
        bends, turns = rotations - np.eye(3), {ROOT: frame.neck.T - np.eye(3)}
        turns |= dict(zip(SEARCHED, bends))
        deltas = [turns[joint] for joint in self._turning]
        entries = np.concatenate([np.ravel(delta) for delta in deltas]) if deltas else np.zeros(0)
        side_by_side = np.concatenate(deltas, axis=1) if deltas else np.zeros((3, 0))
        terms, split = self._terms, self._free_size
        doubles = (side_by_side.T @ side_by_side).ravel()[terms.double]
        factors = np.concatenate([[1.0], entries[terms.single], doubles])
        gram = np.zeros((self._plain.shape[2],) * 2)
        gram[self._lower] = factors @ terms.packed
        fixed = self._fixed(frame, bends)
        product = frame.products[0] + entries @ frame.products[1:]

        normal = gram[:split, :split]
        normal[np.diag_indices(split)] += self._prior
        free = solve_bounded(normal, product[:split] - fixed @ gram[split:, :split], self.bound)
        whole = np.concatenate([free, fixed])
        sums = terms.packed @ ((whole[self._lower[0]] * whole[self._lower[1]]) * self._twice)
        value = factors @ sums - 2 * whole @ product + frame.square + self._prior * (free @ free)

        by_entry = -2 * (frame.products[1:] @ whole)
        by_entry[terms.single] += sums[1 : 1 + len(terms.single)]
        by_double = np.zeros(side_by_side.shape[1] ** 2)
        by_double[terms.double] = sums[1 + len(terms.single) :]
        by_double = by_double.reshape((side_by_side.shape[1],) * 2)
        spread = side_by_side @ (by_double + by_double.T)
        by_matrix = {joint: np.zeros((3, 3)) for joint in range(len(JOINT_NAMES))}
        for index, joint in enumerate(self._turning):
            derivative = by_entry[9 * index : 9 * index + 9].reshape(3, 3)
            by_matrix[joint] = derivative + spread[:, 3 * index : 3 * index + 3]
        corner = np.tril(gram[split:, split:]) + np.tril(gram[split:, split:], -1).T
        by_fixed = 2 * (gram[split:, :split] @ free + corner @ fixed - product[split:])
        for (joint, entry), slope in zip(self._correctives, by_fixed):
            by_matrix[joint].flat[entry] += slope
        stacked = np.stack([by_matrix[joint] for joint in SEARCHED])
        gradient = np.einsum("jrc,jrck->jk", stacked, derivatives).ravel()
        return Evaluation(float(value), gradient * self.searched, free)

    def fitted(self, frame: FrameTerms, angles: FloatArray, coefficients: FloatArray) -> FloatArray:
        """(n, 3) vertices in the frame of the head, metres, for angles (9,) and coefficients (E + L,)."""
        bends = matrices_and_derivatives(angles.reshape(-1, 3))[0] - np.eye(3)
        return self._skinned(frame, bends, np.concatenate([coefficients, self._fixed(frame, bends)]))

    def directions(self, frame: FrameTerms, angles: FloatArray) -> FloatArray:
        """(n, 3, E + L) derivatives of the fitted vertices by the coefficients at angles (9,), metres. This is the
        dense matrix that `evaluate` avoids, for checks and for solvers that need it."""
        bends = matrices_and_derivatives(angles.reshape(-1, 3))[0] - np.eye(3)
        size = self._plain.shape[2]
        return self._skinned(frame, bends, np.eye(size)[:, : self._free_size])

    def _skinned(self, frame: FrameTerms, bends: FloatArray, whole: FloatArray) -> FloatArray:
        """Vertices of values of z, (N,) or (N, m), metres."""
        turns = {ROOT: frame.neck.T - np.eye(3)} | dict(zip(SEARCHED, bends))
        result = self._plain @ whole
        for joint, (rows, turned) in zip(self._turning, self._turned):
            result[rows] += np.einsum("rc,nc...->nr...", turns[joint], turned @ whole)
        return np.asarray(result / _MILLIMETRES)

    def _columns(self, head: HeadAsset, canonical: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, 3, N) vertices without eyelids, (n, 3, N) eyelids alone, and (J, 3, N) joints, by the columns of z; millimetres."""
        rows, lids = self.vertices, self._free_size - self.expression_size
        columns = [9 * (joint - 1) + entry for joint, entry in self._correctives]
        expression = np.asarray(head.expression_basis, dtype=np.float64)
        parts = [
            expression[rows],
            np.zeros((len(rows), 3, lids)),
            np.asarray(head.pose_basis[rows][:, :, columns], dtype=np.float64),
            np.asarray(canonical[rows], dtype=np.float64)[..., None],
        ]
        unposed = np.concatenate(parts, axis=2)
        lid_part = np.zeros_like(unposed)
        if head.eyelid_basis is not None:
            lid_part[:, :, self.expression_size : self._free_size] = head.eyelid_basis[rows]
        regressor = np.asarray(head.joint_regressor, dtype=np.float64)
        pivots = np.zeros((len(regressor), *unposed.shape[1:]))
        pivots[:, :, : self.expression_size] = np.tensordot(regressor, expression, 1)
        pivots[:, :, -1] = regressor @ canonical
        return _MILLIMETRES * unposed, _MILLIMETRES * lid_part, _MILLIMETRES * pivots

    def _angle_scale(self) -> FloatArray:
        """(9,) radians per unit of a well-scaled search: the inverse of the lever arm of each joint."""
        arms = np.ones(len(SEARCHED))
        for joint, (rows, turned) in zip(self._turning, self._turned):
            if joint in SEARCHED:
                arm = np.sqrt(self._share[rows] @ np.square(turned[..., -1]).sum(axis=1))
                arms[SEARCHED.index(joint)] = max(arm, 1e-6)
        return np.repeat(1 / arms, 3)

    def _fixed(self, frame: FrameTerms, bends: FloatArray) -> FloatArray:
        """(N - E - L,) the part of z determined by the angles: entries of R - I for correctives, and 1."""
        by_joint = {NECK: frame.neck - np.eye(3)} | dict(zip(SEARCHED, bends))
        return np.array([*(by_joint[joint].flat[entry] for joint, entry in self._correctives), 1.0])

    def _gram_terms(self) -> _Terms:
        size, joints = self._plain.shape[2], len(self._turned)
        plain = self._plain.reshape(-1, size)
        kept = [self._pack(plain.T @ (np.repeat(self._share, 3)[:, None] * plain))]
        single: list[int] = []
        double: list[int] = []
        for index, (rows, turned) in enumerate(self._turned):
            share = self._share[rows, None]
            for r in range(3):
                for c in range(3):
                    both = self._plain[rows, r].T @ (share * turned[:, c])
                    if both.any():
                        kept.append(self._pack(both + both.T))
                        single.append(9 * index + 3 * r + c)
        for one in range(3 * joints):
            for other in range(one, 3 * joints):
                product = self._turned_product(one, other)
                if product.any():
                    kept.append(self._pack(product if one == other else product + product.T))
                    double.append(3 * joints * one + other)
        return _Terms(np.stack(kept), np.array(single, dtype=np.int64), np.array(double, dtype=np.int64))

    def _turned_product(self, one: int, other: int) -> FloatArray:
        """F_jc' W F_kd over the vertices that both joints move; ``one`` is 3 j + c, ``other`` 3 k + d."""
        (rows, turned), (other_rows, other_turned) = self._turned[one // 3], self._turned[other // 3]
        _, here, there = np.intersect1d(rows, other_rows, assume_unique=True, return_indices=True)
        weighted = self._share[rows[here], None] * turned[here, one % 3]
        return np.asarray(weighted.T @ other_turned[there, other % 3])

    def _pack(self, symmetric: FloatArray) -> FloatArray:
        return np.asarray(symmetric[self._lower])


def _used_correctives(head: HeadAsset, vertices: IntArray, neck: bool) -> Sequence[tuple[int, int]]:
    """(joint, entry of R - I in row-major order) of the pose correctives that move the vertices."""
    basis = head.pose_basis[vertices]
    joints = ((NECK,) if neck else ()) + SEARCHED
    return [
        (joint, entry) for joint in joints for entry in range(9) if basis[:, :, 9 * (joint - 1) + entry].any()
    ]


_ITERATIONS = 100


def solve_bounded(gram: FloatArray, right: FloatArray, bound: FloatArray) -> FloatArray:
    """Minimise x' G x / 2 - r' x over |x_i| <= b_i.

    Projected Newton steps (Bertsekas, "Projected Newton methods for optimization problems with simple
    constraints", SIAM J. Control Optim. 20, 1982): components held at their bound by the gradient are fixed, the
    others take a Newton step, shortened until it descends. Without active bounds that is one Cholesky solution.

    ``gram``: (n, n) symmetric positive definite; only the lower triangle is read. ``bound``: (n,) positive.
    """
    x = _solve(gram, right)
    if (np.abs(x) <= bound).all():
        return x
    whole = np.tril(gram) + np.tril(gram, -1).T
    x = np.clip(x, -bound, bound)
    for _ in range(_ITERATIONS):
        gradient = whole @ x - right
        held = (np.abs(x) >= bound) & (gradient * x < 0)
        free = np.flatnonzero(~held)
        step = np.zeros_like(x)
        if len(free):
            step[free] = _solve(whole[np.ix_(free, free)], -gradient[free])
        scale = 1.0
        while scale > 1e-10:
            moved = np.clip(x + scale * step, -bound, bound)
            change = moved - x
            if gradient @ change + 0.5 * change @ whole @ change <= 1e-4 * gradient @ change:
                break
            scale *= 0.5
        else:
            return x
        done = np.abs(change).max(initial=0.0) <= 1e-12 * (1 + np.abs(x).max())
        x = moved
        if done:
            return x
    return x


def _solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    _, solution, failed = dposv(gram, right, lower=1)
    if failed:
        raise ValueError("the normal equations are not positive definite")
    return np.asarray(solution)


_ALGORITHMS = {"slsqp": "LD_SLSQP", "lbfgs": "LD_LBFGS", "mma": "LD_MMA"}
"""Names of nlopt's constants."""


class Solution(NamedTuple):
    """A fitted timestep."""

    coefficients: FloatArray
    """(E + L,) expression, then eyelids."""
    angles: FloatArray
    """(9,) jaw, left eye, right eye; axis-angle, radians."""
    value: float
    """Value of the objective, mm^2."""
    evaluations: int


def angle_bounds(settings: RefitSettings) -> FloatArray:
    """(9,) largest magnitudes of the angles."""
    return np.repeat([settings.jaw_bound] + [settings.eye_bound] * (len(SEARCHED) - 1), 3)


def solve_frame(
    problem: FitProblem, frame: FrameTerms, start: FloatArray, fixed: FloatArray, settings: RefitSettings
) -> Solution:
    """Fit one timestep. ``start``: (9,) initial angles, such as the previous timestep's. ``fixed``: (9,) values of the
    angles that move no vertex with a target, which are not optimised."""
    searched, limit = problem.searched, angle_bounds(settings)
    scale = problem.scale[searched]
    best: list[Solution] = []
    count = 0

    def objective(values: FloatArray, gradient: FloatArray) -> float:
        nonlocal count
        count += 1
        angles = np.where(searched, 0.0, fixed)
        angles[searched] = values * scale
        evaluation = problem.evaluate(frame, angles)
        if gradient.size:
            gradient[:] = evaluation.gradient[searched] * scale
        if not best or evaluation.value < best[0].value:
            best[:] = [Solution(evaluation.coefficients, angles, evaluation.value, count)]
        return evaluation.value

    first = np.clip(start, -limit, limit)[searched] / scale
    if not searched.any():
        objective(first, np.zeros(0))
        return best[0]
    import nlopt

    search = nlopt.opt(getattr(nlopt, _ALGORITHMS[settings.algorithm]), int(searched.sum()))
    search.set_min_objective(objective)
    search.set_lower_bounds(-limit[searched] / scale)
    search.set_upper_bounds(limit[searched] / scale)
    search.set_xtol_abs(settings.tolerance / scale)
    search.set_maxeval(settings.evaluations)
    try:
        search.optimize(first)
    except (nlopt.RoundoffLimited, nlopt.runtime_error):
        pass  # No step descends further, or a line search failed: the best point so far is the result.
    return best[0]._replace(evaluations=count)
