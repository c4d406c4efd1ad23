"""The avatar of a web page: splats, linear morphs, skinning by a few joints, harmonics.

All values are in the head's frame, metres: the root joint does not rotate, x points to the head's left, y up, z to the
front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ....bench.contracts import FloatArray
from ....datasets.head.model import joint_motions
from ....datasets.head.rotations import axis_angle_to_matrix
from ...ops.harmonics import sh_basis

JOINTS = ("neck", "jaw", "left eye", "right eye")
PARENTS = (-1, 0, 0, 0)


class Slider(NamedTuple):
    """An expression, or a rotation of joints about an axis, with its morph."""

    name: str
    """"" for motion that recorded sequences need besides the other sliders; it has no control."""
    joints: tuple[int, ...]
    """Indices into `JOINTS` of the joints that it rotates; none for an expression."""
    axis: int
    """0, 1 or 2 for x, y, z."""
    direction: tuple[float, ...]
    """(E,) expression coefficients at 1; () for joints."""
    low: float
    high: float
    """Ends of the slider: multiples of ``direction``, or radians."""
    step: float
    """Value at which its morph has full weight."""


class Moved(NamedTuple):
    """Splats in the head's frame: (N, 3) means, (N, 3, 3) axes times scales, (N,) opacities, (N, 3) colours."""

    means: FloatArray
    axes: FloatArray
    opacities: FloatArray
    colors: FloatArray


@dataclass(frozen=True, eq=False)
class WebAvatar:
    """Content of a page as float arrays. N splats, M sliders."""

    means: FloatArray
    rotations: FloatArray
    log_scales: FloatArray
    logits: FloatArray
    """(N, 3), (N, 3, 3), (N, 3), (N,) of the face at rest."""
    harmonics: FloatArray
    """(N, 3, K), in 3DGS' order and signs, as functions of the direction from the camera to the splat."""
    turned: bool
    """Whether harmonics rotate with the head; otherwise they are fixed in the world."""
    weights: FloatArray
    """(N, 4) skinning weights of `JOINTS`; the remainder to 1 stays with the shoulders."""
    joints: FloatArray
    """(4, 3) positions."""
    sliders: tuple[Slider, ...]

    d_means: FloatArray
    d_turns: FloatArray
    d_log_scales: FloatArray
    d_logits: FloatArray
    d_colors: FloatArray
    """(M, N, 3), (M, N, 3), (M, N, 3), (M, N), (M, N, 3): changes at ``step`` before skinning; turns are rotation vectors."""

    def moved(self, values: FloatArray, center: FloatArray) -> Moved:
        """The splats with the sliders at (M,) values, and their colours seen from a (3,) point."""
        steps = np.asarray(values, np.float64) / [slider.step for slider in self.sliders]

        def added(morphs: FloatArray) -> FloatArray:
            return np.asarray(np.tensordot(steps, np.asarray(morphs, np.float64), axes=1))

        linear, shift = blended(self.weights, slider_motions(self.sliders, values, self.joints))
        means = self.means + added(self.d_means)
        turn = rotation_of(added(self.d_turns)) @ self.rotations
        axes = linear @ turn * np.exp(self.log_scales + added(self.d_log_scales))[:, None, :]
        means = np.einsum("nij,nj->ni", linear, means) + shift
        along = means - center
        if self.turned:
            along = np.einsum("nji,nj->ni", linear, along)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        degree = int(np.sqrt(self.harmonics.shape[2])) - 1
        basis = sh_basis(torch.from_numpy(along), degree).numpy()
        colors = 0.5 + np.einsum("nck,nk->nc", self.harmonics, basis) + added(self.d_colors)
        return Moved(means, axes, 1 / (1 + np.exp(-self.logits - added(self.d_logits))), colors.clip(min=0.0))


def slider_motions(
    sliders: tuple[Slider, ...], values: FloatArray, joints: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(4, 3, 3) rotations and (4, 3) offsets of the joints; the neck also moves the others."""
    turns = np.zeros((len(JOINTS), 3))
    for slider, value in zip(sliders, values):
        for joint in slider.joints:
            turns[joint, slider.axis] += value
    rotations, rest = (torch.from_numpy(part)[None] for part in (rotation_of(turns), joints))
    motions = joint_motions(rotations, rest, PARENTS)
    return motions[0, :, :, :3].numpy(), motions[0, :, :, 3].numpy()


def blended(weights: FloatArray, motions: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """(N, 3, 3) and (N, 3): linear blend skinning (FLAME, section 3) of motions by (N, J) weights."""
    linear, shift = motions
    rest = 1.0 - weights.sum(axis=1)
    return (
        np.einsum("nj,jik->nik", weights, linear) + rest[:, None, None] * np.eye(3),
        weights @ shift,
    )


def rotation_of(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) rotations of (N, 3) rotation vectors."""
    return axis_angle_to_matrix(torch.from_numpy(np.asarray(vectors, np.float64))).numpy()
