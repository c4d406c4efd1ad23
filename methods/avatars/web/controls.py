"""Controls of an avatar in a page: sliders, and recorded sequences as slider values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ....bench.contracts import Clip, FloatArray, HeadPose
from ....bench.expressions import expressions_of
from ....datasets.head.arrays import HeadArrays
from ....datasets.novelty import displacement_metric
from .model import JOINTS, Slider

JAW, JAW_SIDE, NECK, EYES = 0.4, 0.12, 0.4, 0.4
"""Radians."""
MOST_HIDDEN = 6
"""Maximum number of additional expression directions for recorded sequences, which increase the page's size."""
STILL_M = 2e-4
"""Root mean square error of vertices below which no further direction is added."""
SEQUENCES = {"train": "", "novel_view": "", "self_reenactment": "held out"}
"""Splits with frames to replay, and their description in a page."""
MOST_TIMESTEPS = 500
"""Maximum length of a sequence; longer ones are cut to limit the page's size."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded sequence: its poses in order, and whether it was held out of training."""

    name: str
    note: str
    poses: Sequence[HeadPose]


def recorded_sequences(clip: Clip, version: str) -> list[Recorded]:
    """The sequences of a capture in order, those held out last; none if it was tracked with another head model."""
    found: dict[tuple[str, str], dict[int, HeadPose]] = {}
    for split, note in SEQUENCES.items():
        for key in sorted(clip.splits.get(split, ())):
            pose = clip.poses[key.timestep]
            if pose.head_model == version:
                found.setdefault((key.sequence, note), {})[key.timestep] = pose
    return [
        Recorded(*name, [poses[timestep] for timestep in sorted(poses)][:MOST_TIMESTEPS])
        for name, poses in found.items()
    ]


def make_sliders(head: HeadArrays, count: int, poses: Sequence[HeadPose]) -> tuple[Slider, ...]:
    """The strongest expressions, then jaw, neck and eyes; then directions without a name that ``poses`` need."""
    chosen = [_expression(*shape) for shape in expressions_of(head, count, poses)]
    both = (JOINTS.index("left eye"), JOINTS.index("right eye"))
    return (
        *chosen,
        Slider("jaw open", (1,), 0, (), 0.0, JAW, 0.75 * JAW),
        Slider("jaw sideways", (1,), 1, (), -JAW_SIDE, JAW_SIDE, JAW_SIDE),
        *(
            Slider(f"neck {name}", (0,), axis, (), -NECK, NECK, 0.75 * NECK)
            for axis, name in enumerate(("nod", "turn", "tilt"))
        ),
        *(
            Slider(f"eyes {name}", both, axis, (), -EYES, EYES, 0.75 * EYES)
            for axis, name in enumerate(("up and down", "sideways"))
        ),
        *_hidden(head, chosen, poses),
    )


def slider_values(head: HeadArrays, sliders: Sequence[Slider], poses: Sequence[HeadPose]) -> FloatArray:
    """(T, M) values of the sliders that replay poses: expressions by least squares over the vertices."""
    values = np.zeros((len(poses), len(sliders)))
    columns = [number for number, slider in enumerate(sliders) if not slider.joints]
    directions = np.array([sliders[number].direction for number in columns])
    values[:, columns] = _fitted(_root(head), directions, np.array([pose.expression for pose in poses]))
    for number, slider in enumerate(sliders):
        if slider.joints:
            turns = [_turn(poses, joint)[:, slider.axis] for joint in slider.joints]
            values[:, number] = np.mean(turns, axis=0)
    return values


def packed_sequences(
    head: HeadArrays, sliders: Sequence[Slider], sequences: Sequence[Recorded]
) -> list[dict[str, Any]]:
    """The sequences for the header of a page, their values relative to the step of each slider."""
    steps = np.array([slider.step for slider in sliders])
    packed = []
    for sequence in sequences:
        values = slider_values(head, sliders, sequence.poses) / steps
        packed.append({"name": sequence.name, "note": sequence.note, "values": values.round(3).tolist()})
    return packed


def _expression(name: str, direction: FloatArray, low: float, high: float) -> Slider:
    return Slider(name, (), 0, tuple(float(value) for value in direction.round(5)), low, high, high / 2)


def _root(head: HeadArrays) -> FloatArray:
    """(E, E) R with \\|R c\\| the root mean square displacement of the vertices, metres, by coefficients c."""
    return displacement_metric(head.expression_basis).T


def _fitted(root: FloatArray, directions: FloatArray, wanted: FloatArray) -> FloatArray:
    """(T, K) values of (K, E) directions for (T, E) coefficients."""
    if not len(directions):
        return np.zeros((len(wanted), 0))
    return np.asarray(np.linalg.lstsq(root @ directions.T, root @ wanted.T, rcond=1e-6)[0].T)


def _hidden(head: HeadArrays, chosen: Sequence[Slider], poses: Sequence[HeadPose]) -> list[Slider]:
    """Principal directions of the residual of the poses' expressions after the fit by the chosen sliders."""
    if not poses:
        return []
    root, wanted = _root(head), np.array([pose.expression for pose in poses], np.float64)
    directions = np.array([slider.direction for slider in chosen]).reshape(-1, wanted.shape[1])
    left = wanted - _fitted(root, directions, wanted) @ directions
    _, sizes, axes = np.linalg.svd(left @ root.T, full_matrices=False)
    rms = np.sqrt(np.cumsum(sizes[::-1] ** 2)[::-1] / len(poses))  # residual before each direction
    found = []
    for axis in axes[: min(MOST_HIDDEN, int((rms > STILL_M).sum()))]:
        direction = np.linalg.lstsq(root, axis, rcond=1e-6)[0]
        far = float(np.abs(left @ root.T @ axis).max())
        found.append(_expression("", far * direction, -1.0, 1.0))
    return found


def _turn(poses: Sequence[HeadPose], joint: int) -> FloatArray:
    name, first = (("neck", 0), ("jaw", 0), ("eyes", 0), ("eyes", 3))[joint]
    return np.array([getattr(pose, name)[first : first + 3] for pose in poses], np.float64)
