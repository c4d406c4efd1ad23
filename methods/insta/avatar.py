"""The trained avatar: its rendering."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.configuration import build
from ...bench.contracts import Camera, Changes, Frame, HeadPose
from ...bench.errors import HeadbenchError, InputError
from ...bench.io.arrays import Member, check_arrays, read_npz
from ...bench.io.documents import parse_json, read_json
from ...bench.native.dispatch import fits
from ..avatars.compact.coder import codec_of
from ..avatars.compact.layouts import grid, read_coded
from ..shared.avatar_files import COMPACT_FILE, SUBJECT_FILE, read_shared_head, read_subject, write_arrays
from ..shared.rendering import changes_of
from ..shared.surface_points import SubjectMesh, pose_key
from ..shared.threads import threads
from . import kernel
from .field import Architecture, Parameters, Prior, RadianceField
from .marching import PosedSurface, Space, canonical_surface, mouth_triangles
from .occupancy import (
    Marching,
    Occupancy,
    PosedRays,
    box_corners,
    camera_rays,
    occupied_space,
    pixels_by_blocks,
    pixels_of_hull,
    render_rays,
)
from .spec import InstaConfig

RAYS_AT_ONCE = 1 << 15
ROUND_SAMPLES = 4  # maximum; without gradients, testing the transmittance costs less than hidden samples
MIDDLE = 0.5  # fraction of a step: position of samples without random jitter


class InstaAvatar:
    """A trained head: a canonical radiance field, the region with density, and the mesh that maps rays to canonical space."""

    def __init__(
        self,
        files: Sequence[Path],
        mesh: SubjectMesh,
        config: InstaConfig,
        field: RadianceField,
        parameters: Parameters,
        space: Space,
        surface: PosedSurface,
        mouth: torch.Tensor,
    ):
        self.space, self._files, self._mesh, self._surface = space, files, mesh, surface.surface
        round_samples = min(config.round_samples, ROUND_SAMPLES)
        marching = Marching(config.step, round_samples, config.stop_transmittance)
        self._inference = Inference(field, parameters, space, mouth, marching)
        self._last: tuple[bytes, PosedSurface] | None = None

    @classmethod
    def read(cls, folder: Path, device: str) -> InstaAvatar:
        """Read an avatar from its folder."""
        head, coded = read_shared_head(folder), folder / COMPACT_FILE
        if coded.exists():
            files, (subject, tensors, text) = [coded], read_coded(coded, head, grid)
            arrays = {name: value.numpy() for name, value in tensors.items()}
            config = _settings(parse_json(text.get(SETTINGS, ""), coded, SETTINGS), coded)
        else:
            files = [folder / name for name in (FIELD_FILE, SETTINGS_FILE, SUBJECT_FILE)]
            subject = read_subject(folder / SUBJECT_FILE, head)
            config = _settings(read_json(folder / SETTINGS_FILE), folder / SETTINGS_FILE)
            arrays = read_npz(folder / FIELD_FILE)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
        surface = canonical_surface(head, mesh, config)
        occupancy = Occupancy(surface, config)
        architecture = Architecture.of(config, mesh.model.expression_size)
        size = tuple(int(side) for side in occupancy.size)
        parameters, cells = field_of(files[0], arrays, architecture, size, device)
        field = RadianceField(architecture, occupancy.box(device), Prior.of(config))
        space = occupied_space(occupancy, cells)
        return cls(files, mesh, config, field, parameters, space, surface.rest, mouth_triangles(head))

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame."""
        surface = self._posed(pose)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        rgb[:] = np.asarray([float(channel) for channel in background], np.float32).clip(0, 1)
        alpha = np.zeros((camera.height, camera.width), np.float32)
        reach = float(surface.reach(self.space).max())
        if reach < 0:
            return Frame(rgb, alpha)
        corners = box_corners(surface.vertices.numpy(), reach)
        condition = torch.tensor(np.asarray(pose.expression), dtype=torch.float32)
        for rows, columns in pixels_by_blocks(pixels_of_hull(camera, corners), RAYS_AT_ONCE):
            scene = PosedRays(surface, condition, camera_rays(camera, columns, rows, MIDDLE))
            seen = self._inference.render(scene)
            inside = (rows < camera.height) & (columns < camera.width)
            rows, columns = rows[inside], columns[inside]
            left_over = seen.transmittance[inside, None]
            rgb[rows, columns] = seen.color[inside] + left_over * rgb[rows, columns]
            alpha[rows, columns] = 1 - left_over[:, 0]
        return Frame(rgb.clip(0, 1), alpha.clip(0, 1))

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Opacity of a step, and colour weighted by it as seen from the front, at the middle of occupied cells at the mouth."""
        field, parameters = self._inference.field, self._inference.parameters
        positions, distances = self._mouth_cells
        condition = torch.tensor(np.asarray(pose.expression), dtype=torch.float32)
        conditions = condition[None, : field.architecture.conditions]
        rows = torch.zeros(len(positions), dtype=torch.int64)
        latent = field.latent(parameters, positions, conditions, rows)
        opacity = 1 - torch.exp(-self._inference.marching.step * field.density(latent, distances))
        color = field.color(parameters, latent, torch.tensor([[0.0, 0.0, -1.0]]).repeat(len(positions), 1))
        return changes_of({"opacity": opacity, "color": opacity[:, None] * color})

    @cached_property
    def _mouth_cells(self) -> tuple[Tensor, Tensor]:
        """(N, 3) middles of the occupied cells whose nearest triangle is of the mouth, and (N,) distances to it, metres."""
        cells = np.argwhere(self.space.occupied) + np.float32(0.5)
        middles = (self.space.low + self.space.cell * cells).astype(np.float32)
        triangles, squared = self._surface.rest.nearest(middles)
        at_mouth = self._inference.mouth[triangles]
        return torch.from_numpy(middles)[at_mouth], squared[at_mouth].sqrt()

    def files(self) -> Sequence[Path]:
        """Field, settings and subject, or the coded file."""
        return self._files

    @property
    def codec(self) -> str:
        """The codec of the files, see `CodedAvatar`."""
        return codec_of(self._files)

    def _posed(self, pose: HeadPose) -> PosedSurface:
        """The surface of a pose; the last one is cached, since several cameras often render one pose."""
        key = pose_key(pose)
        if self._last is None or self._last[0] != key:
            vertices = self._mesh.posed(self._mesh.arguments([pose]))
            self._last = key, self._surface.pose(vertices)
        return self._last[1]


FIELD_FILE = "field.npz"
SETTINGS_FILE = "field.json"
OCCUPIED = "occupied"
SETTINGS = "settings"
"""Key of the settings in the coded file."""
TABLE = "table"
"""Name of the features of the hash grid."""


def _settings(values: Mapping[str, Any], path: Path) -> InstaConfig:
    try:
        config: InstaConfig = build(InstaConfig, values, str(path))
    except InputError:
        raise
    except (HeadbenchError, TypeError, ValueError) as error:
        raise InputError(path, "", "settings of INSTA", str(error)) from error
    return config


def write_field(path: Path, parameters: Mapping[str, Tensor], occupied: np.ndarray) -> None:
    """Write parameters and (X, Y, Z) occupancy."""
    arrays = {name: value.detach().cpu().half().numpy() for name, value in parameters.items()}
    bits = np.packbits(occupied.reshape(-1))
    write_arrays(path, {**arrays, OCCUPIED: bits})


def field_of(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    architecture: Architecture,
    size: tuple[int, ...],
    device: str,
) -> tuple[dict[str, Tensor], np.ndarray]:
    """Float32 parameters, and flat indices of occupied cells, of the arrays of a file."""
    shapes, cells = architecture.shapes(), math.prod(size)
    members = {name: Member("f", shape) for name, shape in shapes.items()}
    check_arrays(path, arrays, {**members, OCCUPIED: Member("u", (-(-cells // 8),), dtype="u1")})
    parameters = {name: torch.from_numpy(arrays[name].astype(np.float32)).to(device) for name in shapes}
    return parameters, np.flatnonzero(np.unpackbits(arrays[OCCUPIED], count=cells))


class RayColors(NamedTuple):
    """Result of rays, as float32 numpy arrays."""

    color: np.ndarray  # (R, 3) not composited on a background
    transmittance: np.ndarray  # (R,)
    samples: int


class Inference:
    """A trained field in a space, prepared for rendering.

    - ``mouth``: (F,) bool, as in `render_rays`.
    - ``backend``: "reference" is `render_rays`; "auto" uses the kernel for parameters in float32 on the CPU. A value of the
      kernel's ``instruction_sets()`` selects the kernel with that instruction set.
    """

    def __init__(
        self,
        field: RadianceField,
        parameters: Parameters,
        space: Space,
        mouth: Tensor,
        marching: Marching,
        backend: str = "auto",
    ):
        self.field, self.parameters, self.space = field, parameters, space
        self.mouth, self.marching = mouth, marching
        self._isa = "" if backend == "auto" else backend
        table = parameters["table"]
        compiled = backend != "reference" and fits(kernel.KERNEL, table)
        self._trained: Any = self._prepared(kernel.load()) if compiled else None

    @torch.no_grad()
    def render(self, scene: PosedRays) -> RayColors:
        """Result of the rays of one pose."""
        module = scene.surface.surface.module
        if self._trained is None or module is None:
            seen = render_rays(self.field, self.parameters, [scene], self.space, self.mouth, self.marching)
            return RayColors(seen.color.cpu().numpy(), seen.transmittance.cpu().numpy(), seen.samples)
        rays = scene.rays
        color = np.empty((len(rays.origins), 3), np.float32)
        transmittance = np.empty(len(color), np.float32)
        samples = module.render(
            *(scene.surface.guide(self.space), self._trained),
            (self._starts(scene.condition), self.mouth.numpy().view(np.uint8)),
            *(rays.contiguous(), self.marching, (color, transmittance), self._isa, threads()),
        )
        return RayColors(color, transmittance, samples)

    def _prepared(self, module: Any) -> Any:
        architecture, box, prior = self.field.architecture, self.field.box, self.field.prior
        arrays = {n: np.ascontiguousarray(value.detach().numpy()) for n, value in self.parameters.items()}
        density = [arrays[f"density_{number}"] for number in range(len(architecture.density_shapes))]
        color = [arrays[f"color_{number}"] for number in range(len(architecture.color_shapes))]
        levels = [tuple(level) for level in architecture.levels]
        low = box.low.numpy().astype(np.float32)
        return module.Trained(levels, arrays["table"], low, box.side, *prior, density, color)

    def _starts(self, condition: Tensor) -> np.ndarray:
        """(2, units) contributions of the conditions to the first layer: outside the mouth, where all are one, and at the mouth."""
        weight = self.parameters["density_0"].detach().numpy()
        width = self.field.architecture.conditions
        conditions = np.stack([np.ones(width, np.float32), condition[:width].numpy().astype(np.float32)])
        by_conditions = weight[:, weight.shape[1] - width :]
        return np.ascontiguousarray(conditions @ by_conditions.T)
