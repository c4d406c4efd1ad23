"""Training of "ours": cached timesteps, colour from planes, opacity from lines, and the opacity penalty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ...bench.contracts import Clip, FloatArray, HeadPose
from ...datasets.head.arrays import faces_in_region
from ...datasets.steps.clusters import jaw_bases, jaw_quaternions, jaw_weights
from ..ops.planes import Bounds, harmonic_colors, initial_coefficients, line_offsets, plane_colors, smoothing
from ..ops.splats import NORMAL, TriangleFrames, directions_to, to_world
from ..shared.optimisation import Optimiser
from ..shared.rendering import View
from ..shared.schedule import Timeline, log_linear, torch_generator
from ..shared.splat_training import ShadedSplats, Start, one_per_triangle
from ..shared.surface_points import BoundedCache, SubjectMesh, centroid_displacements
from .field import (
    COLOR_NETWORK,
    FIRST_LAYER,
    RESIDUAL,
    CanonicalFrames,
    LocalSplats,
    apply_offsets,
    blend_lines,
    changed_colors,
    color_network,
    initial_parameters,
    line_box,
    line_table,
    normalised_weight,
    offset_layers,
    plane_box,
)
from .spec import RAMP_FROM, OursConfig

FLOATS_PER_FACE = 17 + 9 + 1  # triangle frame, turn to canonical, penalty weight


@dataclass(frozen=True, eq=False)
class PreparedTimestep:
    """Constants of a training timestep: frames, directions, driving coefficients, penalty weights."""

    frames: TriangleFrames
    turns: Tensor  # (F, 3, 3) world directions to canonical ones
    coefficients: Tensor  # (2, E + J), see `driving_coefficients`
    penalty: Tensor  # (F,)


class OursAppearance:
    """Tri-plane colour and feature-line opacity; tracking is not refined.

    ``lines_within`` replaces the box of ``config.lines.bounds``.
    """

    def __init__(
        self,
        mesh: SubjectMesh,
        clip: Clip,
        config: OursConfig,
        device: str,
        seed: int,
        *,
        lines_within: Bounds | None = None,
    ):
        self._mesh, self._clip, self._config, self._device, self._seed = mesh, clip, config, device, seed
        self.canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        self.plane_box = plane_box(mesh.canonical, config.planes.bounds_variant)
        self.line_box = lines_within or _line_box(mesh, clip, config)
        self.expressions = min(config.lines.expressions, clip.head.expression_basis.shape[2])
        self.jaw_bases: FloatArray = np.zeros((0, 4))
        if config.lines.enabled and config.lines.jaw_bases:
            self.jaw_bases = jaw_bases(clip, config.lines.jaw_bases, variant=config.lines.jaw_bases_variant)
        self._is_face = torch.zeros(len(mesh.faces), dtype=torch.bool, device=device)
        if config.lines.enabled and config.penalty.weight:
            self._is_face[torch.from_numpy(faces_in_region(clip.head, "face")).to(device)] = True
        entries = config.splats.mesh_cache_mb * 2**20 // (4 * FLOATS_PER_FACE * len(mesh.faces))
        self._prepared = BoundedCache(self._prepare, entries)
        self._lines_from = 0
        self._smoothing = None
        if config.planes.direction_smoothing:
            features = torch.ones(sum(config.planes.channels))
            factors = torch.cat([features, smoothing(config.planes.direction_smoothing)])
            self._smoothing = factors.to(device)

    def splat_parameters(self, count: int) -> dict[str, tuple[Tensor, float]]:
        """Per-splat colours added to those of the planes, if enabled; spherical harmonics if they replace the planes."""
        if self._config.color == "planes":
            rate = self._config.planes.residual_lr
            return {RESIDUAL: (torch.zeros(count, 3, device=self._device), rate)} if rate else {}
        rates = {"sh_dc": self._config.sh_dc_lr, "sh_rest": self._config.sh_rest_lr}
        generator = torch_generator(self._seed, "sh")
        initial = initial_coefficients(count, self._config.sh_degree, generator)
        return {name: (value.to(self._device), rates[name]) for name, value in initial.items()}

    def parameters(self) -> dict[str, tuple[Tensor, float]]:
        """Planes, lines and networks."""
        generator = torch_generator(self._seed, "field")
        initial = initial_parameters(self._config, self.expressions, len(self.jaw_bases), generator)
        return {name: (value.to(self._device), rate) for name, (value, rate) in initial.items()}

    def stored(self, optimiser: Optimiser) -> dict[str, Tensor]:
        """Trained `parameters` as an avatar stores them: with the factors on directions folded into the weights."""
        return {name: optimiser[name] for name in self.parameters()} | self._network(optimiser)

    def begin(self, timeline: Timeline) -> None:
        """Scale the start of the lines and the schedule of the harmonics' degree to the run."""
        self._lines_from = timeline.at(self._config.lines.start)
        self._timeline = timeline

    def frames(self, timestep: int, optimiser: Optimiser) -> TriangleFrames:
        """Triangle frames, without gradient."""
        return self._prepared(timestep).frames

    def place(
        self,
        frames: TriangleFrames,
        binding: Tensor,
        view: View,
        timestep: int,
        optimiser: Optimiser,
        iteration: int,
    ) -> ShadedSplats:
        """Colours by canonical position and direction, and changes by the lines once they have started."""
        prepared = self._prepared(timestep)
        planes = self._config.planes
        means = optimiser["means"] if planes.move_splats else optimiser["means"].detach()
        positions = self.canonical.positions(binding, means)
        splats = LocalSplats(*(optimiser[name] for name in ("means", "log_scales", "quats", "opacities")))
        if self._config.color == "planes" and planes.residual_lr:
            splats = splats._replace(color_change=optimiser[RESIDUAL])
        penalty = None
        if self._config.lines.enabled and iteration > self._lines_from:
            offsets = self.offsets(optimiser, positions.detach(), prepared.coefficients)
            splats = apply_offsets(splats, offsets, self._config.lines.dynamic)
            if self._config.penalty.weight:
                weights = prepared.penalty.index_select(0, binding)
                size = softened(offsets, self._config.penalty.softness)
                penalty = self._penalty_weight(iteration) * (size * weights[:, None]).mean()
        world = to_world(frames, binding, splats.means, splats.log_scales, splats.quats)
        seen = world.means if self._config.color == "sh" or planes.move_splats else world.means.detach()
        last = self._turn(iteration) if self._config.direction_jitter else None
        directions = directions_to(seen, view.center, prepared.turns, binding, last)
        colors = self._colors(optimiser, positions, directions, iteration)
        return ShadedSplats(world, changed_colors(colors, splats), torch.sigmoid(splats.logits), penalty)

    def _penalty_weight(self, iteration: int) -> float:
        """Weight of the penalty, which rises over its ramp."""
        penalty = self._config.penalty
        ramp = self._timeline.at(penalty.ramp)
        return penalty.weight * log_linear(
            RAMP_FROM, 1.0, (iteration - self._lines_from) / ramp if ramp else 1.0
        )

    def offsets(self, optimiser: Optimiser, positions: Tensor, coefficients: Tensor) -> Tensor:
        """(N, D) offsets; zero outside the lines' box."""
        blended = blend_lines(optimiser["lines"], coefficients)
        table = line_table(blended, normalised_weight(optimiser, 0))
        return line_offsets(positions, self.line_box, table, offset_layers(optimiser))

    def _turn(self, iteration: int) -> Tensor:
        """(3, 3) small random rotation of this iteration."""
        generator = torch_generator(self._seed, "directions", iteration)
        angles = self._config.direction_jitter * torch.randn(3, generator=generator)
        turn = Rotation.from_rotvec(
            angles.numpy()
        ).as_matrix()  # ten times faster than small torch operations
        return torch.as_tensor(turn, dtype=torch.float32, device=self._device)

    def _colors(self, optimiser: Optimiser, positions: Tensor, directions: Tensor, iteration: int) -> Tensor:
        if self._config.color == "sh":
            degree = self._timeline.sh_degree(self._config, iteration)
            return harmonic_colors(optimiser["sh_dc"], optimiser["sh_rest"], -directions, degree)
        network = color_network(self._network(optimiser))
        return plane_colors(positions, directions, self.plane_box, network)

    def _network(self, optimiser: Optimiser) -> dict[str, Tensor]:
        """Planes and weights of the colour network, if any."""
        if self._config.color == "sh":
            return {}
        network: dict[str, Tensor] = {name: optimiser[name] for name in COLOR_NETWORK}
        if self._smoothing is not None:
            network[FIRST_LAYER] = network[FIRST_LAYER] * self._smoothing
        return network

    @torch.no_grad()
    def _prepare(self, timestep: int) -> PreparedTimestep:
        pose = self._clip.poses[timestep]
        arguments = self._mesh.arguments([pose])
        frames = self._mesh.frames(self._mesh.posed(arguments))
        coefficients = driving_coefficients(pose, self.expressions, self.jaw_bases)
        weights = frames.size.new_zeros(len(frames.size))
        if self._config.lines.enabled and self._config.penalty.weight:
            meshes = self._mesh.unposed(arguments), self._mesh.canonical
            weights = penalty_weights(*meshes, self._mesh.faces, self._is_face, self._config)
        blending = torch.from_numpy(coefficients).to(self._device)
        return PreparedTimestep(frames, self.canonical.turns(frames), blending, weights)


def driving_coefficients(pose: HeadPose, expressions: int, bases: FloatArray) -> FloatArray:
    """(2, E + J) blend coefficients of the lines, float32.

    The first row has the leading expression coefficients, the second the weights of the jaw bases; the rest is 0.
    """
    coefficients = np.zeros((2, expressions + len(bases)), np.float32)
    coefficients[0, :expressions] = pose.expression[:expressions]
    if len(bases):
        coefficients[1, expressions:] = jaw_weights(jaw_quaternions([pose]), bases)[0]
    return coefficients


def softened(offsets: Tensor, softness: float) -> Tensor:
    """|offset|, replaced below ``softness`` by a parabola with continuous slope (Huber 1964): offset^2 / (2 softness)."""
    if softness == 0:
        return offsets.abs()
    zero = torch.zeros_like(offsets)
    return torch.nn.functional.huber_loss(offsets, zero, reduction="none", delta=softness) / softness


def penalty_weights(
    unposed: Tensor, canonical: Tensor, faces: Tensor, is_face: Tensor, config: OursConfig
) -> Tensor:
    """(F,) weights of the adaptive truncated opacity penalty.

    Opacities of splats may change only if the expression moves the centroid of their triangle by more than a
    threshold. The face region and the rest have different thresholds and weights.

    - ``unposed``, ``canonical``: (V, 3) metres, with and without expression, jaw and eyes.
    - ``is_face``: (F,) triangles of the face region.
    """
    millimetres = 1000 * centroid_displacements(unposed, canonical, faces)
    still_face = (millimetres < config.penalty.face_mm).to(millimetres.dtype)
    still_other = config.penalty.other_weight * (millimetres < config.penalty.other_mm).to(millimetres.dtype)
    return torch.where(is_face, still_face, still_other)


def _line_box(mesh: SubjectMesh, clip: Clip, config: OursConfig) -> Bounds:
    if config.lines.bounds == "head":
        return line_box(mesh.canonical)
    triangles = torch.from_numpy(faces_in_region(clip.head, "face")).to(mesh.faces.device)
    return line_box(mesh.canonical[mesh.faces[triangles].reshape(-1)])


def outer_layers_start(mesh: SubjectMesh, clip: Clip, config: OursConfig, device: str) -> Start:
    """One splat per triangle, and ``config.outer_layers.count`` more outside each of `expressive_triangles`.

    Without lines opacities are constant, so there are no outer layers.
    """
    start = one_per_triangle(len(mesh.faces), config.splats.initial_opacity, device)
    if not config.lines.enabled or not config.outer_layers.count:
        return start
    chosen = expressive_triangles(mesh, clip, config.penalty.face_mm, device)
    size = mesh.frames(mesh.canonical).size.index_select(0, chosen)
    parts = [start]
    opacities = torch.full((len(chosen),), config.outer_layers.opacity, device=device)
    for layer in range(1, config.outer_layers.count + 1):
        means = torch.zeros(len(chosen), 3, device=device)
        means[:, NORMAL] = layer * config.outer_layers.gap / size
        parts.append(Start(chosen, means, opacities))
    return Start(*(torch.cat(column) for column in zip(*parts)))


@torch.no_grad()
def expressive_triangles(mesh: SubjectMesh, clip: Clip, millimetres: float, device: str) -> Tensor:
    """Indices of face triangles whose centroid a training expression moves by ``millimetres`` or more, ascending.

    On these triangles the penalty allows changes of opacity at some timestep (`penalty_weights`).
    """
    face = torch.from_numpy(faces_in_region(clip.head, "face")).to(device)
    moved = torch.zeros(len(face), dtype=torch.bool, device=device)
    for timestep in sorted({key.timestep for key in clip.splits["train"]}):
        unposed = mesh.unposed(mesh.arguments([clip.poses[timestep]]))
        moved |= 1000 * centroid_displacements(unposed, mesh.canonical, mesh.faces[face]) >= millimetres
    return face[moved]
