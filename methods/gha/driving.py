"""The driving signal of GHA: an expression code, and the rigid motion of the head with a code.

The published model uses a face model without joints. Here the expression code is expression, jaw and eyes (and
eyelids, if the head model has them), and the rigid motion is that of the head model's root and neck.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Clip, FloatArray, FrameKey, HeadAsset, HeadPose, IntArray
from ...bench.errors import InputError
from ...datasets.head.arrays import check_size
from ...datasets.head.model import HeadModel
from ...datasets.head.rotations import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    matrix_to_quaternion,
    quaternion_to_axis_angle,
)
from ..shared.avatar_files import Subject
from ..shared.rendering import View, scene_center, view_of
from .spec import GHAConfig

POSE_SIZE = 6
"""Axis-angle and translation."""
ANGLES = 9
"""Names of jaw and eyes in the expression code, after the expression."""


class Signal(NamedTuple):
    """One timestep; rotations and translation as tracked."""

    expression: Tensor  # (E,) expression code
    rotation: Tensor  # (3,)
    neck: Tensor  # (3,)
    translation: Tensor  # (3,)
    joints: Tensor  # (2, 3) root and neck of the unposed head, metres


class HeadMotion(NamedTuple):
    """Rigid motion of the head."""

    rotation: Tensor  # (3, 3) canonical frame to world
    translation: Tensor  # (3,) of the canonical frame's origin, metres
    code: Tensor  # (6,) axis-angle and translation from `Driver.center`, the input of the networks
    quaternion: Tensor  # (4,) of the rotation


def head_motion(tracked: Tensor, correction: Tensor) -> tuple[Tensor, ...]:
    """A `HeadMotion` of (6, 3) rotation, neck, translation, root and neck joint, and origin, and a (6,) correction."""
    turn, bend, shift, base, joint, origin = tracked
    root, neck = axis_angle_to_matrix(torch.stack([turn + correction[:3], bend]))
    rotation = root @ neck
    moved = base + shift + correction[3:] + root @ (joint - base)
    translation = moved + rotation @ (origin - joint)
    quaternion = matrix_to_quaternion(rotation)
    code = torch.cat([quaternion_to_axis_angle(quaternion), translation])
    return rotation, translation, code, quaternion


class Driver:
    """Turns poses of one subject into signals and motions.

    The canonical frame has the axes of the unposed head, its origin at the centre of the neutral landmarks, and a
    unit of ``unit`` metres: x_world = R (unit x) + T.

    - ``shape``, ``static_offset``: (S,) identity and (V, 3) metres.
    - ``expression_scale``: (E,) divisor of the expression code; None for ones.
    - ``origin``: (3,) origin of the canonical frame in the unposed head, metres.
    - ``center``: (3,) metres, the origin of translations in `HeadMotion.code`, see `scene_center`; None for the world's origin.
    """

    def __init__(
        self,
        head: HeadAsset,
        shape: FloatArray,
        static_offset: FloatArray,
        origin: FloatArray,
        unit: float,
        expression_scale: Tensor | None,
        device: str,
        center: FloatArray | None = None,
    ):
        self.model = HeadModel(head, device=device)
        self._identity = {
            "shape": torch.tensor(np.asarray(shape)).to(self.model.template),
            "static_offset": torch.tensor(np.asarray(static_offset)).to(self.model.template),
        }
        self.neutral = self.model.canonical(**self._identity)[0]
        check_size("subject", "shape, static_offset", self.neutral.cpu().numpy(), np.asarray(head.faces))
        self.origin = torch.tensor(np.asarray(origin)).to(self.neutral)
        self.center = torch.as_tensor(np.zeros(3) if center is None else np.asarray(center)).to(self.neutral)
        self._code_shift = torch.cat([torch.zeros_like(self.center), self.center])
        self.unit = unit
        self.expression_scale = expression_scale

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors with a batch axis."""
        return self.model.pose_arguments(poses)

    @torch.no_grad()
    def signals(self, arguments: Mapping[str, Tensor]) -> list[Signal]:
        """One signal for each timestep of the arguments."""
        codes = expression_codes(arguments)
        if self.expression_scale is not None:
            codes = codes / self.expression_scale
        signals = []
        for t in range(len(codes)):
            # One at a time, so that the result of a pose does not depend on the batch.
            joints = self.model.joints(expression=arguments["expression"][t : t + 1], **self._identity)
            rigid = {name: arguments[name][t] for name in ("rotation", "neck", "translation")}
            signals.append(Signal(codes[t], **rigid, joints=joints[0, :2]))
        return signals

    def motion(self, signal: Signal, correction: Tensor | None = None) -> HeadMotion:
        """Rigid motion of the head; differentiable in the (6,) correction of rotation and translation."""
        if correction is None:
            correction = signal.rotation.new_zeros(POSE_SIZE)
        parts = signal.rotation, signal.neck, signal.translation, *signal.joints, self.origin
        motion = HeadMotion(*head_motion(torch.stack(parts), correction))
        return motion._replace(code=motion.code - self._code_shift)

    def rest_arguments(self, codes: Tensor) -> dict[str, Tensor]:
        """Arguments of (B, E) expression codes with the head at rest: the inverse of `signals`."""
        if self.expression_scale is not None:
            codes = codes * self.expression_scale
        expressions = self.model.expression_size
        parts = codes.split([expressions, 3, 6, codes.shape[1] - expressions - ANGLES], dim=1)
        named = {
            n: values for n, values in zip(("expression", "jaw", "eyes", "eyelids"), parts) if values.shape[1]
        }
        return {**dict.fromkeys(("rotation", "neck", "translation"), codes.new_zeros(len(codes), 3)), **named}

    def canonical(self, vertices: Tensor) -> Tensor:
        """Canonical coordinates of (..., 3) points of the unposed head, metres."""
        return (vertices - self.origin) / self.unit

    def unposed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(T, V, 3) vertices with expression, jaw, eyes and eyelids alone, canonical coordinates."""
        still = {name: torch.zeros_like(arguments[name]) for name in ("rotation", "neck", "translation")}
        return self.canonical(self.model(canonical=self.neutral[None], **{**arguments, **still}))


def expression_codes(arguments: Mapping[str, Tensor]) -> Tensor:
    """(T, E) expression, jaw, eyes and, if present, eyelids; angles within half a turn."""
    angles = torch.cat([arguments["jaw"], arguments["eyes"]], dim=1).unflatten(1, (ANGLES // 3, 3))
    parts = [arguments["expression"], _principal(angles).flatten(1)]
    if "eyelids" in arguments:
        parts.append(arguments["eyelids"])
    return torch.cat(parts, dim=1)


def code_size(head: HeadAsset) -> int:
    """E of `expression_codes` for a head model."""
    return head.expression_basis.shape[2] + ANGLES + (0 if head.eyelid_basis is None else 2)


def _principal(axis_angle: Tensor) -> Tensor:
    """The same rotations with angles of at most pi, so that equal rotations are equal inputs of a network."""
    return quaternion_to_axis_angle(axis_angle_to_quaternion(axis_angle))


FACIAL = ("face", "lips", "eye_region", "nose", "forehead", "left_ear", "right_ear")
"""Regions covered by the published landmarks and mesh points."""


def landmark_vertices(head: HeadAsset, neutral: FloatArray, count: int) -> IntArray:
    """Vertices of the face of the (V, 3) neutral head by farthest-point sampling; all, if they are fewer.

    The published points are 66 detected landmarks and each hundredth vertex of the tracked face; farthest points cover
    the same surface evenly on any head model.
    """
    if "face" not in head.regions:
        known = ", ".join(sorted(head.regions)) or "no regions"
        raise InputError(f"head model {head.version!r}", "regions", "a region 'face'", known)
    facial = np.unique(np.concatenate([head.regions[name] for name in FACIAL if name in head.regions]))
    points = np.asarray(neutral, np.float64)[facial]
    # The first point is the farthest from the middle, which needs no random start.
    chosen = [int(np.argmax(np.square(points - points.mean(0)).sum(1)))]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        nearest = np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(1))
        chosen.append(int(np.argmax(nearest)))
    return facial[chosen]


def mouth_box(lips: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre and half sides, (3,) each, of the box for points inside the mouth.

    Its centre is the mean of the (L, 3) lip points in x and y, and the hindmost of them in depth; its half sides are
    0.8 of their largest distance from that centre along each axis, as published.
    """
    center = lips.mean(0)
    center[2] = lips[:, 2].min()
    return center, 0.8 * np.abs(lips - center).max(0)


class Influence(NamedTuple):
    """Points that a controller acts on, (n,) int64, and their (n,) weights in (0, 1]."""

    rows: Tensor
    weights: Tensor


ROUNDING = 1e-5
"""Canonical units, above the rounding errors of distances."""


class NearestLandmarks:
    """The landmarks of `influences` for points that move little from one call to the next, which are searched again only after
    they have moved so far that the influences may be those of another landmark.

    Another can be nearer after half the difference of the distances from the two nearest ones. Which one is nearest has no effect
    while all are farther than ``far_squared``, or one is within ``near_squared``.
    """

    def __init__(self, landmarks: Tensor, near_squared: float, far_squared: float):
        self._landmarks = landmarks
        self._near, self._far = near_squared**0.5, far_squared**0.5
        self._places = landmarks[:0]
        self._room = landmarks.new_zeros(0)
        self._nearest = torch.zeros_like(self._room, dtype=torch.int64)

    @torch.no_grad()
    def __call__(self, points: Tensor) -> Tensor:
        """(N,) indices for (N, 3) points, the same ones in all calls."""
        if not len(self._places):
            self._places, self._room = points.clone(), points.new_zeros(len(points))
            self._nearest = torch.zeros_like(self._room, dtype=torch.int64)
        moved = torch.linalg.vector_norm(points - self._places, dim=1)
        rows = (moved >= self._room).nonzero().squeeze(1)
        places = points.index_select(0, rows)
        # Differences, since the squares of the faster mode are inexact at small distances.
        distances = torch.cdist(places, self._landmarks, compute_mode="donot_use_mm_for_euclid_dist")
        found = distances.topk(min(2, len(self._landmarks)), dim=1, largest=False)
        first, second = found.values[:, 0], found.values[:, -1]
        room = torch.maximum(0.5 * (second - first), torch.maximum(first - self._far, self._near - first))
        self._places.index_copy_(0, rows, places)
        self._room.index_copy_(0, rows, room - ROUNDING)
        self._nearest.index_copy_(0, rows, found.indices[:, 0])
        return self._nearest


def influences(
    points: Tensor, landmarks: Tensor, near_squared: float, far_squared: float, nearest: Tensor | None = None
) -> tuple[Influence, Influence]:
    """Influence of expression and of head pose on (N, 3) points; their weights add up to 1.

    Only expression has an effect up to ``near_squared`` from the nearest of the (L, 3) landmarks, only pose from
    ``far_squared`` on; in between the weights are linear in the squared distance. ``nearest`` (N,) are the indices of
    the nearest landmarks, if they are known.
    """
    if nearest is None:
        with torch.no_grad():
            # |a - b|^2 without |a|^2, which is the same for all landmarks of a point. `min` is three times as fast as
            # `argmin` on the CPU.
            nearest = torch.addmm(landmarks.square().sum(1), points, landmarks.t(), alpha=-2).min(1).indices
    squared = (points - landmarks.index_select(0, nearest)).square().sum(1)
    weight = ((far_squared - squared) / (far_squared - near_squared)).clamp(0, 1)
    near, far = (weight.detach() > 0).nonzero().squeeze(1), (weight.detach() < 1).nonzero().squeeze(1)
    return (Influence(near, weight.index_select(0, near)), Influence(far, 1 - weight.index_select(0, far)))


class TrainingScene(NamedTuple):
    """A clip prepared for training.

    ``rest`` is the subject's neutral head with the jaw open by the configured angle, the target of the neutral
    surface. Colour and attributes follow the expression code within its bounds.
    """

    clip: Clip
    driver: Driver
    keys: tuple[FrameKey, ...]  # training frames
    timesteps: list[int]  # of the training frames, ascending
    row: Mapping[int, int]  # index of each timestep
    signals: list[Signal]  # by row
    tracked: Mapping[str, Tensor]  # driving arguments by name, (T, n) each
    views: Mapping[str, View]  # training cameras
    background: Tensor  # (3,)
    rest: Tensor  # (V, 3) canonical units
    landmark_rows: IntArray  # (L,) vertices of the head model
    expression_scale: Tensor  # (E,) divisors of expression codes
    code_low: Tensor  # (E,)
    code_high: Tensor  # (E,)
    device: str
    seed: int

    def frame(self) -> dict[str, Tensor]:
        """Tensors stored in an avatar: origin of the canonical frame, centre of the head's motion, background, scale
        and bounds of the expression code."""
        return {
            "origin": self.driver.origin,
            "center": self.driver.center,
            "background": self.background,
            "expression_scale": self.expression_scale,
            "code_low": self.code_low,
            "code_high": self.code_high,
        }


def training_scene(clip: Clip, config: GHAConfig, device: str, seed: int) -> TrainingScene:
    """Prepare a clip."""
    subject = Subject.of(clip)
    identity = (clip.head, subject.shape, subject.static_offset)
    plain = Driver(*identity, np.zeros(3), 1.0, None, device)
    neutral = plain.neutral.cpu().numpy()
    rows = landmark_vertices(clip.head, neutral, config.landmarks)
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    tracked = plain.arguments([clip.poses[timestep] for timestep in timesteps])
    scale = torch.ones(code_size(clip.head), device=device)
    expressions = clip.head.expression_basis.shape[2]
    scale[expressions : expressions + ANGLES] = config.angle_unit
    center = scene_center(clip.poses[timestep] for timestep in timesteps)
    driver = Driver(*identity, neutral[rows].mean(0), config.unit, scale, device, center)
    opened = torch.zeros(1, len(scale), device=device)
    opened[0, expressions] = config.neutral_jaw / config.angle_unit
    signals = driver.signals(tracked)
    low, high = bounds(torch.stack([signal.expression for signal in signals]), config.appearance_margin)
    return TrainingScene(
        clip=clip,
        driver=driver,
        keys=tuple(clip.splits["train"]),
        timesteps=timesteps,
        row={timestep: row for row, timestep in enumerate(timesteps)},
        signals=signals,
        tracked=tracked,
        views={
            name: view_of(clip.cameras[name], device) for name in {k.camera for k in clip.splits["train"]}
        },
        background=torch.tensor(np.asarray(clip.background), dtype=torch.float32, device=device),
        rest=driver.unposed(driver.rest_arguments(opened))[0],
        landmark_rows=rows,
        expression_scale=scale,
        code_low=low,
        code_high=high,
        device=device,
        seed=seed,
    )


def bounds(codes: Tensor, margin: float | None) -> tuple[Tensor, Tensor]:
    """(E,) lowest and highest values of (T, E) codes, extended by ``margin`` times their range; without a margin, the
    largest float32 numbers."""
    if margin is None:
        largest = torch.full_like(codes[0], torch.finfo(codes.dtype).max)
        return -largest, largest
    low, high = codes.amin(0), codes.amax(0)
    return low - margin * (high - low), high + margin * (high - low)
