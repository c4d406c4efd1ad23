"""Training of RGBAvatar: batches of images, colours taken from them at the start, blendshapes that join later."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Clip, FrameKey
from ...bench.native.dispatch import to_device
from ..ops.harmonics import C0
from ..ops.photometric import photometric_loss
from ..ops.splats import WorldSplats, unturned
from ..shared.avatar_files import clip_mesh
from ..shared.image_training import ImageTrainer, Initial
from ..shared.loop import recomposited
from ..shared.networks import initial_network, tracked_inputs
from ..shared.optimisation import logit
from ..shared.rendering import View, rasterize_view
from ..shared.schedule import Batches, GroupedBatches, log_linear, numpy_generator
from ..shared.subject_mesh import BoundedCache, TrainingPoses
from ..shared.surface_points import spread_points
from .config import RGBAvatarConfig
from .model import (
    BIASES,
    SHAPES,
    WEIGHTS,
    PointsOfPose,
    StoredShapes,
    Surface,
    blend_weights,
    blended,
    seen_colors,
)
from .online import OnlineBatches

PUBLISHED_SAMPLES = 60_000
"""Number of splats for which the published size at the start is given: texels of 256 x 256 that show FLAME, rounded."""


def _batches(keys: Sequence[FrameKey], config: RGBAvatarConfig, seed: int) -> Batches:
    """How images are drawn: in epochs, or as they arrive."""
    if config.online:
        order = sorted(range(len(keys)), key=lambda index: (keys[index].timestep, keys[index].camera))
        return OnlineBatches(order, config.batch, config.trained_per_arrival, seed)
    return GroupedBatches([key.timestep for key in keys], config.batch, config.together, seed)


class RGBAvatarTraining(ImageTrainer):
    """A `Trainable`: neutral splats, their blendshapes, and the network of the weights.

    Attributes
    ----------
    colored : Tensor
        (N,) bool, splats that images have given a colour.
    """

    def __init__(self, clip: Clip, config: RGBAvatarConfig, device: str, seed: int):
        keys = clip.splits["train"]
        batches = _batches(keys, config, seed)
        masks = clip.mask(keys[0]) is not None
        super().__init__(clip, config, batches, device, masks=masks)
        self._sampler = lambda iteration: batches.batch(iteration)[0]
        self._config, self._batches, self._seed, self._masks = config, batches, seed, masks
        mesh = clip_mesh(clip, device)
        faces, vertices = np.asarray(clip.head.faces), mesh.canonical.cpu().numpy().astype(np.float64)
        self.points = spread_points(clip.head, vertices, config.samples, seed, chart=config.uv_chart)
        self._surface = Surface(mesh, self.points)
        self._tracked = TrainingPoses(clip, mesh)
        self._inputs = tracked_inputs(self._tracked.arguments, config.inputs)
        entry = 4 * (17 * len(faces) + 3 * len(self.points.triangles))
        self._surfaces = BoundedCache(self._posed, config.mesh_cache_mb * 2**20 // entry)
        self._optimise(self._initial())
        self.colored = torch.zeros(len(self.points.triangles), dtype=torch.bool, device=device)

    def loss(self, iteration: int, index: int) -> Tensor:
        """Mean loss of the images of a batch; ``index`` is that of the first."""
        self._seen: list[tuple[WorldSplats, Tensor, View, Tensor]] = []
        batch = self._batches.batch(iteration)
        rows = sorted({self._tracked.row[self.keys[image].timestep] for image in batch})
        splats = dict(zip(rows, self._splats(iteration, rows)))
        placed = {
            row: (self._surface.place(self._surfaces(row), splats[row]), seen_colors(splats[row]["colors"]))
            for row in rows
        }
        opacities = self.optimiser["opacities"].sigmoid()
        total = opacities.new_zeros(())
        for position, image in self._batches.positions(iteration):
            key = self.keys[image]
            view, (world, colors) = self._views[key.camera], placed[self._tracked.row[key.timestep]]
            pixels = self._images.get(position, image)
            truth, background = self._on_background(pixels, iteration, image)
            rendering = rasterize_view(world, opacities, colors, view, background)
            total = total + photometric_loss(rendering.image, truth, self._config.ssim_weight)
            self._seen.append((world, opacities, view, pixels))
        return total / len(batch)

    def after_backward(self, iteration: int) -> None:
        """Give colours to splats that are seen for the first time; set the learning rates."""
        config = self._config
        due = config.color_weight > 0 and (iteration - 1) % config.color_every == 0
        if due and not bool(self.colored.all()):
            self._take_colors()
        # While images arrive, time is counted from the first one, whatever the length of the run.
        settles = config.position_settles if config.online else self._timeline.at(config.position_settles)
        rate = log_linear(config.position_lr, config.position_lr_final, iteration / max(settles, 1))
        positions = {"means": rate, SHAPES["means"]: config.position_share * rate}
        for name, value in positions.items():
            self.optimiser.set_learning_rate(name, value)
        self._decay_rates(iteration, config.final_rate, apart=positions)

    def state(self) -> dict[str, Any]:
        """Parameters, moments, and which splats have a colour."""
        return {**super().state(), "colored": self.colored}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        super().load_state(state)
        self.colored = state["colored"]

    def note(self) -> str:
        """Number of splats."""
        return f"{len(self.colored)} splats"

    def result(self) -> StoredShapes:
        """The trained avatar, without splats that never had a gradient: no image has shown them."""
        moments = self.optimiser.moments("colors")
        kept = torch.ones_like(self.colored)
        if moments and not self._config.online:
            kept = self.colored | (moments["exp_avg_sq"] > 0).any(1)
        kept = kept if bool(kept.any()) else torch.ones_like(kept)
        tensors = {name: self.optimiser[name].detach() for name in self._rates}
        for name, value in tensors.items():
            if name in SHAPES.values():
                tensors[name] = value[:, kept]
            elif name not in (*WEIGHTS, *BIASES):
                tensors[name] = value[kept]
        return StoredShapes(tensors, self.points.rows(kept.cpu().numpy()), self._config.inputs)

    def _splats(self, iteration: int, rows: Sequence[int]) -> list[dict[str, Tensor]]:
        """Splats of some timesteps; the neutral ones before the blendshapes are trained."""
        splats: dict[str, Tensor] = {name: self.optimiser[name] for name in self._rates}
        if not self._config.online and iteration <= self._timeline.at(self._config.join):
            return [splats] * len(rows)
        return blended(splats, blend_weights(splats, self._inputs[rows]))

    def _posed(self, row: int) -> PointsOfPose:
        return self._surface.posed(self._tracked.at(row))

    def _on_background(self, pixels: Tensor, iteration: int, image: int) -> tuple[Tensor, Tensor]:
        """(H, W, 3) colours, on a random background if there are masks, and that background."""
        if not self._masks or not self._config.random_background:
            return pixels[:, :, :3], self._background
        random = numpy_generator(self._seed, "background", iteration * len(self.keys) + image).random(3)
        background = to_device(torch.from_numpy(random.astype(np.float32)), self._background.device)
        return recomposited(pixels[:, :, :3], pixels[:, :, 3:], self._background, background), background

    def _take_colors(self) -> None:
        """Set colours of splats whose weights over the batch's foreground add up to enough for the first time.

        The colour is the mean of the images' colours, weighted by what the splat contributes to each pixel. These sums are
        gradients: of a rendering times the image, with respect to the colours of the splats.
        """
        sums = torch.zeros(len(self.colored), 4, device=self.colored.device)
        for world, opacities, view, pixels in self._seen:
            truth = torch.cat([pixels[:, :, :3], torch.ones_like(pixels[:, :, :1])], dim=2)
            if self._masks:
                truth = truth * (pixels[:, :, 3:] > 0.5)
            values = torch.zeros_like(sums).requires_grad_()
            still = WorldSplats(*(part.detach() for part in world))
            rendering = rasterize_view(still, opacities.detach(), values, view)
            (sums_of_view,) = torch.autograd.grad((rendering.image * truth).sum(), values)
            sums += sums_of_view
        new = (sums[:, 3] > self._config.color_weight) & ~self.colored
        rows = new.nonzero().squeeze(1)
        parameter = self.optimiser["colors"]
        parameter.data[rows] = (sums[rows, :3] / sums[rows, 3:] - 0.5) / C0
        # The step that follows does not move them.
        if parameter.grad is not None:
            parameter.grad[rows] = 0
        moments = self.optimiser.moments("colors")
        if moments:
            moments["exp_avg"][rows] = 0
        self.colored = self.colored | new

    def _initial(self) -> Initial:
        """Grey splats of equal size on the surface, blendshapes of zero, a random network."""
        config, count = self._config, len(self.points.triangles)
        scale = 1e-3 * config.initial_scale_mm * (PUBLISHED_SAMPLES / count) ** 0.5
        splats = {
            "means": (torch.zeros(count, 3), config.position_lr),
            "quats": (unturned(count), config.rotation_lr),
            "colors": (torch.zeros(count, 3), config.color_lr),
            "log_scales": (torch.full((count, 3), float(np.log(scale))), config.scale_lr),
            "opacities": (torch.full((count,), logit(config.initial_opacity)), config.opacity_lr),
        }
        shares = {
            "means": config.position_share,
            "quats": config.rotation_share,
            "colors": config.color_share,
        }
        shapes = {
            SHAPES[name]: (torch.zeros(config.blendshapes, *splats[name][0].shape), share * splats[name][1])
            for name, share in shares.items()
        }
        sizes = (self._inputs.shape[1], config.hidden, config.hidden, config.blendshapes)
        network = initial_network(sizes, self._seed)
        layers = {name: (value, config.network_lr) for name, value in network.items()}
        return {**splats, **shapes, **layers}
