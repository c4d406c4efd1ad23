"""A plan of the sizes of an avatar of "ours", each with its evidence.

In addition to the sizes common to all methods (`shared.capacity`): no jaw bases without jaw motion, no lines without motion,
and no planes finer than the images. docs/explanation/methods/ours.md has measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np
import torch

from ...bench.contracts import Clip, FloatArray, HeadPose
from ...datasets.head.arrays import JOINT_NAMES, faces_in_region
from ...datasets.steps.clusters import IDENTITY, farthest_quaternions, jaw_quaternions
from ..ops.planes import Bounds
from ..shared.capacity import CapacityPlan, CapacityPlanner
from ..shared.evidence import JAW
from ..shared.subject_mesh import SubjectMesh, centroid_displacements
from .config import OursConfig, Planned
from .field import PLANE_MARGIN, line_box, plane_box

LINE_SAMPLES_PER_PIXEL = 0.5
MINIMUM_PLANE, MINIMUM_LINE = 8, 4
"""Minimum number of samples."""


@dataclass(frozen=True)
class OursPlan(CapacityPlan):
    """The sizes of an avatar of "ours".

    Attributes
    ----------
    lines : bool
        Whether anything is dynamic.
    lines_within : tuple[tuple[float, ...], tuple[float, ...]] | None
        Corners of the lines' box, metres, if it differs from that of ``lines.bounds``.
    """

    lines: bool
    lines_within: tuple[tuple[float, ...], tuple[float, ...]] | None

    def apply(self, config: OursConfig) -> OursConfig:  # type: ignore[override]
        """The configuration with the planned sizes in it."""
        sizes = tuple(each for each in self.decisions if each.name != "lines.bounds")
        planned = CapacityPlan(self.tolerance, self.pixel, sizes).apply(config)
        return replace(planned, lines=replace(planned.lines, enabled=self.lines))

    def box(self, device: str) -> Bounds | None:
        """Bounds of the lines as tensors, or None for the configured ones."""
        if self.lines_within is None:
            return None
        low, high = (torch.tensor(corner, device=device) for corner in self.lines_within)
        return Bounds(low, high)

    def summary(self) -> str:
        """As `CapacityPlan.summary`, and whether nothing is dynamic."""
        return super().summary() + "; nothing is dynamic, no lines" * (not self.lines)


def plan_capacity(clip: Clip, mesh: SubjectMesh, config: OursConfig) -> OursPlan:
    """Decide the sizes from cameras, poses and pictures of the training frames.

    Parameters
    ----------
    config : OursConfig
        Its sizes are upper limits; those in ``capacity.keep`` are not changed.
    """
    planner = _Planner(clip, mesh, config)
    planner.lines()
    planner.planes()
    if not planner.kept("splats.max_splats"):
        planner.splats("splats.max_splats", config.splats.max_splats, len(mesh.faces))
    plan = planner.plan()
    return OursPlan(plan.tolerance, plan.pixel, plan.decisions, planner.dynamic, planner.within)


class _Planner(CapacityPlanner):
    """The decisions on lines and planes."""

    def __init__(self, clip: Clip, mesh: SubjectMesh, config: OursConfig):
        super().__init__(clip, mesh, config.capacity)
        self._config = config
        self._metres = config.capacity.tolerance * self.pixel
        self.dynamic = config.lines.enabled
        self.within: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def kept(self, name: Planned) -> bool:
        """Whether the configuration excludes this size from planning."""
        return name in self._config.capacity.keep

    def lines(self) -> None:
        """Directions, jaw bases, box and samples of the lines; empty without lines."""
        lines = self._config.lines
        if not lines.enabled:
            return
        kept = self.kept("lines.expressions")
        expressions = lines.expressions if kept else self.expressions("lines.expressions", lines.expressions)
        self.dynamic = expressions + self._jaw_bases() > 0
        if self.dynamic:
            self._bounds()
        if self.dynamic:
            self._line_resolution()

    def _jaw_bases(self) -> int:
        """Number of jaw bases with lines."""
        configured = self._config.lines.jaw_bases
        # The official choice uses held-out poses; it is reproduced without changes.
        official = self._config.lines.jaw_bases_variant == "official"
        if self.kept("lines.jaw_bases") or official or not configured:
            return configured
        lever = jaw_lever(self._mesh)
        chosen, metres = spanning_jaw_bases(self._poses, configured, lever, self._metres)
        rest = metres / self.pixel
        numbers = {"lever_m": lever, "left_out_px": rest}
        reason = f"without further bases the jaw moves the surface by {rest:.2f} px at most"
        if chosen:
            confirmed, evidence = self.confirmed(JAW, numbers)
            chosen, reason = chosen * confirmed, reason + evidence
        self._decide("lines.jaw_bases", configured, chosen, reason, **numbers)
        return chosen

    def _bounds(self) -> None:
        if self.kept("lines.bounds"):
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
        if self.kept("lines.resolution"):
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
        if self.kept("planes.resolution") or self._config.color != "planes":
            return
        configured = self._config.planes.resolution
        box = plane_box(self._mesh.canonical.cpu(), self._config.planes.bounds_variant)
        side = float((box.high - box.low).max())
        pixels = side / self.pixel
        chosen = min(configured, max(1 + ceil(self._config.capacity.detail * pixels), MINIMUM_PLANE))
        reason = f"the planes' longest side covers {pixels:.0f} px"
        self._decide("planes.resolution", configured, chosen, reason, longest_m=side, longest_px=pixels)


def largest_displacements(mesh: SubjectMesh, poses: list[HeadPose]) -> FloatArray:
    """(F,) maximum displacement of a triangle's centroid from the canonical mesh by expression, jaw and eyes, metres."""
    largest = torch.zeros(len(mesh.faces), device=mesh.faces.device)
    with torch.no_grad():
        for pose in poses:
            unposed = mesh.unposed(mesh.arguments([pose]))
            moved = centroid_displacements(unposed, mesh.canonical, mesh.faces)
            largest = torch.maximum(largest, moved.to(largest))
    return largest.cpu().numpy()


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
