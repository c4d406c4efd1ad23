"""INSTA: Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023, arXiv 2211.12499.

The field is trained on rays of several images; their number is adapted to the number of samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ...bench.contracts import Clip, FrameKey
from ...bench.errors import InputError
from ...bench.io.files import write_json
from ..shared.avatar_files import Subject, finish_fit
from ..shared.loop import Fit, recomposited, train
from ..shared.method import TrainedMethod
from ..shared.optimisation import Optimiser
from ..shared.schedule import ShuffledEpochs, Timeline, numpy_generator
from ..shared.surface_points import BoundedCache, SubjectMesh, pose_key
from .avatar import FIELD_FILE, SETTINGS_FILE, InstaAvatar, write_field
from .field import Architecture, Prior, RadianceField
from .marching import (
    CanonicalSurface,
    PosedSurface,
    Space,
    bare_triangles,
    canonical_surface,
    mouth_triangles,
)
from .occupancy import (
    Marching,
    Occupancy,
    PosedRays,
    Rendered,
    box_corners,
    camera_rays,
    pixels_of_hull,
    render_rays,
)
from .spec import INSTA as SPEC
from .spec import InstaConfig

RAYS_MIN, RAYS_MAX = 64, 1 << 18


class Batch(NamedTuple):
    """Rays of one iteration and their targets."""

    scenes: list[PosedRays]
    image: Tensor  # (R, 3) in [0, 1]
    coverage: Tensor  # (R, 1)
    mouth: Tensor  # (R,) bool
    depth: Tensor  # (R,) metres along the ray, infinite where unknown


class InstaTraining:
    """A `Trainable`. The loop's index is the first image of an iteration; the others are drawn at random."""

    def __init__(
        self,
        clip: Clip,
        mesh: SubjectMesh,
        surface: CanonicalSurface,
        config: InstaConfig,
        device: str,
        seed: int,
    ):
        self._clip, self._mesh, self._surface = clip, mesh, surface
        self._config, self._device, self._seed = config, device, seed
        self.keys: Sequence[FrameKey] = clip.splits["train"]
        self.occupancy = Occupancy(surface, config)
        architecture = Architecture.of(config, mesh.model.expression_size)
        self.field = RadianceField(architecture, self.occupancy.box(device), Prior.of(config))
        initial = architecture.initial(seed)
        self._optimiser = Optimiser(
            {name: nn.Parameter(value.to(device)) for name, value in initial.items()},
            dict.fromkeys(initial, config.learning_rate),
            betas=config.betas,
        )
        self._names = tuple(initial)
        self._mean = {name: torch.zeros_like(self._optimiser[name]) for name in self._names}
        self._steps = 0
        self._rays = max(config.first_rays, RAYS_MIN)
        self.mouth = mouth_triangles(clip.head)
        self._bare = bare_triangles(clip.head)
        self._ground = torch.tensor(np.asarray(clip.background), dtype=torch.float32)
        self._marching = Marching(config.step, config.round_samples, config.stop_transmittance)
        self._masked = clip.mask(self.keys[0]) is not None
        cameras = [clip.cameras[key.camera] for key in self.keys]
        image_bytes = 4 * max(camera.width * camera.height for camera in cameras)
        self._images = BoundedCache(self._image, max(1, config.image_cache_mb * 2**20 // image_bytes))
        # Frames of one timestep often share their pose; so do frames of a video made of several views.
        self._alike: dict[bytes, int] = {}
        pose_bytes = 2 * surface.rest.bytes
        self._poses = BoundedCache(self._posed, max(1, config.mesh_cache_mb * 2**20 // pose_bytes))
        self._space = self.occupancy.space()

    @property
    def optimiser(self) -> Optimiser:
        """Adam over everything trained."""
        return self._optimiser

    @property
    def space(self) -> Space:
        """Currently sampled cells."""
        return self._space

    def parameters(self) -> dict[str, Tensor]:
        """The avatar's tensors: the running mean of the parameters."""
        if not self._steps or not self._config.ema:
            return {name: self._optimiser[name].detach() for name in self._names}
        missing = 1 - self._config.ema**self._steps
        return {name: mean / missing for name, mean in self._mean.items()}

    def begin(self, timeline: Timeline) -> None:
        """Scale schedules to the length of the run."""
        self._timeline = timeline

    def loss(self, iteration: int, index: int) -> Tensor:
        """Colour and depth loss of one iteration's rays."""
        config = self._config
        batch = self._batch(iteration, index)
        rendered = self.render(batch.scenes)
        drawn = numpy_generator(self._seed, "backgrounds", iteration).random((len(batch.image), 3))
        # Without a mask the recorded background is part of the image and has to be rendered.
        random = torch.from_numpy(drawn.astype(np.float32))
        background = random if self._masked else self._ground.expand_as(random)
        target = target_colors(batch.image, batch.coverage, self._ground, background, config)
        device = rendered.color.device
        color = rendered.color + rendered.transmittance[:, None] * background.to(device)
        weighted = iteration >= self._timeline.at(config.mouth_from)
        weights = torch.where(batch.mouth & weighted, config.mouth_weight, 1.0)
        loss = color_loss(color, target.to(device), weights.to(device), config.huber)
        if not rendered.samples:  # no ray hits the head: nothing to learn, and no error
            loss = loss + 0.0 * self._optimiser[self._names[-1]].sum()
        if config.opacity_weight:
            loss = loss + config.opacity_weight * rendered.opacity_sum / len(batch.image)
        if config.depth_weight:
            loss = loss + config.depth_weight * depth_loss(rendered.distance, batch.depth.to(device))
        self._seen = rendered.samples
        return loss

    def render(self, scenes: Sequence[PosedRays]) -> Rendered:
        """March rays through the current field."""
        parameters = {name: self._optimiser[name] for name in self._names}
        return render_rays(self.field, parameters, scenes, self._space, self.mouth, self._marching)

    def after_backward(self, iteration: int) -> None:
        """Update weight decay, running mean, learning rate, number of rays, and the occupancy grid when it is due."""
        config = self._config
        with torch.no_grad():
            for name in self._names:
                value = self._optimiser[name]
                if name != "table" and value.grad is not None:
                    value.grad.add_(value, alpha=config.weight_decay)
                self._mean[name].lerp_(value, 1 - config.ema)
        self._steps += 1
        decay = self._timeline.decay(iteration, config.final_rate)
        for name in self._names:
            self._optimiser.set_learning_rate(name, decay * config.learning_rate)
        wanted = self._rays * config.samples_per_iteration / max(self._seen, 1)
        # Changes are limited to half, since an iteration may have few samples by chance.
        self._rays = int(np.clip(wanted, max(self._rays / 2, RAYS_MIN), min(self._rays * 1.5, RAYS_MAX)))
        if iteration % config.occupancy_every == 0:
            self._refresh(iteration)

    def state(self) -> dict[str, Any]:
        """Parameters, moments, running means, occupancy and number of rays."""
        return {
            "optimiser": self._optimiser.state(),
            "mean": self._mean,
            "steps": self._steps,
            "rays": self._rays,
            "occupancy": self.occupancy.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self._optimiser.load_state(state["optimiser"])
        self._mean = {name: state["mean"][name].to(self._device) for name in self._names}
        self._steps, self._rays = state["steps"], state["rays"]
        self.occupancy.load_state(state["occupancy"])
        self._space = self.occupancy.space()

    def note(self) -> str:
        """Number of rays, and occupied fraction of the grid."""
        return f"{self._rays} rays; {self.occupancy.occupied.mean():.0%} of the shell"

    def _refresh(self, iteration: int) -> None:
        key = self.keys[int(numpy_generator(self._seed, "expression", iteration).integers(len(self.keys)))]
        condition = torch.tensor(np.asarray(self._clip.poses[key.timestep].expression), dtype=torch.float32)
        parameters = {name: self._optimiser[name].detach() for name in self._names}
        whole = iteration <= self._config.occupancy_whole
        self.occupancy.refresh(
            self.field, parameters, condition, self.mouth, self._seed, iteration, whole=whole
        )
        self._space = self.occupancy.space()

    def _batch(self, iteration: int, index: int) -> Batch:
        generator = numpy_generator(self._seed, "rays", iteration)
        count = min(self._config.images_per_iteration, len(self.keys), self._rays)
        others = generator.choice(len(self.keys), size=count - 1, replace=False)
        parts = [self._rays_of(int(chosen), self._rays // count, generator) for chosen in (index, *others)]
        scenes, *columns = zip(*parts)
        return Batch(list(scenes), *(torch.cat(column) for column in columns))

    def _rays_of(
        self, index: int, count: int, generator: np.random.Generator
    ) -> tuple[PosedRays, Tensor, Tensor, Tensor, Tensor]:
        key = self.keys[index]
        camera, pose = self._clip.cameras[key.camera], self._clip.poses[key.timestep]
        surface = self._poses(self._alike.setdefault(pose_key(pose), key.timestep))
        # Other pixels cannot show the head and have no gradient.
        corners = box_corners(surface.vertices.numpy(), max(float(surface.reach(self._space).max()), 0.0))
        left, top, right, bottom = pixels_of_hull(camera, corners)
        columns = generator.integers(left, max(right, left + 1), count).clip(0, camera.width - 1)
        rows = generator.integers(top, max(bottom, top + 1), count).clip(0, camera.height - 1)
        rays = camera_rays(camera, columns, rows, generator.random(count))
        image, mask = self._images(index)
        colors = torch.from_numpy(image[rows, columns].astype(np.float32) / 255)
        covered = np.full(count, 255) if mask is None else mask[rows, columns]
        coverage = torch.from_numpy(covered.astype(np.float32)[:, None] / 255)
        hits = surface.first_hit(rays)
        hit, triangles = hits.triangles >= 0, hits.triangles.clamp_min(0)
        bare = hit & self._bare[triangles] & (coverage[:, 0] > 0.001)
        depth = torch.where(bare, hits.values, torch.inf)
        expression = torch.tensor(np.asarray(pose.expression), dtype=torch.float32)
        return PosedRays(surface, expression, rays), colors, coverage, hit & self.mouth[triangles], depth

    @torch.no_grad()
    def _posed(self, timestep: int) -> PosedSurface:
        return self._surface.pose(self._mesh.posed(self._mesh.arguments([self._clip.poses[timestep]])))

    def _image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        key = self.keys[index]
        camera, image, mask = self._clip.cameras[key.camera], self._clip.image(key), self._clip.mask(key)
        size = (camera.height, camera.width)
        if image.shape != (*size, 3) or image.dtype != np.uint8:
            found = f"{image.dtype} of shape {image.shape}"
            raise InputError(str(key), "image", f"uint8 of shape {(*size, 3)}", found)
        if (mask is not None) != self._masked:
            expected, found = ("a mask", "none") if self._masked else ("none", "a mask")
            raise InputError(str(key), "mask", f"{expected}, as the first training frame has", found)
        if mask is not None and (mask.shape != size or mask.dtype != np.uint8):
            found = f"{mask.dtype} of shape {mask.shape}"
            raise InputError(str(key), "mask", f"uint8 of shape {size}", found)
        return image, mask


COLOR_PART = 0.2  # the published program divides the Huber loss by 5


def color_loss(color: Tensor, target: Tensor, weights: Tensor, huber: float) -> Tensor:
    """Weighted mean over (R,) rays of the Huber loss of (R, 3) colours: square below ``huber``, linear above.

    Channels are summed, as in the published program, which gives each its own gradient.
    """
    each = torch.nn.functional.huber_loss(color, target, delta=huber, reduction="none") / huber
    return COLOR_PART * (weights * each.sum(1)).mean()


def depth_loss(distance: Tensor, target: Tensor) -> Tensor:
    """Mean over (R,) rays of the distance, metres, between expected and true depth; rays without have infinity."""
    measured = target.isfinite()
    return (distance - torch.where(measured, target, distance.detach())).abs().mean()


def target_colors(
    image: Tensor, coverage: Tensor, recorded_on: Tensor, background: Tensor, config: InstaConfig
) -> Tensor:
    """Colours of (R, 3) pixels with (R, 1) coverage on another background than the recorded one."""
    if config.target_variant == "official":
        colors = (image - (1 - coverage) * recorded_on).clamp(0, 1) / coverage.clamp_min(1 / 255)
        mixed = coverage * to_linear(colors.clamp(0, 1)) + (1 - coverage) * to_linear(background)
        return to_srgb(mixed)
    return recomposited(image, coverage, recorded_on, background)


def to_linear(srgb: Tensor) -> Tensor:
    """Linear light of display-referred sRGB (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Tensor) -> Tensor:
    """Inverse of `to_linear`."""
    bright = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, bright)


class Insta(TrainedMethod[InstaConfig, InstaAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = InstaConfig, InstaAvatar
    draws_splats = False

    def _use(self, device: str) -> None:
        """Raise `InputError` for any device but the CPU; docs/explanation/methods/insta.md says why."""
        if not SPEC.computes_on(device):
            remedy = "Train and render it with device=cpu."
            raise InputError(f"method {self.name}", "device", " or ".join(SPEC.devices), repr(device), remedy)

    def _train(self, fit: Fit, config: InstaConfig) -> None:
        clip, subject = fit.clip, Subject.of(fit.clip)
        mesh = SubjectMesh(clip.head, subject.shape, subject.static_offset, "cpu")
        surface = canonical_surface(clip.head, mesh, config)
        training = InstaTraining(clip, mesh, surface, config, fit.device, fit.seed)
        outcome = train(
            training,
            ShuffledEpochs(len(training.keys), fit.seed),
            fit,
            published_length=config.schedule_length,
            checkpoint_every_s=config.checkpoint_every_s,
        )
        write_field(fit.out / FIELD_FILE, training.parameters(), training.space.occupied)
        write_json(fit.out / SETTINGS_FILE, asdict(config))
        occupied = int(training.space.occupied.sum())
        finish_fit(fit, outcome, subject, clip.head, occupied_cells=occupied)
