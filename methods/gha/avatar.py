"""The trained avatar of GHA: its rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import Camera, Changes, FloatArray, Frame, HeadAsset, HeadPose, no_stage
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.native.dispatch import to_device
from ..avatars.compact.container import codec_of
from ..avatars.compact.layouts import networks, read_coded
from ..shared.avatar_files import (
    AVATAR_FILE,
    RefinedTracking,
    Subject,
    read_stored,
    settings_of_text,
    settings_text,
)
from ..shared.rendering import Drawn, LastPose, PosedSplats, changes_of, posed_splats, read_back, splat_depth
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, write_tensors
from ..shared.threads import torch_on_one_thread
from ..splats.cpu import instruction_sets
from .config import GHAConfig
from .driving import POSE_SIZE, Driver, HeadMotion, code_size
from .gaussian_head import POINTS, FeatureSplats, GaussianHead

DRIVING_FILE = "driving.npz"


class GHAAvatar:
    """A trained head of Gaussians.

    Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage. The folder also has the shared head model and
    the corrected head poses of the training timesteps, which are part of the driving signal.

    ``driver``: always on the CPU, regardless of the tensors' device, because its work is small.
    """

    def __init__(
        self,
        files: Sequence[Path],
        subject: Subject,
        driver: Driver,
        head: GaussianHead,
        tensors: Mapping[str, Tensor],
        corrected: RefinedTracking | None,
    ):
        self._files, self._driver, self._head = files, driver, head
        self.subject = subject
        self._tensors, self._corrected = tensors, corrected
        self._last = LastPose(self._computed)
        self._ground = tensors["background"].cpu().numpy()
        with torch.no_grad():
            self._inputs = head.inputs(tensors)

    @classmethod
    def read(cls, folder: Path, device: str) -> GHAAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or incompatible files."""
        content_of, coded = partial(avatar_of, device=device), partial(read_coded, layout=networks)
        files, shared, subject, (head, tensors) = read_stored(folder, AVATAR_FILE, content_of, coded)
        driver = Driver(
            *(shared, subject.shape, subject.static_offset),
            origin=tensors["origin"].cpu().numpy(),
            unit=head.config.unit,
            expression_scale=tensors["expression_scale"].cpu(),
            device="cpu",
            center=tensors["center"].cpu().numpy(),
        )
        driving = folder / DRIVING_FILE
        corrected = RefinedTracking.read(driving) if driving.exists() else None
        return cls(files, subject, driver, head, tensors, corrected)

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model.

        Super-resolution only produces the training background; the difference to the requested one is added where it is visible
        behind the splats.
        """
        trained = self._tensors["background"]
        with torch_on_one_thread(bool(instruction_sets())):
            drawn = self._head.draw(self._posed(pose), camera, trained)
            image = self._head.sharpen(self._tensors, drawn, trained, bounded=True)
        image = image[: camera.height, : camera.width]
        alpha = drawn.alpha
        if self._head.config.upscale > 1:
            size = [side * self._head.config.upscale for side in alpha.shape]
            alpha = F.interpolate(alpha[None, None], size, mode="bilinear", align_corners=False)[0, 0]
        alpha = alpha[: camera.height, : camera.width].clamp(0, 1)
        other = np.asarray([float(channel) for channel in background], np.float32) - self._ground
        if other.any():
            image = image + (1 - alpha)[..., None] * to_device(torch.from_numpy(other), image.device)
        return read_back(Drawn(image.clamp(0, 1), alpha.contiguous()))

    @torch.no_grad()
    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """See `splat_depth`; super-resolution does not move image content."""
        splats = self._posed(pose)
        world = splats.world._replace(quats=F.normalize(splats.world.quats, dim=1))
        return splat_depth(world, splats.opacities, camera, str(world.means.device))

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world with their colours before super-resolution, which do not depend on the view."""
        splats = self._posed(pose)
        colors = None if camera is None else splats.features[:, :3].clamp(0, 1)
        world = splats.world._replace(quats=F.normalize(splats.world.quats, dim=1))
        return posed_splats(world, splats.opacities, colors)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Gaussians by the expression alone, with the head at rest; colours as in `splats`."""
        code = self._driver.signals(self._driver.arguments([pose]))[0]
        points = self._tensors["points"]
        rest = HeadMotion(torch.eye(3), torch.zeros(3), torch.zeros(POSE_SIZE), torch.eye(4)[0])
        signal = code._replace(expression=code.expression.to(points))
        motion = HeadMotion(*(part.to(points) for part in rest))
        found = self._head.splats(self._tensors, signal, motion, inputs=self._inputs)
        values = {"position": 1000 * found.world.means, "opacity": found.opacities}
        return changes_of({**values, "color": found.features[:, :3].clamp(0, 1)})

    def files(self) -> Sequence[Path]:
        """The tensors and the subject."""
        return self._files

    @property
    def codec(self) -> str:
        """The codec of the files, see `CodedAvatar`."""
        return codec_of(self._files)

    def _posed(self, pose: HeadPose) -> FeatureSplats:
        return self._last(pose if self._corrected is None else self._corrected(pose), no_stage)

    def _computed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> FeatureSplats:
        signal = self._driver.signals(self._driver.arguments([pose]))[0]
        motion = self._driver.motion(signal)
        # One vector, so that one copy takes it to a device.
        parts = signal.expression, *motion
        numbers = to_device(torch.cat([part.flatten() for part in parts]), self._tensors["points"].device)
        sent = numbers.split([part.numel() for part in parts])
        expression, *moved = (values.view(part.shape) for values, part in zip(sent, parts))
        signal, motion = signal._replace(expression=expression), HeadMotion(*moved)
        return self._head.splats(self._tensors, signal, motion, inputs=self._inputs)


CONFIG = "config"
"""Key of the file's metadata: the settings of rendering, as JSON."""

RENDERING = (
    "unit",
    "near_squared",
    "far_squared",
    "features",
    "channels",
    "expression_color_hidden",
    "pose_color_hidden",
    "expression_deform_hidden",
    "pose_deform_hidden",
    "expression_attribute_hidden",
    "pose_attribute_hidden",
    "sr_widths",
    "residual",
    "displacement_scale",
    "attribute_scale",
)
"""Settings that affect rendering."""


def write_avatar(path: Path, config: GHAConfig, tensors: Mapping[str, Tensor]) -> None:
    """Write the tensors of points, networks and landmarks, and the small ones.

    Points with features are one (N, 11 + F) table. The small tensors are ``origin`` and ``center`` (3,), metres;
    ``background`` (3,), the training background; ``expression_scale`` (E,), divisors of the expression code; and
    ``code_low`` and ``code_high`` (E,), the bounds of the code for colours and attributes.
    """
    table = torch.cat(
        [tensors[name].reshape(len(tensors["points"]), -1) for name in (*POINTS, "features")], 1
    )
    kept = {name: value for name, value in tensors.items() if name not in (*POINTS, "features")}
    kept["table"] = table
    write_tensors(path, kept, {CONFIG: settings_text(config, RENDERING)})


def avatar_of(
    path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], shared: HeadAsset, device: str
) -> tuple[GaussianHead, dict[str, Tensor]]:
    """The networks, and their tensors and those of the points, of a file that `write_avatar` wrote.

    Raises `InputError` if a tensor is missing, does not fit the settings, or is not finite float32.
    """
    size = code_size(shared)
    config = settings_of_text(GHAConfig, RENDERING, metadata.get(CONFIG, ""), path, CONFIG)
    head = GaussianHead.of(config, size)
    return head, _checked(path, tensors, head, size, device)


TABLE = "table"
"""Name of the table of the points with their features."""
OF_CODE = ("expression_scale", "code_low", "code_high")


def _shapes(head: GaussianHead, expression_size: int) -> dict[str, tuple[int | None, ...]]:
    """Shapes of the stored tensors; None for any size."""
    shapes: dict[str, tuple[int | None, ...]] = {
        **head.shapes(),
        "landmarks": (None, 3),
        TABLE: (None, sum(POINTS.values()) + head.config.features),
    }
    shapes |= dict.fromkeys(("origin", "center", "background"), (3,))
    return shapes | dict.fromkeys(OF_CODE, (expression_size,))


def _checked(
    path: Path, tensors: dict[str, Tensor], head: GaussianHead, expression_size: int, device: str
) -> dict[str, Tensor]:
    """The stored tensors in the form that the avatar uses. Raises `InputError` for the first inconsistent one."""
    shapes = _shapes(head, expression_size)
    members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in shapes.items()}
    # Without bounds of the code, these are float32's largest numbers.
    members |= dict.fromkeys(("code_low", "code_high"), Member("f", (expression_size,), dtype="f4"))
    check_tensors(path, tensors, members)
    if not len(tensors["landmarks"]) or not (tensors["expression_scale"] > 0).all():
        raise InputError(path, "landmarks, expression_scale", "at least one; above 0", "none, or not above 0")
    tensors = {name: tensors[name].to(device) for name in shapes}
    table = tensors.pop(TABLE).split([*POINTS.values(), head.config.features], dim=1)
    for name, column in zip((*POINTS, "features"), table):
        tensors[name] = (column[:, 0] if name == "opacities" else column).contiguous()
    check_sizes(path, tensors["log_scales"])
    return tensors
