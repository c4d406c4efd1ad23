"""The trained avatar of GHA: its rendering."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import Camera, Frame, HeadPose
from ..shared.avatar_files import SUBJECT_FILE, RefinedTracking, read_shared_head, read_subject
from ..shared.rendering import PosedSplats, posed_splats
from .driving import Driver, code_size
from .gaussian_head import GaussianHead, Splats
from .storage import AVATAR_FILE, read_avatar

DRIVING_FILE = "driving.npz"


class GHAAvatar:
    """A trained head of Gaussians.

    Files: ``avatar.safetensors`` and ``subject.npz`` count as storage; beside them lie the shared head model, and the
    corrected head poses of the training timesteps, which are driving signal.
    """

    def __init__(
        self,
        folder: Path,
        driver: Driver,
        head: GaussianHead,
        tensors: Mapping[str, Tensor],
        corrected: RefinedTracking | None,
    ):
        self._folder, self._driver, self._head = folder, driver, head
        self._tensors, self._corrected = tensors, corrected

    @classmethod
    def read(cls, folder: Path, device: str) -> GHAAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        shared = read_shared_head(folder)
        subject = read_subject(folder / SUBJECT_FILE, shared)
        head, tensors = read_avatar(folder / AVATAR_FILE, code_size(shared), device)
        driver = Driver(
            *(shared, subject.shape, subject.static_offset),
            origin=tensors["origin"].cpu().numpy(),
            unit=head.config.unit,
            expression_scale=tensors["expression_scale"],
            device=device,
        )
        driving = folder / DRIVING_FILE
        corrected = RefinedTracking.read(driving) if driving.exists() else None
        return cls(folder, driver, head, tensors, corrected)

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model.

        Super-resolution knows the background that was trained on alone; where the splats leave some of it to be seen,
        the difference to the one asked for is added.
        """
        trained = self._tensors["background"]
        drawn = self._head.draw(self._posed(pose), camera, trained)
        image = self._head.sharpen(self._tensors, drawn, trained, bounded=True)
        image = image[: camera.height, : camera.width]
        size = [side * self._head.config.upscale for side in drawn.alpha.shape]
        alpha = F.interpolate(drawn.alpha[None, None], size, mode="bilinear", align_corners=False)
        alpha = alpha[0, 0, : camera.height, : camera.width].clamp(0, 1)
        other = image.new_tensor([float(channel) for channel in background]) - trained
        image = (image + (1 - alpha)[..., None] * other).clamp(0, 1)
        return Frame(image.cpu().numpy(), alpha.contiguous().cpu().numpy())

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world, coloured as they are before super-resolution; the view does not matter."""
        splats = self._posed(pose)
        colors = None if camera is None else splats.features[:, :3].clamp(0, 1)
        world = splats.world._replace(quats=F.normalize(splats.world.quats, dim=1))
        return posed_splats(world, splats.opacities, colors)

    def files(self) -> Sequence[Path]:
        """The tensors and the subject."""
        return [self._folder / AVATAR_FILE, self._folder / SUBJECT_FILE]

    def _posed(self, pose: HeadPose) -> Splats:
        if self._corrected is not None:
            pose = self._corrected(pose)
        signal = self._driver.signals(self._driver.arguments([pose]))[0]
        return self._head.splats(self._tensors, signal, self._driver.motion(signal))
