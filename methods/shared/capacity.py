"""Sizes of an avatar that its training data require, each with its evidence.

The configured sizes are upper limits. A method's plan reduces them to what cameras, poses and pictures of the training split
require: no directions of expression that do not move the surface, or whose motion is noise of the tracker (`evidence`), and no
more splats than pixels. docs/explanation/methods/ours.md has measurements.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any, TypeVar

import numpy as np

from ...bench.contracts import Clip, FloatArray, HeadPose
from ...datasets.head.geometry import triangle_areas
from .config import Capacity
from .evidence import CONFIRMED, PictureMotion, picture_motion
from .subject_mesh import SubjectMesh

Config = TypeVar("Config")
SPLATS_PER_PIXEL = 1.0
"""Splats per pixel of the unrolled surface at the median pixel size; half as many lose 0.2 to 0.5 dB."""


@dataclass(frozen=True)
class Decision:
    """One size: dotted name of the setting, configured and chosen value, reason, and supporting numbers (SI units and pixels)."""

    name: str
    configured: int | str | None
    chosen: int | str | None
    reason: str
    numbers: Mapping[str, float]


@dataclass(frozen=True)
class CapacityPlan:
    """The sizes of an avatar, decided from its training data."""

    tolerance: float
    """Tolerance in pixels."""
    pixel: float
    """Size of a pixel on the head, metres, median over training frames."""
    decisions: tuple[Decision, ...]
    """One for each size that "auto" decides."""

    def apply(self, config: Config) -> Config:
        """The configuration with the planned sizes."""
        return with_sizes(
            config, {"capacity.mode": "fixed"} | {each.name: each.chosen for each in self.decisions}
        )

    def record(self) -> dict[str, Any]:
        """The plan as plain values, for JSON."""
        return asdict(self)

    def summary(self) -> str:
        """One line with every size, and the configured value if it was changed; the reasons are in `record`."""
        sizes = (
            f"{d.name} {d.chosen}" + f" of {d.configured}" * (d.chosen != d.configured)
            for d in self.decisions
        )
        return f"capacity for motion above {self.tolerance:g} pixels: {', '.join(sizes)}"


def with_sizes(config: Config, sizes: Mapping[str, Any]) -> Config:
    """A configuration with other values of settings by dotted name, which may be in groups."""
    for name, value in sizes.items():
        group, _, last = name.rpartition(".")
        changed = {group: replace(getattr(config, group), **{last: value})} if group else {last: value}
        config = replace(config, **changed)  # type: ignore[type-var]
    return config


class CapacityPlanner:
    """Data shared by the decisions, and those that methods have in common; each is added to ``decisions``.

    ``mesh``: mesh of the clip's subject, with the clip's head model.
    """

    def __init__(self, clip: Clip, mesh: SubjectMesh, capacity: Capacity):
        self._clip, self._mesh, self._capacity = clip, mesh, capacity
        self._canonical = mesh.canonical.cpu().numpy().astype(np.float64)
        self._faces = np.asarray(clip.head.faces)
        self._poses: list[HeadPose] = training_poses(clip)
        self.pixel = pixel_footprint(clip, 0.5 * (self._canonical.min(0) + self._canonical.max(0)))
        self.decisions: list[Decision] = []

    def plan(self) -> CapacityPlan:
        """The decisions so far."""
        return CapacityPlan(self._capacity.tolerance, self.pixel, tuple(self.decisions))

    def expressions(self, name: str, configured: int) -> int:
        """Decide the number of leading expression directions: those that move the surface visibly, none if this is noise."""
        basis = np.asarray(self._clip.head.expression_basis)
        coefficients = np.array([pose.expression for pose in self._poses], dtype=np.float64)
        needed = leading_directions(coefficients, basis, self._capacity.tolerance * self.pixel)
        needed = min(needed, configured, basis.shape[2])
        total, rest = (displacement_without(coefficients, basis, kept) / self.pixel for kept in (0, needed))
        reason = f"tracked expressions move the surface by up to {total:.2f} px, {rest:.2f} px without these"
        numbers = {"moved_px": total, "left_out_px": rest, "needed": float(needed)}
        confirmed, evidence = self.confirmed(slice(0, needed), numbers) if needed else (True, "")
        chosen = needed if confirmed else 0
        self._decide(name, configured, chosen, reason + evidence, **numbers)
        return chosen

    def confirmed(self, columns: slice, numbers: dict[str, float]) -> tuple[bool, str]:
        """Whether images confirm tracked motion, and a sentence that says so; the agreement is added to ``numbers``.

        With too few timesteps all motion counts as confirmed. Directions of expression are confirmed together: single
        trailing ones are too weak in images, and leaving out unconfirmed ones loses quality.
        """
        if self.motion is None:
            return True, ""
        agreement = numbers["agreement"] = self.motion.agreement(columns)
        if agreement >= CONFIRMED:
            return True, f"; pictures confirm this motion (agreement {agreement:.1f})"
        return False, f"; in pictures this is noise of the tracker (agreement {agreement:.1f})"

    @cached_property
    def motion(self) -> PictureMotion | None:
        """Motion of the face in training images, computed on first access; None for too few timesteps."""
        return picture_motion(self._clip, self._mesh, self.pixel)

    def splats(self, name: str, configured: int | None, least: int) -> None:
        """Decide the bound on the number of splats, which is at least ``least``, the number that training starts with."""
        area = float(triangle_areas(self._canonical, self._faces).sum()) / self.pixel**2
        needed = max(ceil(SPLATS_PER_PIXEL * area), least)
        chosen = needed if configured is None else min(needed, configured)
        reason = f"the surface covers {area:.0f} px, unrolled; training starts with {least} splats"
        self._decide(name, configured, chosen, reason, surface_px=area, least=float(least))

    def _decide(
        self,
        name: str,
        configured: int | str | None,
        chosen: int | str | None,
        reason: str,
        **numbers: float,
    ) -> None:
        self.decisions.append(Decision(name, configured, chosen, reason, numbers))


def training_poses(clip: Clip) -> list[HeadPose]:
    """The poses of a clip's training frames, in order of time."""
    return [clip.poses[timestep] for timestep in sorted({key.timestep for key in clip.splits["train"]})]


_BLOCK = 64  # timesteps whose displacement fields are in memory at once


def pixel_footprint(clip: Clip, center: FloatArray) -> float:
    """Size of a pixel on the head, metres: median over training frames of depth divided by focal length.

    ``center``: (3,) centre of the canonical head, metres; each pose's translation is added.
    """
    sizes = []
    for key in clip.splits["train"]:
        camera = clip.cameras[key.camera]
        point = center + np.asarray(clip.poses[key.timestep].translation, dtype=np.float64)
        depth = camera.world_to_camera[2, :3] @ point + camera.world_to_camera[2, 3]
        sizes.append(abs(depth) / np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return float(np.median(sizes))


def leading_directions(coefficients: FloatArray, basis: FloatArray, tolerance: float) -> int:
    """Sufficient number of leading expression directions.

    Deviations from the mean over the timesteps count, since a constant expression needs no direction.

    - ``coefficients``: (T, E) coefficients of the training timesteps.
    - ``basis``: (V, 3, E) metres per unit.
    - ``tolerance``: Metres.
    - Returns the smallest K such that leaving out the directions from K on, or from any later one on, displaces no vertex by
      more than the tolerance in any timestep.
    """
    deviation, columns = _deviation(coefficients), _columns(basis)
    needed = 0
    for start in range(0, len(deviation), _BLOCK):
        block = deviation[start : start + _BLOCK]
        field = np.zeros((len(block), len(columns)), np.float32)
        for last in range(basis.shape[2] - 1, needed - 1, -1):
            field += block[:, last, None] * columns[None, :, last]
            if _longest(field) > tolerance:
                needed = last + 1
                break
    return needed


def displacement_without(coefficients: FloatArray, basis: FloatArray, kept: int) -> float:
    """Maximum displacement of a vertex by omitting the directions from ``kept`` on, metres; as above."""
    deviation, columns = _deviation(coefficients)[:, kept:], _columns(basis)[:, kept:]
    blocks = range(0, len(deviation), _BLOCK)
    return max(_longest(deviation[start : start + _BLOCK] @ columns.T) for start in blocks)


def _deviation(coefficients: FloatArray) -> FloatArray:
    exact = np.asarray(coefficients, np.float64)
    return (exact - exact.mean(0)).astype(np.float32)


def _columns(basis: FloatArray) -> FloatArray:
    return np.asarray(basis, np.float32).reshape(-1, basis.shape[2])


def _longest(field: FloatArray) -> float:
    """Largest length among the vectors of (T, 3 V) fields."""
    return float(np.sqrt((field.reshape(len(field), -1, 3) ** 2).sum(2).max()))
