"""Compact tensorial Gaussian avatars: static colour from planes, dynamic opacity from feature lines.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations", CVPR 2025,
arXiv 2504.14967. Everything else is as in GaussianAvatars (`shared.splat_training`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, Clip, FloatArray, HeadPose
from ...bench.native.dispatch import to_device
from ...datasets.head.arrays import JOINT_NAMES, faces_in_region
from ...datasets.steps.clusters import (
    IDENTITY,
    cluster_expressions,
    farthest_quaternions,
    jaw_quaternions,
    leaks,
)
from ..avatars.compact.layouts import field as field_layout
from ..avatars.compact.layouts import read_coded
from ..ops.planes import (
    AXES,
    ENCODING_SIZE,
    Bounds,
    LinePosition,
    Shader,
    harmonic_shader,
    line_position,
    offset_writer,
    shader,
)
from ..ops.splats import activate, to_world
from ..shared.avatar_files import (
    Subject,
    clip_mesh,
    finish_fit,
    read_stored,
)
from ..shared.capacity import JAW, CapacityPlan, CapacityPlanner
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.rendering import USUAL, Cutoffs, LastPose, PlacedSplats, StoredSplatAvatar, changes_of
from ..shared.schedule import Sampler, ShuffledEpochs, Weighted, balanced_weights
from ..shared.splat_training import BoundTraining
from ..shared.surface_points import SubjectMesh, centroid_displacements
from .appearance import OursAppearance, driving_coefficients, outer_layers_start, penalty_weights
from .field import (
    FIELD_FILE,
    FIRST_LAYER,
    LAST_LAYER,
    PLANE_MARGIN,
    RESIDUAL,
    CanonicalFrames,
    LocalSplats,
    StoredField,
    apply_offsets,
    blend_lines,
    changed_colors,
    field_of,
    line_box,
    line_table,
    normalised_weight,
    offset_layers,
    plane_box,
    plane_features,
    position_part,
    splat_columns,
    write_field,
)
from .spec import OURS, OURS_PLUS, OursConfig, Planned

LINE_SAMPLES_PER_PIXEL = 0.5
MINIMUM_PLANE, MINIMUM_LINE = 8, 4
"""Minimum number of samples."""


@dataclass(frozen=True)
class OursPlan(CapacityPlan):
    """The sizes of an avatar of "ours"."""

    lines: bool
    """Whether anything is dynamic."""
    lines_within: tuple[tuple[float, ...], tuple[float, ...]] | None
    """Corners of the lines' box, metres, if it differs from that of ``lines.bounds``."""

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

    ``config``: its sizes are upper limits; those in ``capacity.keep`` are not changed.
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

    Returns number of bases, at most ``limit``, in the farthest-point order of `jaw_bases`, and metres. None are needed if no
    training pose moves a vertex by more than the tolerance from the mean jaw rotation.
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


class LineOffsets:
    """Offsets of the splats inside the lines' box; others have none.

    ``positions``: (N, 3) canonical positions.
    """

    def __init__(self, tensors: Mapping[str, Tensor], positions: Tensor):
        self._lines, self._count = tensors["lines"], len(positions)
        box = Bounds(*tensors["line_box"])
        inside = box.contains(positions).nonzero().squeeze(1)
        unit = box.unit(positions.index_select(0, inside))
        position = line_position(unit, self._lines.shape[2])
        # Neighbours on the lines are stored together because they read the same rows and activate the same units.
        order = _lexicographic(position.rows[:, :AXES], self._lines.shape[2])
        self.inside = inside[order]
        self._first, layers = normalised_weight(tensors, 0), offset_layers(tensors)
        self._outputs = len(layers.bias_2)
        self._write = offset_writer(layers, LinePosition(*(part[order] for part in position)))

    def __call__(self, coefficients: Tensor) -> Tensor:
        """(N, D) offsets of all splats for the (2, E + J) coefficients of a frame, see `driving_coefficients`."""
        table = self.table(coefficients)
        out = table.new_empty if len(self.inside) == self._count else table.new_zeros
        offsets = out(self._count, self._outputs)
        self._write(offsets, self.inside, table)
        return offsets

    def table(self, coefficients: Tensor) -> Tensor:
        """(3 L, H) first layer without its bias, at the samples of a frame's blended lines."""
        return line_table(blend_lines(self._lines, coefficients), self._first)


def _lexicographic(rows: Tensor, resolution: int) -> Tensor:
    """(N,) order of (N, 3) rows by the last column, then the middle one, then the first."""
    x, y, z = rows.unbind(1)
    return torch.argsort((z * AXES * resolution + y) * AXES * resolution + x, stable=True)


class OursAvatar(StoredSplatAvatar):
    """A trained head: splats without colour, planes, lines and two small networks.

    Values that depend only on the canonical position (plane features, positions on the lines) are computed once when
    the avatar is loaded. A folder has the files of a training, or the coded file in place of them.

    - ``face``: (F,) bool, triangles of the face, by which `changes` tells penalised splats from others.
    - ``subject``, ``field``: the subject, and the content of its file.
    - ``neutral``: the splats before an expression changes them.
    - ``line_offsets``: offsets given by the lines; None without lines.
    - ``colors``: view-dependent colour of the planes, or of spherical harmonics, see `Shader`.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        mesh: SubjectMesh,
        subject: Subject,
        field: StoredField,
        device: str,
        cutoffs: Cutoffs = USUAL,
        *,
        face: Tensor | None = None,
    ):
        tensors = field.tensors
        self._face = face
        self.subject, self.field = subject, field
        self.mesh = mesh
        columns = {name: part.contiguous() for name, part in splat_columns(tensors["splats"]).items()}
        geometry = columns["means"], columns["log_scales"], columns["quats"]
        self.neutral = LocalSplats(*geometry, columns["opacities"][:, 0], tensors.get(RESIDUAL))
        self._binding = columns["binding"][:, 0].to(torch.int64)
        self._canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        positions = self._canonical.positions(self._binding, self.neutral.means)
        self._activated = activate(self.neutral.log_scales, self.neutral.quats)
        self.colors: Shader
        self.line_offsets: LineOffsets | None = None
        if "sh_dc" not in tensors:
            features = plane_features(tensors, Bounds(*tensors["plane_box"]), positions)
            of_direction = tensors[FIRST_LAYER][:, -ENCODING_SIZE:].t().contiguous()
            self.colors = shader(position_part(tensors, features), of_direction, tensors[LAST_LAYER])
        else:
            self.colors = harmonic_shader(tensors["sh_dc"], tensors["sh_rest"])
        self._jaw_bases = tensors["jaw_bases"].cpu().numpy().astype(np.float64)
        if "lines" in tensors:
            self.line_offsets = LineOffsets(tensors, positions)
            self._expressions = len(tensors["lines"]) - len(self._jaw_bases)
        super().__init__(stored, LastPose(self._placed), device, cutoffs)

    @classmethod
    def read(cls, folder: Path, device: str) -> OursAvatar:
        """Read an avatar from its folder."""
        content_of, coded = partial(field_of, device=device), partial(read_coded, layout=field_layout)
        files, head, subject, field = read_stored(folder, FIELD_FILE, content_of, coded)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        face = None
        if "face" in head.regions:
            face = torch.zeros(len(mesh.faces), dtype=torch.bool, device=device)
            face[torch.from_numpy(faces_in_region(head, "face")).to(device)] = True
        return cls(files, mesh, subject, field, device, face=face)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the lines on the splats inside their box; penalised are those that the published penalty would keep."""
        if self.line_offsets is None:
            return Changes({})
        rows, changed = self.line_offsets.inside, self._changed(pose)
        triangles, values = self._binding[rows], {}
        if "opacity" in self.field.dynamic:
            values["opacity"] = torch.sigmoid(changed.logits[rows])
        if "position" in self.field.dynamic:
            size = self.mesh.frames(self.mesh.canonical).size[triangles]
            values["position"] = 1000 * (changed.means - self.neutral.means)[rows] * size[:, None]
        if "color" in self.field.dynamic and changed.color_change is not None:
            values["color"] = changed.color_change[rows]
        penalised = None
        if self._face is not None:
            unposed = self.mesh.unposed(self.mesh.arguments([pose]))
            weights = penalty_weights(unposed, self.mesh.canonical, self.mesh.faces, self._face, OursConfig())
            penalised = (weights[triangles] > 0).cpu().numpy()
        return changes_of(values, penalised)

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        frames = self.mesh.drive(pose)
        end_stage("drive")
        turns, splats = self._canonical.turns(frames), self._changed(pose)
        shape = splats.log_scales, splats.quats
        known = shape[0] is self.neutral.log_scales and shape[1] is self.neutral.quats
        activated = self._activated if known else None
        world = to_world(frames, self._binding, splats.means, *shape, activated)

        def colors(center: Tensor) -> Tensor:
            return changed_colors(self.colors(world.means, center, turns, self._binding), splats)

        return PlacedSplats(world, torch.sigmoid(splats.logits), colors)

    def _changed(self, pose: HeadPose) -> LocalSplats:
        """The splats with the offsets of the lines, if any."""
        if self.line_offsets is None:
            return self.neutral
        driving = torch.from_numpy(driving_coefficients(pose, self._expressions, self._jaw_bases))
        coefficients = to_device(driving, self._binding.device)
        return apply_offsets(self.neutral, self.line_offsets(coefficients), self.field.dynamic)


class Ours(TrainedMethod[OursConfig, OursAvatar]):
    """See the module docstring."""

    name, version = OURS.name, OURS.version
    config_class, avatar_class = OursConfig, OursAvatar
    _plan: OursPlan | None = None

    def _resolved(self, clip: Clip, device: str) -> tuple[OursConfig, Any]:
        config, lines = self.config, self.config.lines
        if config.sampling.balanced or (lines.enabled and (config.penalty.weight or lines.bounds == "face")):
            faces_in_region(clip.head, "face")  # raises before long work if the region is missing
        return super()._resolved(clip, device)

    def _planned(self, clip: Clip, config: OursConfig, device: str) -> OursPlan:
        return plan_capacity(clip, clip_mesh(clip, device), config)

    def _train(self, fit: Fit, config: OursConfig) -> None:
        clip, out, device, plan = fit.clip, fit.out, fit.device, self._plan
        mesh = clip_mesh(clip, device)
        within = None if plan is None else plan.box(device)
        appearance = OursAppearance(mesh, clip, config, device, fit.seed, lines_within=within)
        sampler, start = self._sampler(clip, fit.seed), outer_layers_start(mesh, clip, config, device)
        count = len(mesh.faces)
        training = BoundTraining(
            clip, config.splats, appearance, sampler, count, device, fit.seed, start=start
        )
        outcome = training.run(fit)
        optimiser = training.optimiser
        write_field(
            out / FIELD_FILE,
            {name: optimiser[name] for name in training.splat_names},
            training.binding,
            appearance.stored(optimiser),
            *(appearance.plane_box, appearance.line_box, appearance.jaw_bases, config.lines.dynamic),
        )
        finish_fit(
            fit,
            outcome,
            Subject.of(clip),
            clip.head,
            splats=len(training.binding),
            jaw_bases=len(appearance.jaw_bases),
            leaks=leaks(config.lines.jaw_bases_variant) if len(appearance.jaw_bases) else (),
        )

    def _sampler(self, clip: Clip, seed: int) -> Sampler:
        keys, sampling = clip.splits["train"], self.config.sampling
        if not sampling.balanced:
            return ShuffledEpochs(len(keys), seed)
        count, variant = sampling.expression_clusters, sampling.clusters_variant
        clusters = cluster_expressions(clip, count, seed=seed, variant=variant)
        timesteps = np.array([key.timestep for key in keys])
        return Weighted(balanced_weights(timesteps, clusters.by_timestep), seed)


class OursPlus(Ours):
    """The method with the additions of `spec.ADDITIONS`, which its presets have."""

    name, version = OURS_PLUS.name, OURS_PLUS.version
