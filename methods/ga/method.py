"""GaussianAvatars: Gaussians rigged to a tracked mesh.

Qian et al., "GaussianAvatars: Photorealistic Head Avatars with Rigged 3D Gaussians", CVPR 2024.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, Clip, FloatArray, HeadPose
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..avatars.compact.layouts import bound, read_coded
from ..ops.planes import (
    coefficient_count,
    harmonic_colors,
    harmonic_shader,
    initial_coefficients,
    occupied_degree,
)
from ..ops.splats import TriangleFrames, WorldSplats, activate, to_world
from ..shared.avatar_files import (
    COMPACT_FILE,
    SUBJECT_FILE,
    TRACKED,
    RefinedTracking,
    Subject,
    clip_mesh,
    finish_fit,
    read_shared_head,
    read_subject,
)
from ..shared.capacity import CapacityPlan, CapacityPlanner
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.optimisation import Optimiser
from ..shared.rendering import USUAL, Cutoffs, PlacedSplats, StoredSplatAvatar, View, changes_of
from ..shared.schedule import ShuffledEpochs, Timeline, torch_generator
from ..shared.splat_training import BoundTraining, ShadedSplats
from ..shared.surface_points import BoundedCache, SubjectMesh, TrainingPoses
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_names, read_ply, write_ply
from .spec import GA as SPEC
from .spec import GAConfig

PLY_FILE = "point_cloud.ply"

REST = 15  # coefficients of degrees 1 to 3
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
    "binding_0",
)
"""63 float32 = 252 bytes per splat: local position, zero normals, spherical harmonics (the rest channel by
channel), logit of opacity, log-scales, quaternion wxyz, triangle."""


BINDING = "binding"
SHAPES: dict[str, tuple[int | str | None, ...]] = {
    "means": ("N", 3),
    "log_scales": ("N", 3),
    "quats": ("N", 4),
    "opacities": ("N",),
    "sh_dc": ("N", 3),
    "sh_rest": ("N", 3, None),
}
"""Shapes of the per-splat tensors."""


def write_ga_splats(path: Path, splats: dict[str, Tensor], binding: Tensor) -> None:
    """Write splats in GaussianAvatars' layout, with fewer columns for harmonics of a lower degree.

    Triangle indices are exact in float32 up to 2^24.
    """
    count, rest = len(binding), 3 * splats["sh_rest"].shape[2]
    left_out = {f"f_rest_{i}" for i in range(rest, 3 * REST)}
    columns = [
        splats["means"],
        torch.zeros(count, 3),
        splats["sh_dc"],
        splats["sh_rest"].reshape(count, rest),
        splats["opacities"][:, None],
        splats["log_scales"],
        splats["quats"],
        binding[:, None].to(torch.float32),
    ]
    table = torch.cat([column.detach().to("cpu", torch.float32) for column in columns], dim=1)
    write_ply(path, tuple(name for name in COLUMNS if name not in left_out), table.numpy())


def read_ga_splats(path: Path, face_count: int, device: str) -> tuple[dict[str, Tensor], Tensor]:
    """Read what GaussianAvatars or `write_ga_splats` wrote: per-splat tensors by name, and the binding.

    Harmonics of degree 0 to 2 are padded with zeros.
    """
    normals = ("nx", "ny", "nz")
    rest_names = tuple(name for name in COLUMNS if name.startswith("f_rest_"))
    needed = tuple(name for name in COLUMNS if name not in (*normals, *rest_names))
    degree_rest = _rest_count(path)
    table = torch.from_numpy(read_ply(path, (*needed, *rest_names[: 3 * degree_rest])))
    widths = [3, 3, 1, 3, 4, 1, 3 * degree_rest]
    means, dc, opacity, log_scales, quats, binding, rest = table.split(widths, dim=1)
    filled = rest.new_zeros(len(rest), 3, REST)
    filled[:, :, :degree_rest] = rest.reshape(len(rest), 3, degree_rest)
    geometry = {"means": means, "log_scales": log_scales, "quats": quats, "opacities": opacity[:, 0]}
    tensors = {**geometry, "sh_dc": dc, "sh_rest": filled, BINDING: binding[:, 0].to(torch.int64)}
    return checked_splats(path, tensors, face_count, device)


def checked_splats(
    path: Path, tensors: dict[str, Tensor], face_count: int, device: str
) -> tuple[dict[str, Tensor], Tensor]:
    """Per-splat tensors and the binding."""
    members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in SHAPES.items()}
    check_tensors(path, tensors, members | {BINDING: Member("i", ("N",))})
    check_sizes(path, tensors["log_scales"])
    binding = tensors[BINDING]
    if len(binding) and not (0 <= int(binding.min()) and int(binding.max()) < face_count):
        found = f"{int(binding.min())} to {int(binding.max())}"
        raise InputError(path, BINDING, f"triangles 0 to {face_count - 1}", found)
    return {name: tensors[name].contiguous().to(device) for name in members}, binding.to(device)


def _rest_count(path: Path) -> int:
    """Number of coefficients per channel above degree 0 in a file of degree 0, 1, 2 or 3."""
    found = sum(name.startswith("f_rest_") for name in read_names(path))
    counts = [3 * (coefficient_count(degree) - 1) for degree in range(4)]
    if found not in counts:
        raise InputError(path, "f_rest", f"{', '.join(map(str, counts))} columns", str(found))
    return found // 3


DRIVING_FILE = "driving.npz"
STORED_DEGREE = 3  # the PLY layout has degree 3, regardless of the trained degree
POSES = ("rotation", "neck", "jaw", "eyes")


class GAAppearance:
    """Spherical harmonics in world directions, and tracking that is refined along with the splats."""

    def __init__(self, mesh: SubjectMesh, clip: Clip, config: GAConfig, device: str, seed: int):
        self._mesh, self._config, self._device, self._seed = mesh, config, device, seed
        self.tracked = TrainingPoses(clip, mesh)
        # A frame is 9 + 3 + 1 + 4 floats per triangle.
        entries = config.splats.mesh_cache_mb * 2**20 // (4 * 17 * len(mesh.faces))
        self._cached = BoundedCache(self._tracked_frames, entries)

    def splat_parameters(self, count: int) -> dict[str, tuple[Tensor, float]]:
        """Initial spherical harmonics: nearly zero at degree 0, zero above."""
        rates = {"sh_dc": self._config.sh_dc_lr, "sh_rest": self._config.sh_rest_lr}
        initial = initial_coefficients(count, STORED_DEGREE, torch_generator(self._seed, "sh"))
        return {name: (value.to(self._device), rates[name]) for name, value in initial.items()}

    def parameters(self) -> dict[str, tuple[Tensor, float]]:
        """The tracked values of the training timesteps, (T, n) each, if they are refined."""
        if not self._config.refine_tracking:
            return {}
        config = self._config
        rates = {"expression": config.expression_lr, "translation": config.translation_lr}
        rates |= dict.fromkeys(POSES, config.pose_lr)
        return {name: (self.tracked.arguments[name].clone(), rates[name]) for name in TRACKED}

    def begin(self, timeline: Timeline) -> None:
        """Scale the schedule of the harmonics' degree to the run."""
        self._timeline = timeline

    def frames(self, timestep: int, optimiser: Optimiser) -> TriangleFrames:
        """Triangle frames; differentiable in the refined tracking."""
        row = self.tracked.row[timestep]
        if not self._config.refine_tracking:
            return self._cached(row)
        refined = {name: optimiser[name][row : row + 1] for name in TRACKED}
        return self._mesh.frames(self._mesh.posed(self.tracked.at(row) | refined))

    def place(
        self,
        frames: TriangleFrames,
        binding: Tensor,
        view: View,
        timestep: int,
        optimiser: Optimiser,
        iteration: int,
    ) -> ShadedSplats:
        """Colours by direction from the camera, and unchanged opacities."""
        world = to_world(frames, binding, optimiser["means"], optimiser["log_scales"], optimiser["quats"])
        degree = self._timeline.sh_degree(self._config, iteration)
        vectors = world.means - view.center
        colors = harmonic_colors(optimiser["sh_dc"], optimiser["sh_rest"], vectors, degree)
        return ShadedSplats(world, colors, torch.sigmoid(optimiser["opacities"]), None)

    def refined(self, subject: str, optimiser: Optimiser) -> RefinedTracking | None:
        """Tracking before and after refinement, or None if it is not refined."""
        if not self._config.refine_tracking:
            return None
        before = {name: self.tracked.arguments[name].cpu().numpy() for name in TRACKED}
        after = {name: optimiser[name].detach().cpu().numpy() for name in TRACKED}
        return RefinedTracking(subject, np.array([*self.tracked.row]), before, after)

    @torch.no_grad()
    def _tracked_frames(self, row: int) -> TriangleFrames:
        return self._mesh.frames(self._mesh.posed(self.tracked.at(row)))


class GAAvatar(StoredSplatAvatar):
    """A trained GaussianAvatars head.

    Files: ``point_cloud.ply`` in GaussianAvatars' layout and ``subject.npz``, or the coded file in place of both, count as
    storage. The folder also has the shared head model and the refined tracking of the training timesteps, which is part of the driving signal.

    - ``splat_tensors``, ``binding``: per-splat tensors by name, and the triangle of each splat.
    - ``refined``: the tracking refined in training; None if it was not refined.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        mesh: SubjectMesh,
        subject: Subject,
        splats: dict[str, Tensor],
        binding: Tensor,
        refined: RefinedTracking | None,
        device: str,
        cutoffs: Cutoffs = USUAL,
    ):
        self.mesh, self.subject, self.refined = mesh, subject, refined
        self.splat_tensors, self.binding = splats, binding
        super().__init__(stored, self._placed, device, cutoffs)
        self._shape = splats["log_scales"], splats["quats"]
        self._activated = activate(*self._shape)
        occupied = coefficient_count(occupied_degree(splats["sh_rest"])) - 1
        self._shade = harmonic_shader(splats["sh_dc"], splats["sh_rest"][:, :, :occupied])

    @classmethod
    def read(cls, folder: Path, device: str) -> GAAvatar:
        """Read an avatar from its folder."""
        head, coded = read_shared_head(folder), folder / COMPACT_FILE
        faces = len(head.faces)
        if coded.exists():
            stored, (subject, tensors, _) = [coded], read_coded(coded, head, bound)
            splats, binding = checked_splats(coded, tensors, faces, device)
        else:
            stored = [folder / PLY_FILE, folder / SUBJECT_FILE]
            subject = read_subject(stored[1], head)
            splats, binding = read_ga_splats(stored[0], faces, device)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        driving = folder / DRIVING_FILE
        refined = RefinedTracking.read(driving) if driving.exists() else None
        return cls(stored, mesh, subject, splats, binding, refined, device)

    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours; see `HarmonicAvatar`. The pose does not change them."""
        return self.splat_tensors["sh_dc"].cpu().numpy(), self.splat_tensors["sh_rest"].cpu().numpy()

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Displacement of the splats by the refined tracking; zero in a pose that was not refined."""
        if self.refined is None:
            return Changes({})
        tracked, refined = (self._world(self.mesh.drive(each)).means for each in (pose, self.refined(pose)))
        return changes_of({"position": 1000 * (refined - tracked)})

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        if self.refined is not None:
            pose = self.refined(pose)
        frames = self.mesh.drive(pose)
        end_stage("drive")
        world, opacities = self._world(frames), self.splat_tensors["opacities"]
        return PlacedSplats(world, torch.sigmoid(opacities), partial(self._shade, world.means))

    def _world(self, frames: TriangleFrames) -> WorldSplats:
        return to_world(frames, self.binding, self.splat_tensors["means"], *self._shape, self._activated)


class GA(TrainedMethod[GAConfig, GAAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GAConfig, GAAvatar

    def _planned(self, clip: Clip, config: GAConfig, device: str) -> CapacityPlan:
        mesh = clip_mesh(clip, device)
        planner = CapacityPlanner(clip, mesh, config.capacity)
        planner.splats("splats.max_splats", config.splats.max_splats, len(mesh.faces))
        return planner.plan()

    def _train(self, fit: Fit, config: GAConfig) -> None:
        clip, subject = fit.clip, Subject.of(fit.clip)
        mesh = clip_mesh(clip, fit.device)
        appearance = GAAppearance(mesh, clip, config, fit.device, fit.seed)
        sampler = ShuffledEpochs(len(clip.splits["train"]), fit.seed)
        training = BoundTraining(
            clip, config.splats, appearance, sampler, len(mesh.faces), fit.device, fit.seed
        )
        outcome = training.run(fit)
        optimiser = training.optimiser
        splats: dict[str, Tensor] = {name: optimiser[name] for name in training.splat_names}
        write_ga_splats(fit.out / PLY_FILE, splats, training.binding)
        refined = appearance.refined(clip.subject, optimiser)
        if refined is not None:
            refined.save(fit.out / DRIVING_FILE)
        finish_fit(fit, outcome, subject, clip.head, splats=len(training.binding))
