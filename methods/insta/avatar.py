"""The trained avatar: its rendering."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ...bench.contracts import Camera, Frame, HeadPose
from ..shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head, read_subject
from ..shared.subject_mesh import SubjectMesh, pose_key
from .canonical import canonical_surface
from .config import InstaConfig
from .field import Architecture, Field, Parameters, Prior
from .inference import Inference
from .marching import PosedSurface, Space
from .occupancy import Occupancy, occupied_space
from .parts import mouth_triangles
from .rays import box_corners, camera_rays, pixels_of_hull
from .rendering import Marching, Scene
from .storage import FIELD_FILE, SETTINGS_FILE, read_field, read_settings

RAYS_AT_ONCE = 1 << 15
MIDDLE = 0.5  # of a step: where samples lie when nothing is left to chance


class InstaAvatar:
    """A trained head: a canonical field and the mesh that carries rays to it.

    Attributes
    ----------
    subject, config : whom it shows, and how it was trained.
    space : where there is density.
    """

    def __init__(
        self,
        folder: Path,
        mesh: SubjectMesh,
        subject: Subject,
        config: InstaConfig,
        field: Field,
        parameters: Parameters,
        space: Space,
        surface: PosedSurface,
        mouth: torch.Tensor,
    ):
        self.subject, self.config, self.space = subject, config, space
        self._folder, self._mesh, self._surface = folder, mesh, surface.surface
        marching = Marching(config.step, config.round_samples, config.stop_transmittance)
        self._inference = Inference(field, parameters, space, mouth, marching)
        self._last: tuple[bytes, PosedSurface] | None = None

    @classmethod
    def read(cls, folder: Path, device: str) -> InstaAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        head = read_shared_head(folder)
        subject = read_subject(folder / SUBJECT_FILE, head)
        config = read_settings(folder / SETTINGS_FILE)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
        surface = canonical_surface(head, mesh, config)
        occupancy = Occupancy(surface, config)
        architecture = Architecture.of(config, mesh.model.expression_size)
        size = tuple(int(side) for side in occupancy.size)
        parameters, cells = read_field(folder / FIELD_FILE, architecture, size, device)
        field = Field(architecture, occupancy.box(device), Prior.of(config))
        space = occupied_space(occupancy, cells)
        return cls(
            folder, mesh, subject, config, field, parameters, space, surface.rest, mouth_triangles(head)
        )

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model."""
        surface = self._posed(pose)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        rgb[:] = np.asarray([float(channel) for channel in background], np.float32).clip(0, 1)
        alpha = np.zeros((camera.height, camera.width), np.float32)
        reach = float(surface.reach(self.space).max())
        if reach < 0:
            return Frame(rgb, alpha)
        corners = box_corners(surface.vertices.numpy(), reach)
        left, top, right, bottom = pixels_of_hull(camera, corners)
        condition = torch.as_tensor(np.asarray(pose.expression), dtype=torch.float32)
        width = right - left
        for start in range(0, max(width, 0) * max(bottom - top, 0), RAYS_AT_ONCE):
            numbers = np.arange(start, min(start + RAYS_AT_ONCE, width * (bottom - top)))
            rows, columns = top + numbers // width, left + numbers % width
            scene = Scene(surface, condition, camera_rays(camera, columns, rows, MIDDLE))
            seen = self._inference.render(scene)
            left_over = seen.transmittance[:, None]
            rgb[rows, columns] = seen.color + left_over * rgb[rows, columns]
            alpha[rows, columns] = 1 - left_over[:, 0]
        return Frame(rgb.clip(0, 1), alpha.clip(0, 1))

    def files(self) -> Sequence[Path]:
        """Field, settings and subject."""
        return [self._folder / name for name in (FIELD_FILE, SETTINGS_FILE, SUBJECT_FILE)]

    def _posed(self, pose: HeadPose) -> PosedSurface:
        """The surface of a pose; that of the last is kept, as several cameras often look at one."""
        key = pose_key(pose)
        if self._last is None or self._last[0] != key:
            vertices = self._mesh.posed(self._mesh.arguments([pose]))
            self._last = key, self._surface.pose(vertices)
        return self._last[1]
