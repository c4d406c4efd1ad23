"""The head of Gaussians: points with features, posed by the controllers, splatted as features, brought to full size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import Camera
from ...datasets.head.rotations import matrix_to_quaternion
from ..shared.binding import WorldSplats, left_products
from ..splats import rasterize
from .config import GHAConfig
from .controllers import Controllers, encode_pose
from .driving import Motion, Signal
from .landmarks import influences
from .networks import Weights
from .super_resolution import SuperResolution

POINTS = {"points": 3, "log_scales": 3, "quats": 4, "opacities": 1}
"""What a Gaussian has besides its features, with columns: canonical position and scale, rotation, opacity logit."""

LARGEST_LOG_SCALE = 2.0
"""A Gaussian is at most so large (of canonical units), however far an expression is outside of what was trained."""

REACH = 2
"""Pixels of the feature image around a drawn one that super-resolution may still colour."""

COVERED = 1e-3
"""Alpha above which a pixel of the feature image counts as drawn."""


class Splats(NamedTuple):
    """Splats of one pose: geometry in the world, its quaternions of any length, (N,) opacities, and (N, C) features, of
    which 3 are a colour."""

    world: WorldSplats
    opacities: Tensor
    features: Tensor


class Drawn(NamedTuple):
    """What a camera sees: the (h, w, C) feature image and its (h, w) alpha, at the splatted size."""

    features: Tensor
    alpha: Tensor


@dataclass(frozen=True)
class GaussianHead:
    """The networks of the Gaussian stage and what they do. Tensors come by name: `POINTS`, "features", "landmarks"."""

    config: GHAConfig
    controllers: Controllers
    super_resolution: SuperResolution

    @classmethod
    def of(cls, config: GHAConfig, expression_size: int) -> GaussianHead:
        """Networks of the configured widths."""
        sharpener = SuperResolution(config.channels, config.sr_widths, config.residual)
        return cls(config, Controllers.of(config, expression_size), sharpener)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every network's tensors, by name."""
        controllers = {
            name: shape for mlp in self.controllers.of_gaussians for name, shape in mlp.shapes().items()
        }
        return {**controllers, **self.super_resolution.shapes()}

    def splats(self, tensors: Weights, signal: Signal, motion: Motion, noise: Tensor | None = None) -> Splats:
        """Pose all Gaussians; differentiable in every tensor but the landmarks and bounds, and in the motion.

        Colour and attributes see the expression code within the bounds "code_low" and "code_high", and (E,) ``noise``
        on it.
        """
        c, nets = self.config, self.controllers
        points, features = tensors["points"], torch.tanh(tensors["features"])
        landmarks = tensors["landmarks"].detach()
        parts = influences(points, landmarks, c.near_squared, c.far_squared)
        pose, code = encode_pose(motion.code), signal.expression
        moves = nets.displacements(tensors, points, parts, code, pose)
        seen = torch.minimum(torch.maximum(code, tensors["code_low"]), tensors["code_high"])
        if noise is not None:
            seen = seen + noise
        scale, turn, faint = nets.attributes(tensors, features, parts, seen, pose)
        log_scales = tensors["log_scales"] + c.attribute_scale * scale
        quats = tensors["quats"] + c.attribute_scale * turn
        opacities = torch.sigmoid(tensors["opacities"] + c.attribute_scale * faint[:, 0])
        canonical = points + c.displacement_scale * moves
        world = WorldSplats(
            c.unit * canonical @ motion.rotation.t() + motion.translation,
            quats @ _turning(motion.rotation).t(),
            c.unit * log_scales.clamp_max(LARGEST_LOG_SCALE).exp(),
        )
        return Splats(world, opacities, nets.colors(tensors, features, parts, seen, pose))

    def draw(self, splats: Splats, camera: Camera, background: Tensor) -> Drawn:
        """Splat the features for a camera of the full size; their background is (3,) colour, then ones."""
        small = feature_camera(camera, self.config.upscale)
        world = splats.world
        rendering = rasterize(
            *(world.means, world.quats, world.scales, splats.opacities, splats.features),
            *(small.world_to_camera, small.K, small.width, small.height),
            background=feature_background(background, self.config.channels),
            check_values=False,
        )
        return Drawn(rendering.image, rendering.alpha)

    def sharpen(self, tensors: Weights, drawn: Drawn, background: Tensor, *, bounded: bool = False) -> Tensor:
        """(u h, u w, 3) image of a feature image; ``background`` where nothing is drawn near.

        ``bounded`` keeps the memory for large images small, without gradients.
        """
        network = self.super_resolution.bounded if bounded else self.super_resolution
        colors = network(tensors, drawn.features, drawn.alpha)
        near = enlarged(near_drawn(drawn.alpha), self.config.upscale)
        return torch.where(near[..., None] > 0, colors, background)


def feature_background(background: Tensor, channels: int) -> Tensor:
    """(C,) features where nothing is drawn: the (3,) colour, then ones."""
    features = background.new_ones(channels)
    features[:3] = background
    return features


def feature_camera(camera: Camera, upscale: int) -> Camera:
    """The camera of the feature image: ``upscale`` times smaller, its image padded at the right and below to whole
    pixels."""
    width, height = -(-camera.width // upscale), -(-camera.height // upscale)
    return camera.boxed(0, 0, width * upscale, height * upscale).resized(width, height)


def near_drawn(alpha: Tensor) -> Tensor:
    """(h, w) of 0 and 1: whether something is drawn within `REACH` pixels."""
    drawn = (alpha.detach() > COVERED).to(alpha.dtype)
    return F.max_pool2d(drawn[None, None], 2 * REACH + 1, stride=1, padding=REACH)[0, 0]


def enlarged(values: Tensor, factor: int) -> Tensor:
    """(u h, u w) of (h, w), each value repeated."""
    return values.repeat_interleave(factor, 0).repeat_interleave(factor, 1)


def _turning(rotation: Tensor) -> Tensor:
    """(4, 4) matrix M of a (3, 3) rotation: M q is the quaternion of that rotation after q."""
    return left_products(matrix_to_quaternion(rotation)[None])[0]
