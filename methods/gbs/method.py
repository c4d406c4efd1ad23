"""GaussianBlendshapes: a head as linear blendshapes of splats, skinned like FLAME.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024, arXiv 2404.19398.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, Clip, FloatArray, HeadAsset, HeadPose, IntArray, no_stage
from ...datasets.head.arrays import HeadArrays, faces_in_region
from ...datasets.head.geometry import triangle_areas
from ...datasets.head.teeth import with_teeth_where_possible
from ..avatars.compact.layouts import blended, read_coded
from ..avatars.harmonics import turn_harmonics
from ..ops.photometric import photometric_loss
from ..ops.planes import C0, initial_coefficients, sh_degree
from ..shared.avatar_files import AVATAR_FILE, Subject, clip_mesh, finish_fit, head_arrays, read_stored
from ..shared.capacity import CapacityPlan, CapacityPlanner
from ..shared.loop import Fit, recomposited
from ..shared.method import TrainedMethod
from ..shared.optimisation import rows_of_tables
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar, changes_of
from ..shared.schedule import Sampler, ShuffledEpochs, torch_generator
from ..shared.splat_training import Initial, SplatTrainer, initial_shapes
from ..shared.surface_points import BoundedCache, SubjectMesh, SurfacePoints, poisson_disk, pose_key, spacing
from .blendshapes import (
    PARTS,
    Entries,
    PointMotions,
    PosedAttributes,
    Rig,
    Stored,
    apply_pose,
    consistency_mask,
    difference_widths,
    entries_of,
    stored_of,
    write_avatar,
)
from .spec import GBS as SPEC
from .spec import GBSConfig

ROWS = ("teeth_upper", "teeth_lower")
LOWER_TEETH_WEIGHTS = (0.0131, 0.0426, 0.9443)
"""Root, neck and jaw, in the published code."""
MARGIN = 1.1
"""Size of the mouth cylinder relative to the extent of the teeth at rest."""


class MouthCylinder(NamedTuple):
    """Upright cylinder: (3,) centre, radius and half height, metres."""

    center: Tensor
    radius: float
    half_height: float

    def violation(self, points: Tensor) -> Tensor:
        """Mean over (N, 3) points of the squared distances outside the cylinder, horizontally and vertically."""
        x, y, z = (points - self.center).unbind(1)
        # The floor keeps the gradient of the square root finite on the axis, where the penalty is zero.
        outward = (x * x + z * z).clamp_min(1e-12).sqrt() - self.radius
        upward = y.abs() - self.half_height
        return (torch.relu(outward).square() + torch.relu(upward).square()).mean()


def with_mouth(head: HeadAsset, config: GBSConfig) -> HeadArrays:
    """The head with teeth (regions `ROWS`), and with the configured deviations of the published code from the paper.

    Clips have the same teeth for all methods; a head without teeth gets them here. The paper's teeth are two
    billboards of fixed size in FLAME's mouth; these plates follow the lips of any head.
    """
    arrays = with_teeth_where_possible(head_arrays(head))
    if config.lower_teeth_variant == "official" and "teeth_lower" in arrays.regions:
        weights = arrays.skinning_weights.copy()
        weights[arrays.regions["teeth_lower"]] = (*LOWER_TEETH_WEIGHTS, 0, 0)
        arrays = replace(arrays, skinning_weights=weights)
    if config.correctives_variant == "official":
        arrays = replace(arrays, pose_basis=3 * arrays.pose_basis)
    return arrays


def padded_offset(offset: FloatArray, vertices: int) -> FloatArray:
    """(V, 3) static offset of a head, with zeros for the vertices of teeth that were added."""
    return np.concatenate([offset, np.zeros((vertices - len(offset), 3), offset.dtype)])


def rows_of_teeth(head: HeadArrays) -> list[IntArray]:
    """Triangles of the upper and the lower teeth, if there are teeth."""
    return [faces_in_region(head, name) for name in ROWS if name in head.regions]


def mouth_cylinder(vertices: FloatArray) -> MouthCylinder:
    """The cylinder around the teeth at rest, given their (n, 3) vertices.

    The upright cylinder about the middle of the teeth that contains them all, with `MARGIN`. The published one, of
    radius 27.3 mm and half height 21.6 mm, is made for FLAME's mouth.
    """
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = MARGIN * float(np.linalg.norm((vertices - center)[:, [0, 2]], axis=1).max())
    half_height = 0.5 * MARGIN * float(high[1] - low[1])
    return MouthCylinder(torch.as_tensor(center, dtype=torch.float32), radius, half_height)


DIFFERENCES = "differences"
RATE = 1e-6
"""Learning rate of the table of differences; each column is scaled by the ratio of its own rate to this one. It is
small, so that gradients of the table do not become as small as Adam's epsilon."""


class StartingPoints(NamedTuple):
    """Initial positions of the splats."""

    points: SurfacePoints
    spacing: np.ndarray
    """N points, and the distances to their neighbours, metres."""
    part: np.ndarray
    """(N,) part of each point, ascending: 0 for the head, then a number for each row of teeth."""


class GBSTraining(SplatTrainer):
    """A `Trainable`: neutral splats in metres and the learned differences of those that expressions move.

    Differences are in one table with a row for each splat and expression whose consistency mask is not zero.

    ``points``, ``entries``: the surface point of each splat at the start, and the differences of the splats.
    """

    def __init__(
        self,
        clip: Clip,
        config: GBSConfig,
        subject: Subject,
        head: HeadArrays,
        sampler: Sampler,
        device: str,
        seed: int,
    ):
        super().__init__(clip, config.splats, sampler, device, masks=True)
        self._config, self._recorded_on = config, self._background
        if self._masked:
            self._background = torch.zeros_like(self._recorded_on)  # as published
        start = starting_points(clip, config, subject, head, seed)
        self.points = start.points
        self.rig = Rig(head, subject.shape, subject.static_offset, start.points, config.expressions, device)
        vertices = self.rig.mesh.canonical.cpu().numpy()
        limits = 1e-3 * config.mask_floor_mm, 1e-3 * config.mask_full_mm
        mask = consistency_mask(head, vertices, self.rig.expressions, *limits)
        counts, expressions, weights = entries_of(mask, start.points.triangles)
        self._counts = torch.from_numpy(counts).to(device)
        self._expressions = torch.from_numpy(expressions).to(device)
        self._weights = torch.from_numpy(weights).to(device, torch.float32)
        self._part = torch.from_numpy(start.part).to(device)
        self._rows = int(start.part[-1])
        self._cylinder = None
        if self._rows:
            cylinder = mouth_cylinder(vertices[head.regions["teeth"]])
            self._cylinder = cylinder._replace(center=cylinder.center.to(device))
        poses = {pose_key(clip.poses[key.timestep]): clip.poses[key.timestep] for key in self.keys}
        row = {name: index for index, name in enumerate(poses)}
        self._pose = {key.timestep: row[pose_key(clip.poses[key.timestep])] for key in self.keys}
        self._arguments = self.rig.arguments(list(poses.values()))
        # Half of the memory for points, half for splats.
        self._poses_kept = config.splats.mesh_cache_mb * 2**19 // (4 * sum(PARTS.values()) * len(counts))
        self._motions = BoundedCache(self._motions_at, self._poses_kept)
        splats, shared = self._initial(start, int(counts.sum()), device, seed)
        thresholds = torch.full((len(counts),), config.splats.densify_gradient, device=device)
        thresholds[self._part > 0] = config.teeth_densify_gradient
        tables = {"tables": (DIFFERENCES,), "table_rows": self._counts}
        binding = torch.arange(len(counts), device=device)
        books = {"thresholds": thresholds, "keep_last": False, **tables}
        self._start(splats, shared, binding, len(counts), 1.0, seed, **books)
        self._sizes = torch.ones(len(counts), device=device)
        self._entries: tuple[Tensor, Entries] | None = None
        self._of_teeth: tuple[Tensor, Sequence[Tensor]] | None = None
        self._of_splats: tuple[Tensor, BoundedCache[tuple[PointMotions, Tensor]]] | None = None

    def loss(self, iteration: int, index: int) -> Tensor:
        """Photometric loss of one image, alpha loss, and penalty on teeth outside the mouth."""
        key, config, optimiser = self.keys[index], self._config, self.optimiser
        view = self._views[key.camera]
        image, coverage = self._on_background(self._images.get(iteration, index))
        pose = self._pose[key.timestep]
        motions, shares = self._splat_motions(pose)
        differences = self.entries.blended(optimiser[DIFFERENCES], shares) * self._column_scales
        posed = apply_pose({name: optimiser[name] for name in self.splat_names}, differences, motions)
        degree = self._timeline.sh_degree(config, iteration)
        colors = posed.colors(view.center, degree)
        rendering, _ = self._render(posed.world, posed.opacities, colors, view, self._sizes)
        loss = photometric_loss(rendering.image, image, config.splats.ssim_weight)
        if coverage is not None and config.alpha_weight:
            loss = loss + config.alpha_weight * (rendering.alpha - coverage).square().mean()
        if self._cylinder is not None and config.teeth_weight:
            for teeth in self._teeth():
                violation = self._cylinder.violation(optimiser["means"].index_select(0, teeth))
                loss = loss + config.teeth_weight * violation
        return loss

    def _teeth(self) -> Sequence[Tensor]:
        """Splats of each non-empty row of teeth in the current binding."""
        if self._of_teeth is None or self._of_teeth[0] is not self.binding:
            part = self._part.index_select(0, self.binding)
            rows = [(part == row).nonzero().squeeze(1) for row in range(1, self._rows + 1)]
            self._of_teeth = self.binding, [teeth for teeth in rows if len(teeth)]
        return self._of_teeth[1]

    def _splat_motions(self, pose: int) -> tuple[PointMotions, Tensor]:
        """Effect of a pose on the currently bound splats, and the weights of their differences."""
        binding = self.binding
        if self._of_splats is None or self._of_splats[0] is not binding:
            self._of_splats = binding, BoundedCache(self._splat_motions_at, self._poses_kept)
        return self._of_splats[1](pose)

    def _splat_motions_at(self, pose: int) -> tuple[PointMotions, Tensor]:
        coefficients = self._arguments["expression"][pose, : self.rig.expressions]
        motions = PointMotions.of(self._motions(pose).index_select(0, self.binding))
        return motions, self.entries.shares(coefficients)

    @property
    def entries(self) -> Entries:
        """The differences of the splats in the current binding."""
        binding = self.binding
        if self._entries is None or self._entries[0] is not binding:
            rows = rows_of_tables(self._counts, binding)
            expressions, weights = (values[rows] for values in (self._expressions, self._weights))
            self._entries = binding, Entries.of(self._counts[binding], expressions, weights)
        return self._entries[1]

    def merged_differences(self) -> Tensor:
        """(M, C) differences at coefficient 1: trained values times the mask."""
        table = self.optimiser[DIFFERENCES].detach() * self._column_scales
        return table * self.entries.weights[:, None]

    def _on_background(self, image: Tensor) -> tuple[Tensor, Tensor | None]:
        """(H, W, 3) colours on the training background, and (H, W) coverage if there are masks.

        If there is a mask, the recorded background is replaced.
        """
        if not self._masked:
            return image, None
        colors, coverage = image[:, :, :3], image[:, :, 3:]
        return recomposited(colors, coverage, self._recorded_on, self._background), coverage[:, :, 0]

    def _position_progress(self, iteration: int) -> float:
        return iteration / max(self._timeline.at(self._config.position_settles), 1)

    def _motions_at(self, row: int) -> Tensor:
        return self.rig.motions({name: values[row : row + 1] for name, values in self._arguments.items()})

    def _initial(
        self, start: StartingPoints, entries: int, device: str, seed: int
    ) -> tuple[Initial, Initial]:
        config, settings = self._config, self._config.splats
        widths = difference_widths(config.difference_sh_degree)
        rates = {
            "means": config.difference_position_lr,
            "log_scales": config.difference_scale_lr,
            "quats": config.difference_rotation_lr,
            "opacities": config.difference_opacity_lr,
            "sh_dc": config.difference_sh_lr,
            "sh_rest": config.difference_sh_lr,
        }
        columns = [torch.full((width,), rates[name] / RATE) for name, width in widths.items()]
        self._column_scales = torch.cat(columns).to(device)
        harmonics = initial_coefficients(len(start.spacing), config.sh_degree, torch_generator(seed, "sh"))
        splats = {
            "means": (self.rig.rest.clone(), settings.position_lr),
            **initial_shapes(start.spacing, settings),
            "sh_dc": (harmonics["sh_dc"], config.sh_dc_lr),
            "sh_rest": (harmonics["sh_rest"], config.sh_rest_lr),
        }
        return splats, {DIFFERENCES: (torch.zeros(entries, sum(widths.values())), RATE)}


def starting_points(
    clip: Clip, config: GBSConfig, subject: Subject, head: HeadArrays, seed: int
) -> StartingPoints:
    """Poisson-disk samples of the neutral head and of each row of teeth."""
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    vertices, faces = mesh.canonical.numpy().astype(np.float64), np.asarray(head.faces)
    rows = rows_of_teeth(head)
    on_teeth = np.concatenate([*rows, np.empty(0, np.int64)])
    on_head = np.setdiff1d(np.arange(len(faces)), on_teeth)
    share = config.teeth_samples / config.samples
    count = sample_count(
        clip, config, float(triangle_areas(vertices, faces[on_head]).sum()), vertices.mean(0)
    )
    parts = [(on_head, count), *((row, round(share * count)) for row in rows)]
    found = [poisson_disk(vertices, faces, *part, seed) for part in parts if part[1] > 0]
    points = SurfacePoints(*(np.concatenate(columns) for columns in zip(*found)))
    distances = [spacing(part.positions(vertices, faces)) for part in found]
    part = np.repeat(np.arange(len(found)), [len(points.triangles) for points in found])
    return StartingPoints(points, np.concatenate(distances), part)


def sample_count(clip: Clip, config: GBSConfig, area: float, middle: np.ndarray) -> int:
    """Initial number of splats on the head: as configured, or as many as the training images resolve."""
    if not config.sample_spacing:
        return config.samples
    sizes = []
    for key in clip.splits["train"]:
        camera = clip.cameras[key.camera]
        head = middle + np.asarray(clip.poses[key.timestep].translation, np.float64)
        focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
        sizes.append(np.linalg.norm(camera.center - head) / focal)
    required = area / (config.sample_spacing * float(np.mean(sizes))) ** 2
    return max(1, min(config.samples, round(required)))


class GBSAvatar(StoredSplatAvatar):
    """A trained head: neutral splats, differences for expressions, and the joints that move them.

    Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage. The folder also
    has the shared head model with teeth. Values derived from the mesh are computed when the avatar is loaded.
    """

    def __init__(self, files: Sequence[Path], subject: Subject, rig: Rig, stored: Stored, device: str):
        super().__init__(files, self._placed, device)
        self._rig, self.subject, self.stored = rig, subject, stored
        self._last = LastPose(self._posed)

    @classmethod
    def read(cls, folder: Path, device: str) -> GBSAvatar:
        """Read an avatar from its folder."""
        content_of, coded = partial(stored_of, device=device), partial(read_coded, layout=blended)
        files, head, subject, stored = read_stored(folder, AVATAR_FILE, content_of, coded)
        rig = Rig(head, subject.shape, subject.static_offset, stored.points, stored.expressions, device)
        return cls(files, subject, rig, stored, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the splats' axes, which turn with the surface."""
        posed = self._last(pose, no_stage)
        return turn_harmonics(posed.sh_dc, posed.sh_rest, posed.inverse.view(-1, 3, 3).mT)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the learnt differences."""
        widths = difference_widths(0)
        columns = self._differences(self._rig.arguments([pose]))[:, : sum(widths.values())]
        learnt = dict(zip(widths, columns.split([*widths.values()], dim=1)))
        opacity = torch.sigmoid(self.stored.neutral["opacities"] + learnt["opacities"][:, 0])
        return changes_of(
            {"position": 1000 * learnt["means"], "opacity": opacity, "color": C0 * learnt["sh_dc"]}
        )

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PosedAttributes:
        arguments = self._rig.arguments([pose])
        motions = PointMotions.of(self._rig.motions(arguments))
        end_stage("drive")
        return apply_pose(self.stored.neutral, self._differences(arguments), motions)

    def _differences(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(N, C) learnt differences of a pose."""
        return self.stored.entries.sum(self.stored.differences, self._rig.coefficients(arguments))

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        posed = self._last(pose, end_stage)
        degree = sh_degree(self.stored.neutral["sh_rest"])
        return PlacedSplats(posed.world, posed.opacities, lambda center: posed.colors(center, degree))


class GBS(TrainedMethod[GBSConfig, GBSAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GBSConfig, GBSAvatar

    def _planned(self, clip: Clip, config: GBSConfig, device: str) -> CapacityPlan:
        planner = CapacityPlanner(clip, clip_mesh(clip, device), config.capacity)
        planner.expressions("expressions", config.expressions)
        planner.splats("splats.max_splats", config.splats.max_splats, config.samples)
        return planner.plan()

    def _train(self, fit: Fit, config: GBSConfig) -> None:
        clip, seed = fit.clip, fit.seed
        head = with_mouth(clip.head, config)
        offset = padded_offset(np.asarray(clip.static_offset, np.float32), len(head.template))
        subject = Subject(clip.subject, head.version, np.asarray(clip.shape, np.float32), offset)
        sampler = ShuffledEpochs(len(clip.splits["train"]), seed)
        training = GBSTraining(clip, config, subject, head, sampler, fit.device, seed)
        outcome = training.run(fit)
        self._write(fit.out / AVATAR_FILE, training)
        counts = {"splats": len(training.binding), "differences": len(training.entries.owners)}
        finish_fit(fit, outcome, subject, head, **counts, teeth="teeth" in head.regions)

    def _write(self, path: Path, training: GBSTraining) -> None:
        binding = training.binding.cpu().numpy()
        points = training.points.rows(binding)
        neutral = {name: training.optimiser[name].detach() for name in training.splat_names}
        differences = training.merged_differences()
        write_avatar(path, neutral, points, training.rig.expressions, training.entries, differences)
