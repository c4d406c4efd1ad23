"""Gaussian Head Avatar: Gaussians moved and coloured by networks, drawn as features, enlarged by super-resolution.

Xu et al., "Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians", CVPR 2024.

There are two phases. A mesh head (signed distance in a tetrahedral grid, networks for motion and colour) gives neutral
points with features. Gaussians start from these, keep the networks, and get a super-resolution network. The budget is
divided between the phases as published.

Differences from the paper: the tracked head model replaces the published face model (`driving`), the mesh is drawn
with discs (`mesh_head.vertex_discs`), 1 - SSIM replaces LPIPS (`GHAConfig.structure_weight`), and pixels far from
drawn ones are background. Short presets scale with the capture (`presets`), without resizing it, and fit the
deformation to the head model's (`tracked_motion`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import (
    Budget,
    Camera,
    Changes,
    FloatArray,
    Frame,
    HeadAsset,
    HeadPose,
    Progress,
    no_stage,
)
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.native.dispatch import to_device
from ..avatars.compact.coder import codec_of
from ..avatars.compact.layouts import networks, read_coded
from ..shared.avatar_files import (
    AVATAR_FILE,
    TRACKED,
    RefinedTracking,
    Subject,
    finish_fit,
    read_stored,
    settings_of_text,
    settings_text,
)
from ..shared.loop import Fit, TrainingSummary, train
from ..shared.method import TrainedMethod
from ..shared.rendering import Drawn, LastPose, PosedSplats, changes_of, posed_splats, read_back, splat_depth
from ..shared.schedule import ShuffledEpochs
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, write_tensors
from ..shared.threads import torch_on_one_thread
from ..splats.cpu import instruction_sets
from .driving import POSE_SIZE, Driver, HeadMotion, TrainingScene, code_size, training_scene
from .gaussian_head import POINTS, FeatureSplats, GaussianHead
from .gaussian_training import GaussianTraining
from .mesh_head import MeshHead
from .mesh_training import mesh_phase, remove_mesh_phase
from .spec import GHA as SPEC
from .spec import GHAConfig

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
        """Read an avatar from its folder."""
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
        """Render one frame.

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
        splats = self._head.splats(self._tensors, signal, motion, inputs=self._inputs)
        values = {"position": 1000 * splats.world.means, "opacity": splats.opacities}
        return changes_of({**values, "color": splats.features[:, :3].clamp(0, 1)})

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
    """The networks, and their tensors and those of the points, of a file that `write_avatar` wrote."""
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
    """The stored tensors in the form that the avatar uses."""
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


class GHA(TrainedMethod[GHAConfig, GHAAvatar]):
    """See the module docstring.

    ``clock``: clock in seconds with any origin, for budgets in seconds.
    """

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GHAConfig, GHAAvatar

    def __init__(self, config: GHAConfig | None = None, clock: Callable[[], float] = time.monotonic):
        super().__init__(config)
        self._clock = clock

    def _train(self, fit: Fit, config: GHAConfig) -> None:
        with torch_on_one_thread(bool(instruction_sets())):
            self._train_phases(fit, config)

    def _train_phases(self, fit: Fit, config: GHAConfig) -> None:
        clip, out = fit.clip, fit.out
        scene = training_scene(clip, config, fit.device, fit.seed)
        size = len(scene.signals[0].expression)
        mesh_head, head = MeshHead.of(config, size), GaussianHead.of(config, size)
        first, second = parted(fit.budget, config.mesh_fraction)
        progress = _phase_progress(fit.progress, 0, second.iterations or 0)
        mesh = mesh_phase(scene, mesh_head, replace(fit, budget=first, progress=progress))
        sampler = ShuffledEpochs(len(scene.keys), fit.seed)
        began = fit.clock()
        training = GaussianTraining(scene, head, mesh_head, mesh.tensors, sampler)
        budget = within(second, fit.budget, mesh.seconds)
        progress = _phase_progress(fit.progress, mesh.iterations, 0)
        try:
            summary = train(
                training,
                sampler,
                replace(fit, began=began, budget=budget, progress=progress),
                published_length=round(config.schedule_length * (1 - config.mesh_fraction)),
                checkpoint_every_s=config.checkpoint_every_s,
            )
        finally:
            training.close()
        tensors = training.tensors()
        write_avatar(out / AVATAR_FILE, config, {**tensors, **scene.frame()})
        corrected(scene, training.optimiser["corrections"].detach()).save(out / DRIVING_FILE)
        whole = TrainingSummary(
            mesh.iterations + summary.iterations,
            mesh.iterations + summary.planned,
            mesh.seconds + summary.seconds,
            [(mesh.iterations + at, value) for at, value in summary.losses],
        )
        counts = {"splats": len(tensors["points"]), "mesh_iterations": mesh.iterations}
        finish_fit(fit, whole, Subject.of(clip), clip.head, **counts)

    def _remove_training_files(self, out: Path) -> None:
        super()._remove_training_files(out)
        remove_mesh_phase(out)


def _phase_progress(progress: Progress, before: int, after: int) -> Progress:
    """Progress of one phase as part of the total progress."""

    def report(done: int, total: int, note: str = "") -> None:
        progress(before + done, before + total + after, note)

    return report


def parted(budget: Budget, fraction: float) -> tuple[Budget, Budget]:
    """The budgets of the mesh phase and the Gaussian phase, at least one iteration each."""
    first, second = {}, {}
    if budget.iterations is not None:
        first["iterations"] = max(1, round(fraction * budget.iterations))
        second["iterations"] = max(1, budget.iterations - first["iterations"])
    seconds = budget.seconds
    if seconds is None:
        return Budget(**first), Budget(**second)
    return Budget(**first, seconds=fraction * seconds), Budget(**second, seconds=(1 - fraction) * seconds)


def within(part: Budget, whole: Budget, spent: float) -> Budget:
    """The budget of a phase, limited to the remaining seconds of the total after ``spent``; at least a millisecond."""
    if part.seconds is None or whole.seconds is None:
        return part
    return replace(part, seconds=min(part.seconds, max(whole.seconds - spent, 1e-3)))


def corrected(scene: TrainingScene, corrections: Tensor) -> RefinedTracking:
    """The tracking of the training timesteps with (T, 6) learned corrections of rotation and translation."""
    before = {name: scene.tracked[name].cpu().numpy() for name in TRACKED}
    turn, shift = corrections.cpu().split(3, dim=1)
    after = dict(before)
    after["rotation"] = (scene.tracked["rotation"].cpu() + turn).numpy()
    after["translation"] = (scene.tracked["translation"].cpu() + shift).numpy()
    return RefinedTracking(scene.clip.subject, np.array(scene.timesteps), before, after)
