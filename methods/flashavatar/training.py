"""Training of FlashAvatar: the loss with its mask of the mouth, on one image an iteration, without density control."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from ...bench.contracts import BoolArray, Camera, Clip, FloatArray
from ..ops.harmonics import coefficient_count
from ..ops.mesh import TriangleFrames
from ..ops.photometric import photometric_loss
from ..ops.splats import unturned
from ..shared.avatar_files import clip_mesh
from ..shared.image_training import ImageTrainer, Initial
from ..shared.networks import initial_network, layer_names, tracked_inputs
from ..shared.optimisation import logit
from ..shared.rendering import rasterize_view
from ..shared.schedule import ShuffledEpochs
from ..shared.subject_mesh import BoundedCache, TrainingPoses
from ..shared.surface_points import spacing, spread_points
from .config import FlashAvatarConfig
from .hyper_gaussians import initial_gaussians
from .model import (
    INPUTS,
    HeadSurface,
    TrainedSplats,
    changed,
    colors_seen,
    layer_of_points,
    network_outputs,
    network_sizes,
    positional_encoding,
)

HUBER = 0.1
"""Difference of colours up to which the loss is quadratic."""
MOUTH = "lips"
"""Region of the head model whose outline is that of the mouth."""

BORDER = "boundary"
"""Region of the head model where its mesh ends, which has no texel of the chart as in the authors' program."""


class FlashAvatarTraining(ImageTrainer):
    """A `Trainable`: splats on the surface, and the network that changes them."""

    def __init__(self, clip: Clip, config: FlashAvatarConfig, device: str, seed: int):
        keys = clip.splits["train"]
        super().__init__(clip, config, ShuffledEpochs(len(keys), seed), device)
        self._config = config
        mesh = clip_mesh(clip, device)
        faces, vertices = np.asarray(clip.head.faces), mesh.canonical.cpu().numpy().astype(np.float64)
        border = clip.head.regions.get(BORDER)
        self.points = spread_points(
            *(clip.head, vertices, config.samples, seed), chart=config.uv_chart, chart_without=border
        )
        self._surface = HeadSurface(mesh, self.points)
        self._encoded = positional_encoding(self._surface.rest, config.frequencies)
        self._tracked = TrainingPoses(clip, mesh)
        self._inputs = tracked_inputs(self._tracked.arguments, INPUTS)
        mouth = clip.head.regions.get(MOUTH, ()) if config.mouth_weight else ()
        self._mouth = torch.tensor(np.asarray(mouth, np.int64), device=device)
        memory, pixels = config.mesh_cache_mb * 2**19, max(c.width * c.height for c in self.cameras.values())
        self._frames = BoundedCache(self._posed, memory // (4 * 17 * len(self._encoded)))
        self._masks = BoundedCache(self._mask, memory // pixels)
        distances = spacing(self.points.positions(vertices, faces))
        self._optimise(self._initial(distances, seed))

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of one image, see `image_loss`."""
        config, key = self._config, self.keys[index]
        view, row = self._views[key.camera], self._tracked.row[key.timestep]
        tensors = {name: self.optimiser[name] for name in self._rates}
        of_points = layer_of_points(tensors, self._encoded)
        outputs = network_outputs(tensors, of_points, self._inputs[row], config)
        frames = self._frames(row)
        world = self._surface.place(frames, changed(tensors, outputs, config))
        degree = self._timeline.sh_degree(config, iteration)
        colors = colors_seen(tensors, world, frames, view.center, degree)
        opacities = tensors["opacities"].sigmoid()
        rendering = rasterize_view(world, opacities, colors, view, self._background)
        truth = self._images.get(iteration, index)
        return image_loss(rendering.image, truth, self._masks(index), config)

    def after_backward(self, iteration: int) -> None:
        """Set the learning rates."""
        self._decay_rates(iteration, self._config.final_rate)

    def note(self) -> str:
        """Number of splats."""
        return f"{len(self._encoded)} splats"

    def result(self) -> TrainedSplats:
        """The trained avatar."""
        tensors = {name: self.optimiser[name].detach() for name in self._rates}
        return TrainedSplats(tensors, self.points, self._config)

    def _posed(self, row: int) -> TriangleFrames:
        return self._surface.posed(self._tracked.at(row))

    @torch.no_grad()
    def _mask(self, index: int) -> Tensor | None:
        """(H, W) bool mask of the mouth in an image, None without a mouth."""
        if not len(self._mouth):
            return None
        key = self.keys[index]
        vertices = self._surface.mesh.posed(self._tracked.at(self._tracked.row[key.timestep]))
        mouth, middle = vertices[self._mouth].cpu().numpy(), vertices.mean(0).cpu().numpy()
        mask = mouth_mask(self.cameras[key.camera], mouth, middle)
        return torch.from_numpy(mask).to(self._device)

    def _initial(self, distances: FloatArray, seed: int) -> Initial:
        """Grey splats as large as the distance to their neighbours, and a random network."""
        config, count = self._config, len(distances)
        log_scales = torch.from_numpy(np.log(distances)).float()[:, None].repeat(1, 3)
        initial = {
            "log_scales": (log_scales, config.scale_lr),
            "quats": (unturned(count), config.rotation_lr),
            "opacities": (torch.full((count,), logit(config.initial_opacity)), config.opacity_lr),
            "sh_dc": (torch.zeros(count, 3), config.sh_dc_lr),
            "sh_rest": (
                torch.zeros(count, 3, coefficient_count(config.sh_degree) - 1),
                config.sh_rest_lr,
            ),
        }
        network = initial_network(network_sizes(config, self._inputs.shape[1]), seed)
        if config.zero_output and not config.hyper_gaussians:
            for names in layer_names(config.layers + 1):
                network[names[-1]].zero_()
        network |= initial_gaussians(count, config.hyper_gaussians)
        initial |= {name: (value, config.network_lr) for name, value in network.items()}
        return initial


def image_loss(image: Tensor, truth: Tensor, mouth: Tensor | None, config: FlashAvatarConfig) -> Tensor:
    """Huber loss of an image, that of the images times the mask of the mouth with its weight, and 1 - SSIM with its own.

    Both Huber losses are means over all pixels.

    Parameters
    ----------
    image, truth : Tensor
        (H, W, 3) in [0, 1].
    mouth : Tensor | None
        (H, W) bool mask.
    """
    each = huber_loss(image, truth, reduction="none", delta=HUBER)
    if mouth is not None:
        each = each * (1 + config.mouth_weight * mouth.to(each.dtype))[:, :, None]
    loss = each.mean()
    if config.ssim_weight:
        loss = loss + config.ssim_weight * photometric_loss(image, truth, 1.0)
    return loss


def mouth_mask(camera: Camera, mouth: FloatArray, middle: FloatArray) -> BoolArray:
    """(H, W) mask of the pixels within the convex hull of the (M, 3) projected points of the mouth.

    Empty if the mouth faces away, seen from the ``middle`` (3,) of the head, or is not in front of the camera.
    """
    mask = np.zeros((camera.height, camera.width), np.uint8)
    points = mouth @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    center = mouth.mean(0)
    if points[:, 2].min() > 0 and (center - middle) @ (camera.center - center) > 0:
        pixels = points @ camera.K.T
        # cv2 counts from the centre of the first pixel, cameras from its corner.
        corners = np.round(pixels[:, :2] / pixels[:, 2:] - 0.5).clip(-(2**15), 2**15).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
    return mask.astype(bool)
