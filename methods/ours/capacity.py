"""A plan of the sizes of an avatar of "ours", each with its evidence.

The configured sizes are upper limits; the plan reduces them to what the training data require: no lines without
changes of expression, no jaw bases without jaw motion, no planes finer than the images. docs/explanation/methods/ours.md has measurements.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import Any

import numpy as np
import torch

from ...bench.contracts import Clip, FloatArray, HeadPose
from ...datasets.head.arrays import JOINT_NAMES, faces_in_region
from ...datasets.head.geometry import triangle_areas
from ...datasets.steps.jaw_bases import IDENTITY, farthest_quaternions, jaw_quaternions
from ..avatars.compact.simplify import training_poses
from ..ops.planes import Bounds
from ..shared.subject_mesh import SubjectMesh, centroid_displacements
from .config import OursConfig, Planned
from .field import PLANE_MARGIN, line_box, plane_box

LINE_SAMPLES_PER_PIXEL = 0.5
SPLATS_PER_PIXEL = 1.0
"""Splats per pixel of the unrolled surface at the median pixel size; half as many lose 0.2 to 0.5 dB (docs/explanation/methods/ours.md)."""
MINIMUM_PLANE, MINIMUM_LINE = 8, 4
"""Minimum number of samples."""


@dataclass(frozen=True)
class Decision:
    """One size: configured and chosen value, reason, and supporting numbers (SI units and pixels)."""

    name: Planned
    configured: int | str | None
    chosen: int | str | None
    reason: str
    numbers: Mapping[str, float]


@dataclass(frozen=True)
class CapacityPlan:
    """Every size of an avatar, decided from its training data.

    Attributes
    ----------
    tolerance : float
        Tolerance in pixels.
    pixel : float
        Size of a pixel on the head, metres, median over training frames.
    decisions : tuple[Decision, ...]
        One for each size that was changed.
    lines_within : tuple[tuple[float, ...], tuple[float, ...]] | None
        Corners of the lines' box, metres, if it differs from that of ``lines.bounds``.
    """

    tolerance: float
    pixel: float
    decisions: tuple[Decision, ...]
    lines: bool
    lines_within: tuple[tuple[float, ...], tuple[float, ...]] | None

    def apply(self, config: OursConfig) -> OursConfig:
        """The configuration with the planned sizes in it."""
        sizes: dict[str, dict[str, Any]] = {"lines": {"enabled": self.lines}, "capacity": {"mode": "fixed"}}
        for each in self.decisions:
            group, _, size = each.name.partition(".")
            if each.name != "lines.bounds":
                sizes.setdefault(group, {})[size] = each.chosen
        groups = {name: replace(getattr(config, name), **chosen) for name, chosen in sizes.items()}
        return replace(config, **groups)

    def box(self, device: str) -> Bounds | None:
        """Bounds of the lines as tensors, or None for the configured ones."""
        if self.lines_within is None:
            return None
        low, high = (torch.tensor(corner, device=device) for corner in self.lines_within)
        return Bounds(low, high)

    def record(self) -> dict[str, Any]:
        """The plan as plain values, for JSON."""
        return asdict(self)

    def summary(self) -> str:
        """One line with every size, and the configured value if it was changed; the reasons are in `record`."""
        sizes = (
            f"{d.name} {d.chosen}" + f" of {d.configured}" * (d.chosen != d.configured)
            for d in self.decisions
        )
        nothing = "" if self.lines else "nothing is dynamic, no lines; "
        return f"capacity for motion above {self.tolerance:g} pixels: {nothing}{', '.join(sizes)}"


def plan_capacity(clip: Clip, mesh: SubjectMesh, config: OursConfig) -> CapacityPlan:
    """Decide the sizes from cameras and poses of the training frames.

    Parameters
    ----------
    config : OursConfig
        Its sizes are upper limits; those in ``capacity.keep`` are not changed.
    """
    planner = _Planner(clip, mesh, config)
    planner.lines()
    planner.planes()
    planner.splats()
    return CapacityPlan(
        *(config.capacity.tolerance, planner.pixel, tuple(planner.decisions), planner.dynamic, planner.within)
    )


class _Planner:
    """Data shared by the decisions, and each decision."""

    def __init__(self, clip: Clip, mesh: SubjectMesh, config: OursConfig):
        self._clip, self._mesh, self._config = clip, mesh, config
        self._canonical = mesh.canonical.cpu().numpy().astype(np.float64)
        self._faces = np.asarray(clip.head.faces)
        self._poses: list[HeadPose] = training_poses(clip)
        self.pixel = pixel_footprint(clip, 0.5 * (self._canonical.min(0) + self._canonical.max(0)))
        self._metres = config.capacity.tolerance * self.pixel
        self.dynamic = config.lines.enabled
        self.within: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self.decisions: list[Decision] = []

    def _kept(self, name: Planned) -> bool:
        return name in self._config.capacity.keep

    def _decide(
        self,
        name: Planned,
        configured: int | str | None,
        chosen: int | str | None,
        reason: str,
        **numbers: float,
    ) -> None:
        self.decisions.append(Decision(name, configured, chosen, reason, numbers))

    def lines(self) -> None:
        """Directions, jaw bases, box and samples of the lines; empty without lines."""
        if not self._config.lines.enabled:
            return
        self.dynamic = self._expressions() + self._jaw_bases() > 0
        if self.dynamic:
            self._bounds()
        if self.dynamic:
            self._line_resolution()

    def _expressions(self) -> int:
        """Number of directions with lines."""
        configured = self._config.lines.expressions
        if self._kept("lines.expressions"):
            return configured
        basis = np.asarray(self._clip.head.expression_basis)
        coefficients = np.array([pose.expression for pose in self._poses], dtype=np.float64)
        chosen = min(leading_directions(coefficients, basis, self._metres), configured, basis.shape[2])
        rest = displacement_without(coefficients, basis, chosen) / self.pixel
        total = displacement_without(coefficients, basis, 0) / self.pixel
        reason = f"expressions move the surface by up to {total:.2f} px, {rest:.2f} px without these"
        self._decide("lines.expressions", configured, chosen, reason, moved_px=total, left_out_px=rest)
        return chosen

    def _jaw_bases(self) -> int:
        """Number of jaw bases with lines."""
        configured = self._config.lines.jaw_bases
        # The official choice uses held-out poses; it is reproduced without changes.
        official = self._config.lines.jaw_bases_variant == "official"
        if self._kept("lines.jaw_bases") or official or not configured:
            return configured
        lever = jaw_lever(self._mesh)
        chosen, metres = spanning_jaw_bases(self._poses, configured, lever, self._metres)
        rest = metres / self.pixel
        reason = f"without further bases the jaw moves the surface by {rest:.2f} px at most"
        self._decide("lines.jaw_bases", configured, chosen, reason, lever_m=lever, left_out_px=rest)
        return chosen

    def _bounds(self) -> None:
        if self._kept("lines.bounds"):
            return
        configured, moves = self._config.lines.bounds, self._moving()
        if not moves.any():
            self.dynamic = False
            reason = "no triangle moves enough in training for the penalty to allow changes"
            self._decide("lines.bounds", configured, None, reason, triangles=0)
            return
        corners = self._canonical[self._faces[moves].ravel()]
        whole = self._configured_line_box()
        low = np.maximum(corners.min(0) - PLANE_MARGIN, whole.low.numpy())
        high = np.minimum(corners.max(0) + PLANE_MARGIN, whole.high.numpy())
        share = float(np.prod((high - low) / (whole.high - whole.low).numpy()))
        self.within = tuple(map(float, low)), tuple(map(float, high))
        reason = f"{moves.mean():.0%} of the triangles move, {share:.0%} of the volume contains them"
        count = float(moves.sum())
        self._decide("lines.bounds", configured, "moving", reason, triangles=count, volume_share=share)

    def _moving(self) -> np.ndarray:
        """(F,) whether the penalty allows visible changes of a triangle's splats in some training timestep."""
        penalty = self._config.penalty
        least = np.full(len(self._faces), self._metres)
        if penalty.weight:
            least = np.maximum(least, 1e-3 * np.where(self._is_face(), penalty.face_mm, penalty.other_mm))
        displaced = largest_displacements(self._mesh, self._poses) >= least
        return displaced & self._is_face() if self._config.lines.bounds == "face" else displaced

    def _is_face(self) -> np.ndarray:
        return np.isin(np.arange(len(self._faces)), faces_in_region(self._clip.head, "face"))

    def _configured_line_box(self) -> Bounds:
        vertices: FloatArray = self._canonical
        if self._config.lines.bounds == "face":
            vertices = vertices[self._faces[self._is_face()].ravel()]
        return line_box(torch.from_numpy(vertices))

    def _line_resolution(self) -> None:
        if self._kept("lines.resolution"):
            return
        whole = self._configured_line_box()
        size = (whole.high - whole.low).numpy()
        inside = size if self.within is None else np.subtract(self.within[1], self.within[0])
        configured, longest = self._config.lines.resolution, float(inside.max())
        # Not finer than configured on any axis, and not finer than the images.
        spacing = np.maximum(size / (configured - 1), self.pixel / LINE_SAMPLES_PER_PIXEL)
        needed = 1 + ceil(float((inside / spacing).max()) - 1e-6)
        chosen = min(configured, max(needed, MINIMUM_LINE))
        reason = f"a sample every {1000 * longest / (chosen - 1):.1f} mm of {1000 * longest:.0f} mm"
        self._decide("lines.resolution", configured, chosen, reason, longest_m=longest)

    def planes(self) -> None:
        """Samples per side of the planes."""
        if self._kept("planes.resolution") or self._config.color != "planes":
            return
        configured = self._config.planes.resolution
        box = plane_box(self._mesh.canonical.cpu(), self._config.planes.bounds_variant)
        side = float((box.high - box.low).max())
        pixels = side / self.pixel
        chosen = min(configured, max(1 + ceil(self._config.capacity.detail * pixels), MINIMUM_PLANE))
        reason = f"the planes' longest side covers {pixels:.0f} px"
        self._decide("planes.resolution", configured, chosen, reason, longest_m=side, longest_px=pixels)

    def splats(self) -> None:
        """Bound on the number of splats; training starts with one on each triangle, so never fewer."""
        if self._kept("splats.max_splats"):
            return
        configured, count = self._config.splats.max_splats, len(self._faces)
        area = float(triangle_areas(self._canonical, self._faces).sum()) / self.pixel**2
        needed = max(ceil(SPLATS_PER_PIXEL * area), count)
        chosen = needed if configured is None else min(needed, configured)
        reason = f"the surface covers {area:.0f} px, unrolled, in {count} triangles"
        numbers = {"surface_px": area, "triangles": float(count)}
        self._decide("splats.max_splats", configured, chosen, reason, **numbers)


_BLOCK = 64  # timesteps whose displacement fields are in memory at once


def pixel_footprint(clip: Clip, center: FloatArray) -> float:
    """Size of a pixel on the head, metres: median over training frames of depth divided by focal length.

    Parameters
    ----------
    center : FloatArray
        (3,) centre of the canonical head, metres; each pose's translation is added.
    """
    sizes = []
    for key in clip.splits["train"]:
        camera = clip.cameras[key.camera]
        point = center + np.asarray(clip.poses[key.timestep].translation, dtype=np.float64)
        depth = camera.world_to_camera[2, :3] @ point + camera.world_to_camera[2, 3]
        sizes.append(abs(depth) / np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return float(np.median(sizes))


def largest_displacements(mesh: SubjectMesh, poses: list[HeadPose]) -> FloatArray:
    """(F,) maximum displacement of a triangle's centroid from the canonical mesh by expression, jaw and eyes, metres."""
    largest = torch.zeros(len(mesh.faces), device=mesh.faces.device)
    with torch.no_grad():
        for pose in poses:
            unposed = mesh.unposed(mesh.arguments([pose]))
            moved = centroid_displacements(unposed, mesh.canonical, mesh.faces)
            largest = torch.maximum(largest, moved.to(largest))
    return largest.cpu().numpy()


def leading_directions(coefficients: FloatArray, basis: FloatArray, tolerance: float) -> int:
    """Sufficient number of leading expression directions.

    Deviations from the mean over the timesteps count, since a constant expression needs no direction.

    Parameters
    ----------
    coefficients : FloatArray
        (T, E) coefficients of the training timesteps.
    basis : FloatArray
        (V, 3, E) metres per unit.
    tolerance : float
        Metres.

    Returns
    -------
    int
        The smallest K such that leaving out the directions from K on, or from any later one on,
        displaces no vertex by more than the tolerance in any timestep.
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


def jaw_lever(mesh: SubjectMesh) -> float:
    """Lever of the jaw joint, metres: maximum of skinning weight times distance over vertices."""
    joint = JOINT_NAMES.index("jaw")
    center = mesh.model.joint_regressor[joint] @ mesh.canonical
    distance = torch.linalg.vector_norm(mesh.canonical - center, dim=1)
    return float((mesh.model.skinning_weights[:, joint] * distance).max())


def spanning_jaw_bases(
    poses: list[HeadPose], limit: int, lever: float, tolerance: float
) -> tuple[int, float]:
    """Sufficient number of jaw bases, and the motion by rotations outside their span.

    The weights |<q, q_i>| on the bases are linear in the quaternion q up to a common scale, so lines for bases with
    the same span are equivalent: at most four are needed, and two for a jaw that only opens. A residual r of a unit
    quaternion is a rotation by 2 asin(r), which moves a vertex by 2 r times its lever.

    Returns
    -------
    tuple[int, float]
        Number of bases, at most ``limit``, in the farthest-point order of `jaw_bases`, and metres.
        None are needed if no training pose moves a vertex by more than the tolerance from the mean
        jaw rotation.
    """
    candidates = jaw_quaternions(poses)
    mean = candidates.mean(0)
    rest = 2 * lever * _residual(candidates, (mean / np.linalg.norm(mean))[None])
    if rest <= tolerance:
        return 0, rest
    bases = farthest_quaternions(candidates, IDENTITY, limit)
    for count in range(1, len(bases) + 1):
        rest = 2 * lever * _residual(candidates, bases[:count])
        if rest <= tolerance:
            return count, rest
    return len(bases), rest


def _residual(quaternions: FloatArray, bases: FloatArray) -> float:
    """Largest distance of (N, 4) unit quaternions from the span of (n, 4) bases."""
    _, sizes, rows = np.linalg.svd(bases, full_matrices=False)
    rows = rows[sizes > 1e-9 * sizes[0]]
    return float(np.linalg.norm(quaternions - quaternions @ rows.T @ rows, axis=1).max())
