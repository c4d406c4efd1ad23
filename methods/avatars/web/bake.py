"""Bakes splat avatars of any method for a web page by sampling their splats in chosen poses.

The avatar of a page has splats, linear morphs, skinning by a few joints, and harmonics. All values are in the head's frame, metres:
the root joint does not rotate, x points to the head's left, y up, z to the front.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ....bench.contracts import Camera, FloatArray, HeadPose, Progress, SplatAvatar
from ....datasets.head.model import joint_motions
from ....datasets.head.rotations import axis_angle_to_matrix
from ...ops.planes import sh_basis
from ...splats.reference import rotation_matrices
from ..harmonics import FAR_M, camera_at, direction_of, fit_harmonics, sphere, visibility

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
    return (np.einsum("nj,jik->nik", weights, linear) + rest[:, None, None] * np.eye(3), weights @ shift)


def rotation_of(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) rotations of (N, 3) rotation vectors."""
    return axis_angle_to_matrix(torch.from_numpy(np.asarray(vectors, np.float64))).numpy()


AWAY_M = 1.0
"""Distance of the camera at which colours are sampled."""
FEW_DIRECTIONS = ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0))
"""Azimuth and elevation of the views in which the change of colours by a slider is sampled."""
TRIAL_TURN = 0.25
LOGIT_MAX = 8.0


class Seen(NamedTuple):
    """Splats in the head's frame: (N, 3), (N, 3, 3), (N, 3), (N,) and (N, 3), the last None without a camera."""

    means: FloatArray
    rotations: FloatArray
    log_scales: FloatArray
    logits: FloatArray
    colors: FloatArray | None


@dataclass(frozen=True, eq=False)
class Source:
    """An avatar to bake."""

    avatar: SplatAvatar

    rest: HeadPose
    """The pose at rest: expression, neck, jaw and eyes are 0, rotation and translation those of the head."""
    root: FloatArray
    """(3,) position of the root joint without translation, the centre of ``rest.rotation``, metres."""
    joints: FloatArray
    """(4, 3) positions of neck, jaw, left and right eye in the head's frame."""

    def pose(self, sliders: Sequence[Slider], values: Sequence[float] | FloatArray) -> HeadPose:
        """The pose for given slider values."""
        parts = {
            name: np.array(getattr(self.rest, name), np.float64)
            for name in ("expression", "neck", "jaw", "eyes")
        }
        for slider, value in zip(sliders, values):
            if not slider.joints:
                parts["expression"] += value * np.array(slider.direction)
            for joint in slider.joints:
                name, first = (("neck", 0), ("jaw", 0), ("eyes", 0), ("eyes", 3))[joint]
                parts[name][first + slider.axis] += value
        changed: Any = {name: part.astype(getattr(self.rest, name).dtype) for name, part in parts.items()}
        return replace(self.rest, **changed)

    def camera(self, view: Camera) -> Camera:
        """A camera of the head's frame in the world of the pose at rest."""
        motion = np.eye(4)
        rotation = self.rotation
        motion[:3, :3] = rotation.T
        motion[:3, 3] = self.root - rotation.T @ (self.root + np.asarray(self.rest.translation, np.float64))
        return replace(view, world_to_camera=view.world_to_camera @ motion)

    def seen(self, pose: HeadPose, camera: Camera | None = None) -> Seen:
        """The splats of a pose with their colours for a camera in the head's frame."""
        splats = self.avatar.splats(pose, None if camera is None else self.camera(camera))
        rotation = self.rotation
        means = (splats.means - self.root - self.rest.translation) @ rotation + self.root
        quats = torch.from_numpy(np.asarray(splats.quats, np.float64))
        opacities = np.asarray(splats.opacities, np.float64).clip(1e-6, 1 - 1e-6)
        return Seen(
            np.asarray(means, np.float64),
            rotation.T @ rotation_matrices(quats).numpy(),
            np.log(np.maximum(np.asarray(splats.scales, np.float64), 1e-8)),
            np.log(opacities / (1 - opacities)).clip(-LOGIT_MAX, LOGIT_MAX),
            None if splats.colors is None else np.asarray(splats.colors, np.float64),
        )

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) from the head's frame to the world."""
        return rotation_of(np.asarray(self.rest.rotation, np.float64)[None])[0]


def bake(
    source: Source, sliders: tuple[Slider, ...], degree: int, directions: int, progress: Progress
) -> WebAvatar:
    """Sample the avatar with each slider at its step, and from all directions; see `WebAvatar`."""
    total = len(sliders) + 1
    rest = source.seen(source.rest)
    middle = rest.means.mean(axis=0)
    few = [camera_at(middle + AWAY_M * direction_of(*angles)) for angles in FEW_DIRECTIONS]
    colors = [colors_from(source, source.rest, camera) for camera in few]
    weights = skinning_weights(source, rest)
    harmonics = _harmonics(source, middle, degree, directions)
    progress(1, total, "at rest")
    morphs: dict[str, list[FloatArray]] = {
        name: [] for name in ("means", "turns", "log_scales", "logits", "colors")
    }
    for number, slider in enumerate(sliders):
        # Central differences for sliders with two sides keep only the linear part.
        steps = [slider.step] if slider.low >= 0 else [slider.step, -slider.step]
        changes = [_change(source, rest, slider, step, weights, few, colors) for step in steps]
        for name, change in morphs.items():
            signed = [found[name] * np.sign(step) for found, step in zip(changes, steps)]
            change.append(np.mean(signed, axis=0))
        progress(number + 2, total, slider.name)
    arrays: Mapping[str, FloatArray] = {f"d_{name}": np.stack(found) for name, found in morphs.items()}
    return WebAvatar(
        *(rest.means, rest.rotations, rest.log_scales, rest.logits, harmonics),
        turned=_turned(source, sliders, rest, weights, harmonics, degree, middle),
        weights=weights,
        joints=source.joints,
        sliders=sliders,
        **arrays,
    )


def colors_from(source: Source, pose: HeadPose, camera: Camera) -> FloatArray:
    """(N, 3) colours of the splats of a pose as a camera of the head's frame sees them."""
    colors = source.seen(pose, camera).colors
    assert colors is not None  # the camera is given
    return colors


def skinning_weights(source: Source, rest: Seen) -> FloatArray:
    """(N, 4) skinning weights: least squares over a turn of each joint about x and y."""
    moves = np.zeros((len(rest.means), len(JOINTS)))
    for joint in range(len(JOINTS)):
        products, squares = np.zeros(len(rest.means)), np.zeros(len(rest.means))
        for axis in (0, 1):
            slider = Slider("", (joint,), axis, (), 0.0, 1.0, 1.0)
            moved = source.seen(source.pose([slider], [TRIAL_TURN])).means
            vector = np.zeros((1, 3))
            vector[0, axis] = TRIAL_TURN
            rigid = (rest.means - source.joints[joint]) @ (rotation_of(vector)[0] - np.eye(3)).T
            products += ((moved - rest.means) * rigid).sum(axis=1)
            squares += (rigid**2).sum(axis=1)
        moves[:, joint] = (products / np.maximum(squares, 1e-12)).clip(0.0, 1.0)
    # Weights of the neck alone, which also moves jaw and eyes.
    moves[:, 0] = (moves[:, 0] - moves[:, 1:].sum(axis=1)).clip(0.0, 1.0)
    return np.asarray(moves / np.maximum(moves.sum(axis=1, keepdims=True), 1.0))


def _change(
    source: Source,
    rest: Seen,
    slider: Slider,
    step: float,
    weights: FloatArray,
    few: Sequence[Camera],
    colors: Sequence[FloatArray],
) -> dict[str, FloatArray]:
    """Change before skinning by a slider at a step."""
    pose = source.pose([slider], [step])
    seen = source.seen(pose)
    linear, shift = blended(weights, slider_motions((slider,), np.array([step]), source.joints))
    means = np.linalg.solve(linear, (seen.means - shift)[..., None])[..., 0] - rest.means
    left, _, right = np.linalg.svd(linear)
    relative = (left @ right).transpose(0, 2, 1) @ seen.rotations @ rest.rotations.transpose(0, 2, 1)
    difference = np.mean(
        [colors_from(source, pose, camera) - base for camera, base in zip(few, colors)], axis=0
    )
    return {
        "means": means,
        "turns": Rotation.from_matrix(relative).as_rotvec(),
        "log_scales": seen.log_scales - rest.log_scales,
        "logits": seen.logits - rest.logits,
        "colors": difference,
    }


def _harmonics(source: Source, middle: FloatArray, degree: int, directions: int) -> FloatArray:
    """(N, 3, K): least squares over directions, weighted by the visibility of each splat; see `fit_harmonics`."""

    def radiance(direction: torch.Tensor) -> torch.Tensor:
        far = camera_at(middle + FAR_M * direction.numpy())
        return torch.from_numpy(colors_from(source, source.rest, far)).float()

    along = sphere(directions)
    weights = visibility(source.avatar.splats(source.rest), along.double().numpy() @ source.rotation.T)
    fit = fit_harmonics(radiance, weights, along)
    every = torch.cat([fit.dc[:, :, None], fit.rest], dim=2).double().numpy()
    return np.asarray(every[:, :, : (degree + 1) ** 2])


def _turned(
    source: Source,
    sliders: Sequence[Slider],
    rest: Seen,
    weights: FloatArray,
    harmonics: FloatArray,
    degree: int,
    middle: FloatArray,
) -> bool:
    """Whether colours rotate with the head, which is decided by the fit to a pose with a rotated neck."""
    turn = next((slider for slider in sliders if slider.joints == (0,) and slider.axis == 1), None)
    if turn is None or degree == 0:
        return False
    values = [turn.high if slider == turn else 0.0 for slider in sliders]
    pose = source.pose(sliders, values)
    linear, _ = blended(weights, slider_motions(tuple(sliders), np.array(values), source.joints))
    camera = camera_at(middle + FAR_M * direction_of(0.0, 0.0))
    found = colors_from(source, pose, camera)
    ahead = np.tile([0.0, 0.0, -1.0], (len(found), 1))
    errors = []
    for along in (ahead, np.einsum("nji,nj->ni", linear, ahead)):
        basis = sh_basis(
            torch.from_numpy(along / np.linalg.norm(along, axis=1, keepdims=True)), degree
        ).numpy()
        errors.append(np.square(0.5 + np.einsum("nck,nk->nc", harmonics, basis) - found).mean())
    return bool(errors[1] < errors[0])
