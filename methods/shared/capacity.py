"""Sizes of an avatar that its training data require, each with its evidence.

The configured sizes are upper limits. A method's plan reduces them to what cameras, poses and pictures of the training split
require: no directions of expression that do not move the surface, or whose motion is noise of the tracker (`evidence`), and no
more splats than pixels. docs/explanation/methods/ours.md has measurements.

Coefficients alone do not distinguish motion from the tracker's noise; images do. The mesh is posed with the mean expression and jaw of
the training timesteps and the tracked motion of the head. Where the face deforms, a picture differs there from the mean of the other
timesteps' pictures. One step of photometric alignment (Lucas and Kanade 1981, on the mesh and in all cameras at once) turns this
difference into coefficients, without the tracked ones. If these are motion, they agree with those of the pictures at the same
timesteps; if they are noise, they agree no better than with those of other timesteps. Only frames of the training split are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any, TypeVar

import numpy as np
import torch

from ...bench.contracts import Clip, FloatArray, FrameKey, HeadPose, IntArray
from ...bench.protocol import evenly_with_ends
from ...datasets.head.geometry import rigid_alignment, triangle_areas
from ...datasets.tracking.rig import FrameStack, Occlusion, Views
from .config import Capacity
from .surface_points import SubjectMesh

TIMESTEPS, CAMERAS, POINTS = 64, 8, 1500
"""Maximum number of training timesteps and cameras that are read, and of vertices, each evenly spaced."""
LEAST_TIMESTEPS = 20
"""With fewer there are too few shifts to compare with."""
BLUR = 5e-3
"""Standard deviation of the pictures' blur, metres: alignment by gradients reaches about this far."""
RIDGE = 0.1
"""Weight of the coefficients' squares relative to the mean weight that the pictures give them."""
FLOOR = 0.2
"""Tracked coefficients that move the face by less than this fraction of the largest motion get less weight."""
CONFIRMED = 2.0
"""Standard deviations above chance from which motion is confirmed (docs/explanation/methods/ours.md, "Planned sizes")."""
JAW = slice(-3, None)
"""Columns of the jaw's rotation; those of the expression come before."""
_STEP = 0.02  # radians, of the finite differences by jaw rotation


@dataclass(frozen=True)
class PictureMotion:
    """Deviations of expression and jaw from their means at T training timesteps, from tracking and from images."""

    tracked: FloatArray
    pictured: FloatArray
    """(T, E + 3) root mean square displacement of the face, pixels, by each expression coefficient and each component of the
    jaw's rotation."""

    def agreement(self, columns: slice) -> float:
        """Agreement of tracked and image-based coefficients, in standard deviations above chance.

        Chance is their agreement after a cyclic shift of one of them in time, which preserves temporal correlation. 0 for
        constant coefficients and for images without contrast.
        """
        tracked, pictured = self.tracked[:, columns], self.pictured[:, columns]
        spread, other = tracked.std(axis=0), pictured.std(axis=0)
        if not spread.size or spread.max() < 1e-6:
            return 0.0
        tracked = tracked / np.maximum(spread, FLOOR * spread.max())
        pictured = pictured / np.maximum(other, 1e-12)
        count = len(tracked)
        shifts = np.arange(3, count - 2)
        by_chance = [float((np.roll(pictured, shift, axis=0) * tracked).sum()) for shift in shifts]
        spread_by_chance = float(np.std(by_chance))
        above = float((pictured * tracked).sum() - np.mean(by_chance))
        return above / spread_by_chance if spread_by_chance > 0 else 0.0


def picture_motion(clip: Clip, mesh: SubjectMesh, pixel: float) -> PictureMotion | None:
    """Compare tracking and training pictures; None if there are fewer than `LEAST_TIMESTEPS`.

    ``pixel``: size of a pixel on the head, metres.
    """
    rows: dict[int, list[FrameKey]] = {}
    for key in sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera)):
        rows.setdefault(key.timestep, []).append(key)
    timesteps = evenly_with_ends(sorted(rows), TIMESTEPS)
    used = evenly_with_ends(sorted({key.camera for timestep in timesteps for key in rows[timestep]}), CAMERAS)
    timesteps = [timestep for timestep in timesteps if any(key.camera in used for key in rows[timestep])]
    if len(timesteps) < LEAST_TIMESTEPS:
        return None
    poses = [clip.poses[timestep] for timestep in timesteps]
    expression, jaw = (
        np.mean([getattr(pose, name) for pose in poses], axis=0) for name in ("expression", "jaw")
    )
    means = [replace(pose, expression=expression, jaw=jaw) for pose in poses]
    rest, columns = _flat_columns(mesh, means[0])
    face = _face(clip)
    columns = columns[face] / pixel
    scale = np.sqrt((columns**2).sum(axis=1).mean(axis=0))
    columns = columns / np.maximum(scale, 1e-12)
    samples = _Samples(clip, mesh, used, rest, face, pixel)
    for timestep, pose in zip(timesteps, means):
        samples.add(pose, [key for key in rows[timestep] if key.camera in used])
    tracked = (
        np.array([np.concatenate([pose.expression, pose.jaw]) for pose in poses], dtype=np.float64) * scale
    )
    unknowns = np.concatenate([columns, _rigid(rest[face] / pixel)], axis=2)
    pictured = samples.solve(unknowns)[:, : columns.shape[2]]
    return PictureMotion(tracked - tracked.mean(axis=0), pictured - pictured.mean(axis=0))


class _Samples:
    """Grey values and gradients at points of the face, in every picture."""

    def __init__(
        self,
        clip: Clip,
        mesh: SubjectMesh,
        cameras: Sequence[str],
        rest: FloatArray,
        face: IntArray,
        pixel: float,
    ):
        self._clip, self._mesh, self._rest, self._face, self._pixel = clip, mesh, rest, face, pixel
        self._cameras = list(cameras)
        self._views = Views([clip.cameras[name] for name in self._cameras])
        self._occlusion = Occlusion(clip.head, rest, self._views)
        self._values: list[FloatArray] = []
        self._gradients: list[FloatArray] = []

    def add(self, pose: HeadPose, keys: Sequence[FrameKey]) -> None:
        """Sample the pictures of one timestep; values (C, P) are not a number where a point is not seen."""
        posed = _vertices(self._mesh, pose)
        turn = rigid_alignment(self._rest[self._face], posed[self._face])[:3, :3]
        seen = self._occlusion.visible(posed, self._face) > 0
        places = self._views.project(posed[self._face])
        values = np.full(seen.shape, np.nan, np.float32)
        gradients = np.zeros((*seen.shape, 3), np.float32)
        stack = FrameStack([self._clip.image(key) for key in keys])
        stack.filter(BLUR / self._pixel)
        for number, key in enumerate(keys):
            row = self._cameras.index(key.camera)
            at = np.flatnonzero(seen[row])
            colours, slopes = stack.sample(np.full(len(at), number), places.pixels[row, at])
            values[row, at] = colours.mean(axis=1)
            by_point = slopes.mean(axis=1)[:, None, :] @ places.derivative[row, at]
            gradients[row, at] = self._pixel * (by_point @ turn)[:, 0]
        self._values.append(values)
        self._gradients.append(gradients)

    def solve(self, unknowns: FloatArray) -> FloatArray:
        """(T, n) coefficients of displacements (P, 3, n), in pixels, that align each picture with the mean of the others."""
        values = np.stack(self._values)
        count = np.isfinite(values).sum(axis=0)
        mean = np.nansum(values, axis=0) / np.maximum(count, 1)
        often = 2 * count >= len(values)
        coefficients = []
        for picture, gradient in zip(values, self._gradients):
            used = often & np.isfinite(picture)
            # The mean without this picture.
            residual = ((picture - mean) * count / np.maximum(count - 1, 1))[used]
            rows = np.einsum("sx,sxn->sn", gradient[used], unknowns[np.nonzero(used)[1]])
            normal = rows.T @ rows
            size = len(normal)
            normal += (RIDGE * np.trace(normal) / size + 1e-12) * np.eye(size)
            coefficients.append(np.linalg.solve(normal, -rows.T @ residual))
        return np.array(coefficients)


def _face(clip: Clip) -> IntArray:
    """Vertices of the face without the eyeballs, or of the whole mesh if the head has no such region."""
    regions = clip.head.regions
    face = np.asarray(regions.get("face", np.arange(len(clip.head.template))))
    for name in ("left_eyeball", "right_eyeball"):
        face = np.setdiff1d(face, np.asarray(regions.get(name, ()), dtype=face.dtype))
    return np.array(evenly_with_ends(list(face), POINTS))


def _flat_columns(mesh: SubjectMesh, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
    """(V, 3) mesh of a pose without motion of the head, and (V, 3, E + 3) its derivatives by expression and jaw, metres."""
    still = replace(pose, rotation=np.zeros(3), neck=np.zeros(3), translation=np.zeros(3))
    rest = _vertices(mesh, still)
    moved = [replace(still, expression=still.expression + unit) for unit in np.eye(len(still.expression))]
    turned = [replace(still, jaw=still.jaw + _STEP * axis) for axis in np.eye(3)]
    columns = [_vertices(mesh, each) - rest for each in moved]
    columns += [(_vertices(mesh, each) - rest) / _STEP for each in turned]
    return rest, np.stack(columns, axis=2)


def _rigid(points: FloatArray) -> FloatArray:
    """(P, 3, 6) displacements by rotations and translations, so that errors of the head's motion are not taken for expressions."""
    arms = points - points.mean(axis=0)
    turns = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)
    turns /= np.sqrt((turns**2).sum(axis=1).mean(axis=0))
    return np.concatenate([turns, np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)


@torch.no_grad()
def _vertices(mesh: SubjectMesh, pose: HeadPose) -> FloatArray:
    return mesh.posed(mesh.arguments([pose])).cpu().numpy().astype(np.float64)


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
        self, name: str, configured: int | str | None, chosen: int | str | None, reason: str, **numbers: float
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
