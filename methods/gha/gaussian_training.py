"""The Gaussian phase: training of points, networks, super-resolution and head poses on single images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ...bench.contracts import Camera
from ...bench.errors import InputError
from ...bench.native.dispatch import to_device
from ..ops.photometric import photometric_loss
from ..ops.splats import unturned
from ..shared.loop import TrainingImages
from ..shared.optimisation import Optimiser, OptimiserState, logit
from ..shared.schedule import Sampler, Timeline, torch_generator
from .driving import POSE_SIZE, NearestLandmarks, Signal, TrainingScene, mouth_box
from .gaussian_head import FeatureImage, GaussianHead, feature_background
from .mesh_head import MeshHead, NeutralSurface, Weights
from .mesh_training import TrackedMotion, grid_about
from .spec import GHAConfig

NEIGHBOURS = 3
SMALLEST_SQUARED = 1e-7
"""Minimum squared distance to neighbours for initial scales."""
ZOOM = (0.8, 1.25)
"""Range of the random rescaling before super-resolution."""
ALMOST_ONE = 1 - 1e-6
"""Features of the mesh are clamped to this, so that their inverse tanh is finite."""


class GaussianTraining(OptimiserState):
    """A `Trainable` that starts from a trained mesh head; ``mesh`` has its network tensors and landmarks."""

    def __init__(
        self, scene: TrainingScene, head: GaussianHead, mesh_head: MeshHead, mesh: Weights, sampler: Sampler
    ):
        self._scene, self._head = scene, head
        config = self._config = head.config
        self._images = TrainingImages(scene.clip, scene.keys, sampler, scene.device)
        initial = first_points(scene, config, mesh_head, mesh)
        self._rates = {
            "points": config.position_lr,
            "features": config.feature_lr,
            "log_scales": config.scale_lr,
            "quats": config.rotation_lr,
            "opacities": config.opacity_lr,
            "corrections": config.correction_lr,
        }
        generator = torch_generator(scene.seed, "gha-gaussians")
        for network in head.controllers.of_gaussians:
            initial |= network.initial(generator, scene.device)
        initial |= head.super_resolution.initial(generator, scene.device)
        for network in head.controllers.of_mesh:
            initial |= {name: mesh[name].detach().clone() for name in network.shapes()}
        initial["corrections"] = torch.zeros(len(scene.timesteps), POSE_SIZE, device=scene.device)
        for name in initial:
            self._rates.setdefault(name, config.network_lr)
        self._fixed = {
            "landmarks": mesh["landmarks"].detach().clone(),
            "code_low": scene.code_low,
            "code_high": scene.code_high,
        }
        self._nearest = NearestLandmarks(self._fixed["landmarks"], config.near_squared, config.far_squared)
        self._motion = TrackedMotion.of(scene, config) if config.motion_weight else None
        self.optimiser = Optimiser({name: nn.Parameter(v) for name, v in initial.items()}, self._rates)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the avatar: points, networks and landmarks."""
        names = [name for name in self._rates if name != "corrections"]
        landmarks = self._fixed["landmarks"]
        return {**{name: self.optimiser[name].detach() for name in names}, "landmarks": landmarks}

    def begin(self, timeline: Timeline) -> None:
        """Scale schedules to the length of the run."""
        self._timeline = timeline

    def loss(self, iteration: int, index: int) -> Tensor:
        """L1 at the splatted size, L1 and SSIM at full size."""
        scene, head, config = self._scene, self._head, self._config
        key = scene.keys[index]
        row = scene.row[key.timestep]
        view = scene.views[key.camera]
        target = self._images.get(iteration, index)
        tensors = {**{name: self.optimiser[name] for name in self._rates}, **self._fixed}
        signal = scene.signals[row]
        motion = scene.driver.motion(signal, self.optimiser["corrections"][row])
        inputs = head.inputs(tensors, self._nearest(tensors["points"]))
        splats = head.splats(tensors, signal, motion, self._noise(signal, iteration), inputs)
        drawn = head.draw(splats, view.camera, scene.background)
        padded = _padded(target, view.camera, config.upscale, scene.background)
        small = reduced(padded, config.upscale, config.low_image_variant)
        loss = config.low_weight * (drawn.colors - small).abs().mean()
        if config.augment:
            draws = torch.rand(3, generator=torch_generator(scene.seed, "gha-zoom", iteration)).tolist()
            zoom = Zoom.of(drawn.alpha.shape, draws)
            drawn, padded = zoomed(drawn, padded, zoom, scene.background)
        image = head.sharpen(tensors, drawn, scene.background)
        whole = 1 + config.structure_weight
        loss = loss + whole * photometric_loss(image, padded, config.structure_weight / whole)
        if self._motion is not None:
            network, generator = (
                head.controllers.expression_deform,
                torch_generator(scene.seed, "gha-motion", iteration),
            )
            loss = loss + config.motion_weight * self._motion.error(network, tensors, generator)
        return loss

    def _noise(self, signal: Signal, iteration: int) -> Tensor | None:
        """(E,) noise on the expression code of colour and attributes, if configured."""
        if not self._config.expression_noise:
            return None
        generator = torch_generator(self._scene.seed, "gha-expression", iteration)
        noise = to_device(torch.randn(len(signal.expression), generator=generator), signal.expression.device)
        return self._config.expression_noise * noise

    def after_backward(self, iteration: int) -> None:
        """Learning rates over the last half of a short run."""
        decay = self._timeline.decay(iteration, self._config.final_rate)
        for name, rate in self._rates.items():
            self.optimiser.set_learning_rate(name, decay * rate)

    def note(self) -> str:
        """Number of Gaussians."""
        return f"{len(self.optimiser['points'])} Gaussians"

    def close(self) -> None:
        """Stop background work."""
        self._images.close()


@torch.no_grad()
def first_points(
    scene: TrainingScene, config: GHAConfig, mesh_head: MeshHead, mesh: Weights
) -> dict[str, Tensor]:
    """Gaussians on the neutral surface of the mesh phase, with its features, and some inside the mouth."""
    device = scene.device
    grid = grid_about(scene.rest, config, device, finer=2 if config.subdivide else 1)
    surface: NeutralSurface = mesh_head.surface(mesh, grid)
    if not len(surface.vertices):
        raise InputError(
            f"clip of {scene.clip.subject}",
            "mesh phase",
            "a surface",
            "none: the signed distance has one sign all over",
            "Train longer, or start from the tracked mesh (start=mesh).",
        )
    points, features = surface.vertices, surface.features
    if config.max_points is not None and len(points) > config.max_points:
        order = torch.randperm(len(points), generator=torch_generator(scene.seed, "gha-thin"))
        rows = order[: config.max_points].sort().values.to(device)
        points, features = points[rows], features[rows]
    lips = scene.clip.head.regions.get("lips")
    if lips is not None and config.mouth_points:
        center, half = mouth_box(scene.rest[torch.tensor(np.asarray(lips))].cpu().double().numpy())
        draws = torch.rand(config.mouth_points, 3, generator=torch_generator(scene.seed, "gha-mouth"))
        inside = torch.as_tensor(center + half * (2 * draws.double().numpy() - 1)).to(points)
        points = torch.cat([points, inside])
        features = torch.cat([features, features.new_zeros(len(inside), features.shape[1])])
    places = points.cpu().double().numpy()
    distances = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(places)))[0].reshape(len(places), -1)
    squared = np.maximum(np.square(distances[:, 1:]).mean(1), SMALLEST_SQUARED)
    return {
        "points": points,
        "features": torch.atanh(features.clamp(-ALMOST_ONE, ALMOST_ONE)),
        "log_scales": torch.as_tensor(0.5 * np.log(squared)).to(points)[:, None].repeat(1, 3),
        "quats": unturned(len(points)).to(device),
        "opacities": torch.full((len(points),), logit(config.initial_opacity), device=device),
    }


def reduced(image: Tensor, factor: int, variant: str) -> Tensor:
    """(h, w, 3) of a (u h, u w, 3) image: area means, or for "official" the first pixel of each block."""
    if variant == "official":
        return image[::factor, ::factor]
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.view(height, factor, width, factor, 3).mean((1, 3))


class Zoom(NamedTuple):
    """A rescaling of the splatted image, and the position of the crop or of the padded image, in whole pixels."""

    factor: float  # factor for both sides; the height is a whole number of pixels, as published
    size: tuple[int, int]  # rows and columns of the rescaled image
    start: tuple[int, int]  # first row and column of the crop; negative for the position of a smaller image

    @classmethod
    def of(cls, shape: Sequence[int], draws: Sequence[float]) -> Zoom:
        """From three numbers in [0, 1) for the factor within `ZOOM`, the row and the column."""
        height, width = shape
        factor = int(height * (ZOOM[0] + (ZOOM[1] - ZOOM[0]) * draws[0])) / height
        size = (round(height * factor), int(width * factor))
        start = [
            (1 if after >= before else -1) * int(draw * (abs(after - before) + 1))
            for before, after, draw in zip((height, width), size, draws[1:], strict=True)
        ]
        return cls(factor, size, (start[0], start[1]))


def zoomed(
    drawn: FeatureImage, target: Tensor, zoom: Zoom, background: Tensor
) -> tuple[FeatureImage, Tensor]:
    """Feature image and ground truth rescaled alike, and cropped or padded to their original size.

    Uses the nearest pixel, as published; padding is the (3,) ``background``.
    """
    upscale = target.shape[0] // drawn.alpha.shape[0]
    outside = feature_background(background, drawn.features.shape[2])
    features = _zoomed(drawn.features, zoom, 1, outside)
    alpha = _zoomed(drawn.alpha[..., None], zoom, 1, drawn.alpha.new_zeros(1))[..., 0]
    return FeatureImage(features, alpha), _zoomed(target, zoom, upscale, background)


def _zoomed(values: Tensor, zoom: Zoom, upscale: int, outside: Tensor) -> Tensor:
    """The (H, W, C) image, padded with (C,) ``outside``."""

    def places(size: int, rescaled: int, start: int) -> tuple[Tensor, Tensor]:
        place = torch.arange(size, device=values.device) + upscale * start
        inside = (place >= 0) & (place < upscale * rescaled)
        return (place / zoom.factor).floor().long().clamp(0, size - 1), inside

    (rows, rows_in), (columns, columns_in) = (
        places(*axis) for axis in zip(values.shape[:2], zoom.size, zoom.start, strict=True)
    )
    moved = values.index_select(0, rows).index_select(1, columns)
    return torch.where((rows_in[:, None] & columns_in)[..., None], moved, outside)


def _padded(image: Tensor, camera: Camera, upscale: int, background: Tensor) -> Tensor:
    """(u h, u w, 3): the image padded with background at the right and below to whole pixels of the feature image."""
    right, below = -camera.width % upscale, -camera.height % upscale
    if not right and not below:
        return image
    padded = background.expand(camera.height + below, camera.width + right, 3).clone()
    padded[: camera.height, : camera.width] = image
    return padded
