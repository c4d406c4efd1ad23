"""FlashAvatar: splats on a tracked mesh, deformed by a network of the tracked parameters.

Xiang et al., "FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding", CVPR 2024, arXiv 2312.02214.

An iteration trains on one image, whose loss has a mask of the mouth.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from ...bench.contracts import Changes, Clip, FloatArray, HeadPose
from ..avatars.compact.layouts import offsets, read_coded
from ..avatars.harmonics import turn_harmonics
from ..ops.photometric import photometric_loss
from ..ops.planes import coefficient_count, encode, turned_colors
from ..ops.splats import TriangleFrames
from ..shared.optimisation import initial_network, layer_names, tracked_inputs
from ..shared.rendering import PlacedSplats, changes_of, rasterize_view
from ..shared.schedule import ShuffledEpochs
from ..shared.splat_training import initial_shapes
from ..shared.surface_points import BoundedCache, mouth_mask, spacing
from ..shared.surface_splats import SurfaceAvatar, SurfaceMethod, SurfaceTrainer
from .model import (
    INPUTS,
    TrainedSplats,
    changed,
    initial_gaussians,
    layer_of_points,
    network_outputs,
    network_sizes,
)
from .spec import FLASHAVATAR as SPEC
from .spec import FlashAvatarConfig

BOUNDARY = "boundary"
"""Region at the lower end of the neck, where the mesh ends: the authors' chart has no texels there, so no splats."""
MOUTH = "lips"
"""The region of the mask of the mouth."""
HUBER = 0.1
"""Difference of colours up to which the loss is quadratic."""
NETWORK_EPSILON = 1e-8
"""Epsilon of the network's Adam, as in the authors' program: the default of PyTorch. That of the splats is 3DGS's."""


class FlashAvatarTraining(SurfaceTrainer[FlashAvatarConfig]):
    """A `Trainable`: splats on the surface, grey and as large as the distance to their neighbours at first, and the network."""

    stored_class = TrainedSplats

    def __init__(self, clip: Clip, config: FlashAvatarConfig, device: str, seed: int):
        sampler = ShuffledEpochs(len(clip.splits["train"]), seed)
        super().__init__(clip, config, sampler, INPUTS, device, seed, border=BOUNDARY)
        self._encoded = encode(self._surface.rest, config.frequencies)
        lips = clip.head.regions.get(MOUTH, ()) if config.mouth_weight else ()
        self._mouth = np.asarray(lips, np.int64)
        pixels = max(camera.width * camera.height for camera in self.cameras.values())
        self._masks = BoundedCache(self._mask, config.mesh_cache_mb * 2**19 // pixels)
        count, coefficients = len(self.rest), coefficient_count(config.sh_degree)
        splats = {
            **initial_shapes(spacing(self.rest), config),
            "sh_dc": (torch.zeros(count, 3), config.sh_dc_lr),
            "sh_rest": (torch.zeros(count, 3, coefficients - 1), config.sh_rest_lr),
        }
        network = initial_network(network_sizes(config, self._inputs.shape[1]), seed)
        if config.zero_output and not config.hyper_gaussians:
            for names in layer_names(config.layers + 1):
                network[names[-1]].zero_()
        network |= initial_gaussians(count, config.hyper_gaussians)
        initial = splats | {name: (value, config.network_lr) for name, value in network.items()}
        self._optimise(initial, dict.fromkeys(network, NETWORK_EPSILON))

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of one image, see `image_loss`."""
        config, key, tensors = self._config, self.keys[index], self.tensors()
        view, row = self._views[key.camera], self._tracked.row[key.timestep]
        of_points = layer_of_points(tensors, self._encoded)
        outputs = network_outputs(tensors, of_points, self._inputs[row], config)
        frames = self._frames(row)
        world = self._surface.place(frames, changed(tensors, outputs, config))
        harmonics = tensors["sh_dc"], tensors["sh_rest"], world.means, frames.rotation
        colors = turned_colors(*harmonics, view.center, self._timeline.sh_degree(config, iteration))
        rendering = rasterize_view(world, tensors["opacities"].sigmoid(), colors, view, self._background)
        mouth = self._masks(index) if len(self._mouth) else None
        return image_loss(rendering.image, self._images.get(iteration, index), mouth, config)

    @torch.no_grad()
    def _mask(self, index: int) -> Tensor:
        """(H, W) bool mask of the mouth in an image."""
        key = self.keys[index]
        vertices = self._mesh.posed(self._tracked.at(self._tracked.row[key.timestep])).cpu().numpy()
        mask = mouth_mask(self.cameras[key.camera], vertices[self._mouth], vertices.mean(0))
        return torch.from_numpy(mask).to(self._device)


def image_loss(image: Tensor, truth: Tensor, mouth: Tensor | None, config: FlashAvatarConfig) -> Tensor:
    """Weighted sum of the Huber loss, the Huber loss within the mouth mask, and 1 - SSIM.

    Images are (H, W, 3) in [0, 1], the mask (H, W) bool. Both Huber losses are means over all pixels.
    """
    each = huber_loss(image, truth, reduction="none", delta=HUBER)
    if mouth is not None:
        each = each * (1 + config.mouth_weight * mouth.to(each.dtype))[:, :, None]
    loss = each.mean()
    if config.ssim_weight:
        loss = loss + config.ssim_weight * photometric_loss(image, truth, 1.0)
    return loss


class FlashAvatarAvatar(SurfaceAvatar[TrainedSplats]):
    """A trained head; see `SurfaceAvatar` for its files."""

    stored_class, read_coded = TrainedSplats, partial(read_coded, layout=offsets)

    @cached_property
    def _of_points(self) -> Tensor:
        """(N, H) part of the network's first layer that is the same in every pose."""
        encoded = encode(self.surface.rest, self.stored.settings.frequencies)
        return layer_of_points(self.stored.tensors, encoded)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the axes of the head."""
        rotation = self.surface.posed(self.mesh.arguments([pose])).rotation
        return turn_harmonics(self.stored.tensors["sh_dc"], self.stored.tensors["sh_rest"], rotation)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Offsets of the splats from the mesh."""
        return changes_of({"position": 1000 * self._changed(self.mesh.arguments([pose]))["means"]})

    def _changed(self, arguments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        tensors, config = self.stored.tensors, self.stored.settings
        outputs = network_outputs(tensors, self._of_points, tracked_inputs(arguments, INPUTS)[0], config)
        return changed(tensors, outputs, config)

    def _placed(self, frames: TriangleFrames, arguments: Mapping[str, Tensor]) -> PlacedSplats:
        tensors, config = self.stored.tensors, self.stored.settings
        world = self.surface.place(frames, self._changed(arguments))
        harmonics = tensors["sh_dc"], tensors["sh_rest"], world.means, frames.rotation
        colors = partial(turned_colors, *harmonics, degree=config.sh_degree)
        return PlacedSplats(world, tensors["opacities"].sigmoid(), colors)


class FlashAvatar(SurfaceMethod[FlashAvatarConfig, FlashAvatarAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class, training_class = FlashAvatarConfig, FlashAvatarAvatar, FlashAvatarTraining
