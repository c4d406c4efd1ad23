"""A fixed number of splats on the surface of a head, driven by a network of the tracked parameters: file, avatar, training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...bench.contracts import Clip, HeadAsset, HeadPose
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...datasets.head.rotations import axis_angle_to_quaternion, matrix_to_quaternion, quaternion_to_matrix
from ..ops.splats import TriangleFrames, WorldSplats, apply_matrices, chart_axes, left_products, to_world
from .avatar_files import AVATAR_FILE, Subject, clip_mesh, finish_fit, read_stored
from .config import SurfaceSettings
from .loop import Fit
from .method import TrainedMethod
from .optimisation import input_count, tracked_inputs
from .rendering import LastPose, PlacedSplats, StoredSplatAvatar
from .schedule import Sampler
from .splat_training import ImageTrainer
from .surface_points import (
    BoundedCache,
    MeshPoints,
    SubjectMesh,
    SurfacePoints,
    TrainingPoses,
    point_tensors,
    spread_points,
    take_points,
)
from .tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, write_tensors

Settings = TypeVar("Settings")
Config = TypeVar("Config", bound=SurfaceSettings)
Avatar = TypeVar("Avatar")


class PointSurface:
    """Points on the mesh of a subject with local axes: those of the triangle, unless a subclass overrides them.

    ``rest``: (N, 3) points on the neutral mesh, metres.
    """

    def __init__(self, mesh: SubjectMesh, points: SurfacePoints):
        self.mesh, self._at_points = mesh, MeshPoints(points, mesh.faces, mesh.canonical)
        self.rest = self._at_points(mesh.canonical)
        self._each = torch.arange(len(self.rest), device=self.rest.device)
        self._unit = torch.ones_like(self.rest[:, 0])

    @torch.no_grad()
    def posed(self, arguments: Mapping[str, Tensor]) -> TriangleFrames:
        """Axes at the points for the arguments of one timestep, each centred on its point, in metres."""
        vertices = self.mesh.posed(arguments)
        rotation, quaternion = self.axes(arguments, vertices)
        return TriangleFrames(rotation, self._at_points(vertices), self._unit, quaternion)

    def place(self, frames: TriangleFrames, splats: Mapping[str, Tensor]) -> WorldSplats:
        """Splats in the world: ``means`` and ``quats`` are along the axes at their points, positions and ``log_scales`` in metres."""
        return to_world(frames, self._each, splats["means"], splats["log_scales"], splats["quats"])

    def axes(self, arguments: Mapping[str, Tensor], vertices: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3, 3) axes as columns and their (N, 4) quaternions, for one timestep's arguments and (V, 3) vertices."""
        frames, triangles = self.mesh.frames(vertices), self._at_points.triangles
        return frames.rotation[triangles], frames.quaternion[triangles]


class HeadSurface(PointSurface):
    """Points on the mesh of a subject with the axes of the head at each.

    FlashAvatar's authors move the camera around a head without rotation, neck and translation. Here these move the mesh, and the
    axes turn with them: with root and neck as far as the surface follows the neck, by the skinning weights, and with the root
    alone elsewhere. They do not turn with jaw and eyes, whose effect the network learns, as in the authors' program.
    """

    @cached_property
    def _of_root(self) -> Tensor:
        """(N, 1) skinning weights of the root."""
        return self._at_points(self.mesh.model.skinning_weights[:, :1])

    def axes(self, arguments: Mapping[str, Tensor], vertices: Tensor) -> tuple[Tensor, Tensor]:
        """See `PointSurface.axes`."""
        root, neck = (axis_angle_to_quaternion(arguments[name]) for name in ("rotation", "neck"))
        # Interpolate along the shorter arc: the neck's relative quaternion has a non-negative real part.
        neck = torch.where(neck[:, :1] < 0, -neck, neck)
        head = apply_matrices(left_products(root).flatten(1), neck)
        turns = normalize(head + self._of_root * (root - head), dim=1)
        return quaternion_to_matrix(turns), turns


class ChartSurface(PointSurface):
    """Points on the mesh of a subject with the `chart_axes` of their triangles, which turn only approximately with the head."""

    def __init__(self, mesh: SubjectMesh, points: SurfacePoints, head: HeadAsset):
        super().__init__(mesh, points)
        where, uv = f"head model {head.version!r}", getattr(head, "uv", None)
        if uv is None:
            remedy = "Use the orthonormal axes of the triangles, or a head model with texture coordinates."
            raise InputError(where, "uv", "texture coordinates, along which the axes are", "none", remedy)
        corners = np.asarray(uv, np.float64)[points.triangles]
        edges = corners[:, 1:] - corners[:, :1]
        if not np.linalg.det(edges).all():
            raise InputError(where, "uv", "an area in the chart for every splat's triangle", "none for some")
        self._uv_edges = torch.from_numpy(edges).to(self.rest)
        self._vertices = mesh.faces[self._at_points.triangles]

    def axes(self, arguments: Mapping[str, Tensor], vertices: Tensor) -> tuple[Tensor, Tensor]:
        """See `PointSurface.axes`; the quaternion is that of the authors' program, also where the axes are not a rotation."""
        axes = chart_axes(vertices[self._vertices], self._uv_edges)
        return axes, matrix_to_quaternion(axes)


@dataclass(frozen=True, eq=False)
class SurfaceSplats(Generic[Settings]):
    """Content of an avatar's file. A derived class describes the tensors and the text of the settings."""

    tensors: dict[str, Tensor]
    """Those of `shapes`."""
    points: SurfacePoints
    """Surface point of each of the N splats."""
    settings: Settings
    """Further values that rendering needs."""
    KEY: ClassVar[str]
    """Key of the settings in the file's metadata."""

    @classmethod
    def surface(
        cls, mesh: SubjectMesh, points: SurfacePoints, head: HeadAsset, settings: Settings
    ) -> PointSurface:
        """The points on the mesh of a subject, with axes at each."""
        return PointSurface(mesh, points)

    def shapes(self, head: HeadAsset) -> Mapping[str, tuple[int | str, ...]]:
        """Shapes of the float32 tensors by name; "N" is the number of splats, and other names stand for any size."""
        raise NotImplementedError

    def text(self) -> str:
        """The settings as text."""
        raise NotImplementedError

    @classmethod
    def settings_of(cls, path: Path, text: str) -> Settings:
        """Settings of a `text`."""
        raise NotImplementedError

    def checked(self, path: Path, head: HeadAsset, device: str) -> Self:
        """The same on a device."""
        members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in self.shapes(head).items()}
        check_tensors(path, self.tensors, members, {"N": len(self.points.triangles)})
        check_sizes(path, self.tensors["log_scales"])
        return replace(self, tensors={name: self.tensors[name].to(device) for name in members})

    def write(self, path: Path) -> None:
        """Write the file without loss: 12 bytes for the point of each splat, 4 for each number of a tensor."""
        write_tensors(path, self.tensors | point_tensors(self.points), {self.KEY: self.text()})

    @classmethod
    def of(
        cls, path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], head: HeadAsset, device: str
    ) -> Self:
        """Check the content of a file that `write` wrote."""
        settings = cls.settings_of(path, metadata.get(cls.KEY, ""))
        points = take_points(path, tensors, len(head.faces))
        return cls(tensors, points, settings).checked(path, head, device)


Stored = TypeVar("Stored", bound=SurfaceSplats[Any])


class SurfaceAvatar(StoredSplatAvatar, Generic[Stored]):
    """Base class of the trained heads: subclasses define the classes of file and surface, and place splats.

    Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage. The folder also has
    the shared head model.
    """

    stored_class: ClassVar[Any]
    read_coded: ClassVar[Any]
    """Reader of a coded file, see `read_stored`."""

    def __init__(self, files: Sequence[Path], head: HeadAsset, subject: Subject, stored: Stored, device: str):
        super().__init__(files, LastPose(self._posed), device)
        self.mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        self.subject, self.stored = subject, stored
        self.surface = stored.surface(self.mesh, stored.points, head, stored.settings)

    @classmethod
    def read(cls, folder: Path, device: str) -> Self:
        """Read an avatar from its folder."""
        content_of = partial(cls.stored_class.of, device=device)
        return cls(*read_stored(folder, AVATAR_FILE, content_of, cls.read_coded), device)

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        arguments = self.mesh.arguments([pose])
        frames = self.surface.posed(arguments)
        end_stage("drive")
        return self._placed(frames, arguments)

    def _placed(self, frames: TriangleFrames, arguments: Mapping[str, Tensor]) -> PlacedSplats:
        """Splats of a pose, given by the axes at the points and its arguments."""
        raise NotImplementedError


class SurfaceTrainer(ImageTrainer, Generic[Config]):
    """A `Trainable` except for its loss. A derived class calls `_optimise` in its initialiser.

    - ``inputs``: tracked parameters that the network takes.
    - ``border``: region of the head model whose triangles get no texel of the chart.
    - ``points``, ``rest``: surface point of each splat, and its (N, 3) position on the neutral mesh, metres.
    """

    stored_class: ClassVar[Any]

    def __init__(
        self,
        clip: Clip,
        config: Config,
        sampler: Sampler,
        inputs: Sequence[str],
        device: str,
        seed: int,
        *,
        masks: bool = False,
        border: str = "",
    ):
        super().__init__(clip, config, sampler, device, masks=masks)
        self._config, self._seed, self._mesh = config, seed, clip_mesh(clip, device)
        vertices = self._mesh.canonical.cpu().numpy().astype(np.float64)
        without = clip.head.regions.get(border)
        self.points = spread_points(
            *(clip.head, vertices, config.samples, seed), chart=config.uv_chart, chart_without=without
        )
        self.rest = self.points.positions(vertices, np.asarray(clip.head.faces))
        self._surface = self.stored_class.surface(self._mesh, self.points, clip.head, config)
        if not input_count(clip.head, inputs):
            expected = "at least one tracked parameter of the head model"
            raise InputError(f"clip {clip.subject}", "inputs", expected, ", ".join(inputs))
        self._tracked = TrainingPoses(clip, self._mesh)
        self._inputs = tracked_inputs(self._tracked.arguments, inputs)
        entries = config.mesh_cache_mb * 2**20 // (4 * 17 * len(self.rest))
        self._frames = BoundedCache(lambda row: self._surface.posed(self._tracked.at(row)), entries)

    def note(self) -> str:
        """Number of splats."""
        return f"{len(self.rest)} splats"

    def result(self) -> SurfaceSplats[Any]:
        """The trained avatar."""
        stored: SurfaceSplats[Any] = self.stored_class(self.tensors(), self.points, self._config)
        return stored


class SurfaceMethod(TrainedMethod[Config, Avatar]):
    """Base class of methods; subclasses define the training class besides those of a `TrainedMethod`."""

    training_class: ClassVar[Any]

    def _train(self, fit: Fit, config: Config) -> None:
        training = self.training_class(fit.clip, config, fit.device, fit.seed)
        outcome, stored = training.run(fit), training.result()
        stored.write(fit.out / AVATAR_FILE)
        splats = len(stored.points.triangles)
        finish_fit(fit, outcome, Subject.of(fit.clip), fit.clip.head, splats=splats)
