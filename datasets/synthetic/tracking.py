"""Simulated errors of the stored tracking at a chosen level.

Trackers fit a regularised model to images: coefficients are biased towards zero, a basis that does not match the face
represents an expression by a mix of others, and the remaining error drifts. Lips and lids suffer most: they move fastest and
have the fewest vertices. Images always show the exact poses.

Two kinds of trackers differ in the drift. One works frame by frame: its error changes from timestep to timestep, however far
apart these are. One of videos has an error for each sequence that lasts, and drift and jitter with time constants in seconds; its
amounts are those of tracked recordings of NeRSemble.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from scipy.optimize import nnls

from ...bench.contracts import FloatArray, HeadPose
from ...bench.protocol import evenly_with_ends
from ..head.arrays import HeadArrays, region
from ..head.geometry import COEFFICIENT_BITS, on_grid, share_left
from ..head.model import HeadModel
from .anatomy import SIDES
from .performance import EXPRESSION_CONTROLS, Activations, Translation

FIELDS = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")

FACE_MM, DETAIL_MM = 0.5, 2.5
"""Root mean square displacement at level 1: of the face by the error that is everywhere, and of lips and lids by all."""
LID_SHARE = 0.5
"""Fraction of the largest displacement by a blink above which a vertex belongs to the lids."""
PERSISTENCE = 0.8
"""Correlation of the drift from one timestep to the next."""
SHRINKAGE = (0.05, 0.3)
"""Fraction by which regularisation shrinks a coefficient, drawn for each coefficient."""
MIXING = 0.3
"""Norm of the leakage of a unit coefficient into the others."""
_MOMENTS = 48  # number of poses on which amplitudes are measured
_PROBE = 1e-2  # scale of an error at which its displacement is measured, in the linear range
DRIFT = 0.2
"""Amplitude of the drift, in spreads of a parameter or relative to the range of a control."""
LASTING, LASTING_DRIFT, JITTER = 0.35, 0.2, 0.1
"""Amplitudes of a tracker of videos, in spreads: an error that lasts for a sequence, drift, jitter."""
DRIFT_SECONDS, JITTER_SECONDS = 2.0, 0.1
VIDEO_DETAIL_MM = 1.2
"""Of lips and lids at level 1 by a tracker of videos, which regularises over time."""
STARTING, START_SECONDS, START_SHARE = 0.5, 0.12, 1.0 / 3.0
"""Error with which a sequence begins, in spreads, the time in which it decays to 1/e, and the share of coefficients that have it."""
GAZE_JITTER, SIDE_JITTER, DEPTH_JITTER = np.radians(0.3), np.radians(0.13), 3.5e-4
"""Deviation of jitter at level 1 of a tracker of videos: eyes and jaw sideways in radians, distance from the cameras in metres.

Third differences at a video's rate, by which jitter of recordings was measured, show about half."""
Tracker = Literal["per-frame", "video"]
TRACKERS: tuple[Tracker, ...] = get_args(Tracker)
LID_CONTROLS = tuple(f"{name}_{side}" for name in ("blink", "squint", "eye_wide") for side in SIDES)
LIP_CONTROLS = (
    *(f"{name}_{side}" for name in ("upper_lip_up", "lower_lip_down") for side in SIDES),
    *("pucker", "funnel", "lip_press", "lip_roll", "mouth_left", "mouth_right"),
)


def with_tracking_noise(poses: Sequence[HeadPose], amount: float, seed: int) -> list[HeadPose]:
    """Add Gaussian noise to every parameter, independent from timestep to timestep.

    Its standard deviation is ``amount`` times that parameter's own over ``poses``, so a parameter that never
    moves stays exact. ``amount`` 0 returns the poses as they are.
    """
    if amount == 0.0:
        return list(poses)
    rng = np.random.default_rng([seed, 5])
    noise: dict[str, FloatArray] = {}
    for name, values in _values(poses).items():
        noise[name] = amount * values.std(axis=0) * rng.standard_normal(values.shape)
    return _moved(poses, noise)


def with_tracking_error(
    sequences: Mapping[str, Sequence[HeadPose]],
    activations: Mapping[str, Sequence[Activations]],
    translation: Translation,
    head: HeadArrays,
    shape: FloatArray,
    level: float,
    seed: int,
    tracker: Tracker = "per-frame",
    steps: Mapping[str, float] | None = None,
) -> dict[str, list[HeadPose]]:
    """Poses with simulated tracking errors; drift is independent in each sequence.

    ``sequences``, ``activations``, ``translation``: Exact poses, the controls that made them, and the conversion between
    them. ``level``: 0 returns the poses unchanged; 1 displaces the face by 0.5 to 1 mm, lips and lids by about `DETAIL_MM`
    or `VIDEO_DETAIL_MM`, and so on in proportion. ``tracker``: Whether errors drift from timestep to timestep or in time.
    ``steps``: Seconds between timesteps of each sequence, for a tracker of videos.
    """
    if level == 0.0:
        return {name: list(each) for name, each in sequences.items()}
    poses = [pose for each in sequences.values() for pose in each]
    rng = np.random.default_rng([seed, 6])
    begins = {0, *itertools.accumulate(map(len, sequences.values()))}
    if tracker == "video":
        assert steps is not None
        intervals = np.concatenate([np.full(len(each), steps[name]) for name, each in sequences.items()])
        drift: Callable[[tuple[int, ...]], FloatArray] = lambda shape: _lasting(shape, begins, intervals, rng)
        detail = VIDEO_DETAIL_MM
    else:
        drift, detail = (lambda shape: DRIFT * _drift(shape, begins, PERSISTENCE, rng)), DETAIL_MM
    values = _values(poses)
    overall: dict[str, FloatArray] = {}
    for name, exact in values.items():
        # Includes a fraction of the overall spread, so that nearly constant parameters have errors too.
        spread = np.maximum(exact.std(axis=0), 0.1 * exact.std() + 1e-4)
        overall[name] = spread * drift(exact.shape)
    overall["expression"] += _systematic(values["expression"], rng)
    errors = [overall]
    for names in (LIP_CONTROLS, LID_CONTROLS):
        rows = [EXPRESSION_CONTROLS.index(name) for name in names]
        played = np.array([[a[name] for name in names] for each in activations.values() for a in each])
        wrong = drift(played.shape) - rng.uniform(*SHRINKAGE, len(names)) * played
        matrices = {"expression": translation.expression, "eyelids": translation.eyelids}
        errors.append(
            {
                name: (wrong[:, :, None] * matrix[rows]).sum(axis=1)
                for name, matrix in matrices.items()
                if matrix is not None
            }
        )
    measure = _Displacement(head, shape, translation, poses)
    everywhere, *local = map(measure, errors)
    # Squares of displacements add up, but for what errors have in common.
    first = (FACE_MM**2) / everywhere[0]
    wanted = detail**2 - first * everywhere[1:]
    others, _ = nnls(np.stack([squares[1:] for squares in local], axis=1), np.maximum(wanted, 0.0))
    amplitudes = on_grid(level * np.sqrt([first, *others]), COEFFICIENT_BITS)
    total = {
        name: sum(amplitude * error[name] for amplitude, error in zip(amplitudes, errors) if name in error)
        for name in overall
    }
    if tracker == "video":
        for name, column, amount in _OWN_JITTER:
            kept = share_left(intervals, JITTER_SECONDS)
            total[name][:, column] += level * amount * _drift((len(poses), 1), begins, kept, rng)
    moved = iter(_moved(poses, total))
    return {name: [next(moved) for _ in each] for name, each in sequences.items()}


def _systematic(expression: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(T, E) change of expression coefficients by shrinkage and leakage."""
    size = expression.shape[1]
    shrinkage = rng.uniform(*SHRINKAGE, size)
    mixing = rng.standard_normal((size, size)) * (MIXING / np.sqrt(size))
    np.fill_diagonal(mixing, -shrinkage)
    spread = np.maximum(expression.std(axis=0), 1e-6)
    # In units of each coefficient's own spread, so that none leaks into one that the face hardly uses.
    units = expression / spread
    return np.stack([(row[:, None] * mixing).sum(axis=0) for row in units]) * spread


def _drift(
    shape: tuple[int, ...], begins: Collection[int], persistence: float | FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(T, n) unit noise, each row correlated by ``persistence`` with the one before unless a sequence begins there."""
    fresh = rng.standard_normal(shape)
    kept = np.broadcast_to(persistence, shape[0])
    drift = fresh.copy()
    for row in range(1, shape[0]):
        if row not in begins:
            drift[row] = kept[row] * drift[row - 1] + np.sqrt(1 - kept[row] ** 2) * fresh[row]
    return drift


def _lasting(
    shape: tuple[int, ...], begins: Collection[int], apart: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(T, n) error of a tracker of videos in spreads; ``apart`` (T,) are the seconds between rows."""
    error = LASTING * _drift(shape, begins, 1.0, rng)
    error += LASTING_DRIFT * _drift(shape, begins, share_left(apart, DRIFT_SECONDS), rng)
    error += JITTER * _drift(shape, begins, share_left(apart, JITTER_SECONDS), rng)
    starting = STARTING * rng.standard_normal(shape[1]) * (rng.random(shape[1]) < START_SHARE)
    decay, left = share_left(apart, START_SECONDS), np.ones(shape[0])
    for row in range(1, shape[0]):
        left[row] = 1.0 if row in begins else decay[row] * left[row - 1]
    return error + left[:, None] * starting


_OWN_JITTER = (
    *(("eyes", column, GAZE_JITTER) for column in ([0, 3], [1, 4])),
    ("jaw", [1], SIDE_JITTER),
    ("translation", [2], DEPTH_JITTER),
)
"""Field, columns that move together, and amplitude."""


class _Displacement:
    """Mean squared displacement, mm², of face (without lips and lids), lips and lids by an error of the poses."""

    def __init__(
        self, head: HeadArrays, shape: FloatArray, translation: Translation, poses: Sequence[HeadPose]
    ):
        self._model = HeadModel(head, dtype=torch.float64)
        self._canonical = self._model.canonical(torch.from_numpy(shape))
        blinks = [EXPRESSION_CONTROLS.index(f"blink_{side}") for side in SIDES]
        closing = np.abs(np.asarray(head.expression_basis) @ translation.expression[blinks].sum(axis=0)).sum(
            1
        )
        if translation.eyelids is not None and head.eyelid_basis is not None:
            lids = np.asarray(head.eyelid_basis) @ translation.eyelids[blinks].sum(axis=0)
            closing = closing + np.abs(lids).sum(axis=1)
        skin = np.setdiff1d(
            region(head, "face"), np.union1d(region(head, "left_eyeball"), region(head, "right_eyeball"))
        )
        lids = skin[closing[skin] > LID_SHARE * closing[skin].max()]
        lips = np.asarray(region(head, "lips"))
        self.parts = {"face": np.setdiff1d(skin, np.union1d(lips, lids)), "lips": lips, "lids": lids}
        self._rows = evenly_with_ends(range(len(poses)), _MOMENTS)
        self._poses = [poses[row] for row in self._rows]
        self._exact = self._vertices(self._poses)

    def __call__(self, errors: Mapping[str, FloatArray]) -> FloatArray:
        """One number for each part, of errors by field of all poses."""
        small = {name: _PROBE * error[self._rows] for name, error in errors.items()}
        moved = self._vertices(_moved(self._poses, small, exact=True)) - self._exact
        squared = (moved / _PROBE * 1e3) ** 2
        return np.array([squared[:, part].sum(axis=2).mean() for part in self.parts.values()])

    def _vertices(self, poses: Sequence[HeadPose]) -> FloatArray:
        with torch.no_grad():
            arguments = self._model.pose_arguments(poses)
            return self._model(canonical=self._canonical, **arguments).numpy()


def _values(poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
    """(T, n) values of the poses' fields, by name."""
    present = [name for name in FIELDS if getattr(poses[0], name) is not None]
    return {name: np.stack([getattr(pose, name) for pose in poses]) for name in present}


def _moved(
    poses: Sequence[HeadPose], errors: Mapping[str, FloatArray], *, exact: bool = False
) -> list[HeadPose]:
    """Poses with errors added, rounded to float32 as they are stored unless ``exact``."""
    moved = []
    for row, pose in enumerate(poses):
        fields: dict[str, Any] = {name: getattr(pose, name) + error[row] for name, error in errors.items()}
        if not exact:
            fields = {name: value.astype(np.float32).astype(np.float64) for name, value in fields.items()}
        moved.append(replace(pose, **fields))
    return moved
