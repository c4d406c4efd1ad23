"""The head of Gaussians: points with features are posed, splatted as feature images, and enlarged by
super-resolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import Camera
from ..ops.splats import WorldSplats, left_products
from ..shared.rendering import rasterize_view, view_of
from .driving import HeadMotion, Signal, influences
from .mesh_head import ATTRIBUTES, Controllers, Influences, Weights, encode, encode_pose, uniform
from .spec import GHAConfig

POINTS = {"points": 3, "log_scales": 3, "quats": 4, "opacities": 1}
"""Attributes of a Gaussian except its features, with columns: canonical position and scale, rotation, opacity
logit."""
LARGEST_LOG_SCALE = 2.0
"""Maximum size of a Gaussian in canonical units, also for expressions far outside the training range."""
REACH = 2
"""Distance from a drawn pixel, in pixels of the feature image, that super-resolution may colour."""
COVERED = 1e-3
"""Alpha above which a pixel of the feature image counts as drawn."""


class FeatureSplats(NamedTuple):
    """Splats of one pose: geometry in the world, its quaternions of any length, (N,) opacities, and (N, C) features, of
    which 3 are a colour."""

    world: WorldSplats
    opacities: Tensor
    features: Tensor


class FeatureImage(NamedTuple):
    """A view at the splatted size: the (h, w, C) feature image and its (h, w) alpha."""

    features: Tensor
    alpha: Tensor

    @property
    def colors(self) -> Tensor:
        """(h, w, 3): the first features."""
        return self.features[..., :3]


class PointInputs(NamedTuple):
    """Influences of the controllers, and (N, 27) encoded points and (N, F) features within (-1, 1)."""

    parts: Influences
    encoded: Tensor
    features: Tensor


@dataclass(frozen=True)
class GaussianHead:
    """The networks of the Gaussian phase. Tensors are given by name: `POINTS`, "features", "landmarks"."""

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
        shapes = self.super_resolution.shapes()
        return {n: s for mlp in self.controllers.of_gaussians for n, s in mlp.shapes().items()} | shapes

    def inputs(self, tensors: Weights, nearest: Tensor | None = None) -> PointInputs:
        """Inputs of the networks that depend only on the points and their features, for all poses; for ``nearest`` see
        `influences`."""
        c, points = self.config, tensors["points"]
        parts = influences(points, tensors["landmarks"].detach(), c.near_squared, c.far_squared, nearest)
        return PointInputs(parts, encode(points), torch.tanh(tensors["features"]))

    def splats(
        self,
        tensors: Weights,
        signal: Signal,
        motion: HeadMotion,
        noise: Tensor | None = None,
        inputs: PointInputs | None = None,
    ) -> FeatureSplats:
        """Pose all Gaussians; differentiable in the motion and in every tensor except the landmarks and bounds.

        Colour and attributes depend on the expression code, clamped to "code_low" and "code_high", plus (E,)
        ``noise``. ``inputs`` may be computed beforehand if the tensors do not change.
        """
        c, nets = self.config, self.controllers
        points = tensors["points"]
        parts, encoded, features = inputs or self.inputs(tensors)
        pose, code = encode_pose(motion.code), signal.expression
        moves = nets.displacements(tensors, encoded, parts, code, pose)
        seen = torch.minimum(torch.maximum(code, tensors["code_low"]), tensors["code_high"])
        if noise is not None:
            seen = seen + noise
        changes = nets.attributes(tensors, features, parts, seen, pose)
        turn = left_products(motion.quaternion[None])[0]
        placed = posed(
            *(c, motion.rotation, motion.translation, turn, points, moves),
            *(tensors["log_scales"], tensors["quats"], tensors["opacities"], changes),
        )
        means, quats, sizes, opacities = placed
        colors = nets.colors(tensors, features, parts, seen, pose)
        return FeatureSplats(WorldSplats(means, quats, sizes), opacities, colors)

    def draw(self, splats: FeatureSplats, camera: Camera, background: Tensor) -> FeatureImage:
        """Splat the features for a camera of full size; their background is a (3,) colour, then ones."""
        world = splats.world
        view = view_of(feature_camera(camera, self.config.upscale), str(world.means.device))
        ground = feature_background(background, self.config.channels)
        rendering = rasterize_view(world, splats.opacities, splats.features, view, ground)
        return FeatureImage(rendering.image, rendering.alpha)

    def sharpen(
        self, tensors: Weights, drawn: FeatureImage, background: Tensor, *, bounded: bool = False
    ) -> Tensor:
        """(u h, u w, 3) image of a feature image; ``background`` far from drawn pixels.

        ``bounded`` limits memory for large images; it supports no gradients.
        """
        network = self.super_resolution.bounded if bounded else self.super_resolution
        return network(tensors, drawn, background)


def feature_background(background: Tensor, channels: int) -> Tensor:
    """(C,) features of the background: the (3,) colour, then ones."""
    features = background.new_ones(channels)
    features[:3] = background
    return features


def feature_camera(camera: Camera, upscale: int) -> Camera:
    """The camera of the feature image: ``upscale`` times smaller, its image padded at the right and below to whole pixels."""
    if upscale == 1:
        return camera
    width, height = -(-camera.width // upscale), -(-camera.height // upscale)
    return camera.boxed(0, 0, width * upscale, height * upscale).resized(width, height)


def near_drawn(alpha: Tensor) -> Tensor:
    """(h, w) bool: whether something is drawn within `REACH` pixels."""
    near = F.pad(alpha.detach() > COVERED, (REACH,) * 4)
    for axis in range(2):  # a third of the time of a maximum over squares
        near = near.unfold(axis, 2 * REACH + 1, 1).any(2)
    return near


def enlarged(values: Tensor, factor: int) -> Tensor:
    """(u h, u w) of (h, w), each value repeated."""
    return values.repeat_interleave(factor, 0).repeat_interleave(factor, 1)


VARIANCE_FLOOR = 1e-5

AT_ONCE = 2**24
"""Size of the largest tensor up to which images are computed whole, and size of a strip above it (64 MiB of
float32)."""


@dataclass(frozen=True)
class SuperResolution:
    """Blocks of two 3x3 convolutions, each normalised over the image and rectified; a 1x1 convolution; a sigmoid.

    The first block works at the size of the features, each further one at twice the previous size.
    """

    channels: int

    widths: tuple[int, ...]
    """Channels of the blocks."""
    residual: bool = False
    """Whether to add to the splatted colours, enlarged bilinearly and weighted by their alpha, instead of replacing them; there
    is no sigmoid then, and the initial output is zero."""

    @property
    def upscale(self) -> int:
        """Ratio of output size to input size."""
        return 2 ** (len(self.widths) - 1)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every tensor, by name. Convolutions have no bias, except the last one."""
        shapes: dict[str, tuple[int, ...]] = {}
        before = self.channels
        for block, width in enumerate(self.widths):
            shapes[f"sr.conv_{block}_0"] = (width, before, 3, 3)
            shapes[f"sr.conv_{block}_1"] = (width, width, 3, 3)
            before = width
        return {**shapes, "sr.color": (3, before, 1, 1), "sr.color_bias": (3,)}

    def initial(self, generator: torch.Generator, device: str) -> dict[str, Tensor]:
        """Weights uniform within 1 / sqrt(fan-in), the last layer's zero for a residual."""
        tensors = uniform(self.shapes(), generator, device)
        if self.residual:
            tensors |= {name: torch.zeros_like(tensors[name]) for name in ("sr.color", "sr.color_bias")}
        return tensors

    def __call__(self, weights: Weights, drawn: FeatureImage, background: Tensor) -> Tensor:
        """(u H, u W, 3) colours of an (H, W) feature image, within (0, 1) without ``residual``; ``background`` far
        from drawn pixels."""
        values = drawn.features
        for block in range(len(self.widths)):
            if block:
                size = 2 * values.shape[0], 2 * values.shape[1]
                values = _resized(values, size, align_corners=True)
            for layer in range(2):
                values = normalised_convolution(values, weights[f"sr.conv_{block}_{layer}"])
        colors = F.linear(values, weights["sr.color"].flatten(1), weights["sr.color_bias"])
        return self._finished(colors, drawn, background)

    @torch.no_grad()
    def bounded(
        self, weights: Weights, drawn: FeatureImage, background: Tensor, at_once: int = AT_ONCE
    ) -> Tensor:
        """The same output without gradients, in bounded memory, in strips of rows.

        The image is computed whole if no tensor has more than ``at_once`` elements. Otherwise only the outputs of a
        block and of the previous one exist at a time, and strips of at most ``at_once`` elements.
        """
        features = drawn.features
        height, width = features.shape[:2]
        before = (self.channels, *self.widths[:-1])
        largest = [4**b * max(pair) * height * width for b, pair in enumerate(zip(before, self.widths))]
        if max(largest) <= at_once:
            return self(weights, drawn, background)
        planes = features.permute(2, 0, 1)[None]

        def given(first: int, last: int) -> Tensor:
            return planes[:, :, first:last]

        read: Reader = given
        for block, channels in enumerate(zip(before, self.widths)):
            if block:
                read, height, width = _doubled(read, height), 2 * height, 2 * width
            rows = max(1, at_once // (width * max(channels)))
            raw = _convolved(read, height, weights[f"sr.conv_{block}_0"], rows)
            _convolve_in_place(raw, weights[f"sr.conv_{block}_1"], rows)
            read = _activated(raw)
        colors = features.new_empty(1, 3, height, width)
        color = weights["sr.color"], weights["sr.color_bias"]
        for first in range(0, height, rows):
            strip = read(first, min(first + rows, height))
            colors[:, :, first : first + rows] = F.conv2d(strip, *color)
        return self._finished(colors[0].permute(1, 2, 0), drawn, background)

    def _finished(self, colors: Tensor, drawn: FeatureImage, background: Tensor) -> Tensor:
        """(u H, u W, 3) image of the last layer's (u H, u W, 3) output; the background where nothing is near."""
        near = enlarged(near_drawn(drawn.alpha), self.upscale)
        if not self.residual:
            return torch.where(near[..., None], torch.sigmoid(colors), background)
        plain, alpha = self._plain(drawn)
        return torch.where(near[..., None], plain + alpha[..., None] * colors, background)

    def _plain(self, drawn: FeatureImage) -> tuple[Tensor, Tensor]:
        """(u H, u W, 3) splatted colours and their (u H, u W) alpha."""
        if self.upscale == 1:
            return drawn.colors, drawn.alpha
        height, width = drawn.alpha.shape
        size = self.upscale * height, self.upscale * width
        joined = torch.cat([drawn.colors, drawn.alpha[..., None]], dim=2)
        enlarged = _resized(joined, size, align_corners=False)
        return enlarged[..., :3], enlarged[..., 3]


def posed(
    config: GHAConfig,
    rotation: Tensor,
    translation: Tensor,
    turn: Tensor,
    points: Tensor,
    moves: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    changes: Tensor,
) -> tuple[Tensor, ...]:
    """(N, 3) means, (N, 4) quaternions of any length, (N, 3) scales and (N,) opacities of a pose, in the world.

    - ``rotation``, ``translation``: (3, 3) and (3,), the motion of the canonical frame.
    - ``turn``: (4, 4), matrix of multiplication by the rotation's quaternion.
    - ``points``, ``moves``: (N, 3) canonical points, and displacements before their factor.
    - ``log_scales``, ``quats``, ``opacities``: (N, 3), (N, 4) and (N,) logits, canonical.
    - ``changes``: (N, 8) changes of these by the networks, before their factor.
    """
    unit = config.unit
    scale, quat, faint = (config.attribute_scale * changes).split(list(ATTRIBUTES), dim=1)
    canonical = points + config.displacement_scale * moves
    return (
        unit * canonical @ rotation.t() + translation,
        (quats + quat) @ turn.t(),
        unit * (log_scales + scale).clamp_max(LARGEST_LOG_SCALE).exp(),
        torch.sigmoid(opacities + faint[:, 0]),
    )


def _resized(values: Tensor, size: Sequence[int], *, align_corners: bool) -> Tensor:
    """The (H, W, C) image at another size, bilinear."""
    planes = values.permute(2, 0, 1)[None]
    resized = F.interpolate(planes, tuple(size), mode="bilinear", align_corners=align_corners)
    return resized[0].permute(1, 2, 0)


def normalised_convolution(values: Tensor, weight: Tensor) -> Tensor:
    """(H, W, D) 3x3 convolution, padded with zeros, of an (H, W, C) image by (D, C, 3, 3) weights, each channel normalised
    to mean 0 and variance 1 over the image, and rectified."""
    # Channels are last in the image's memory; convolution is faster if they are also last in the weights'.
    weight = weight.contiguous(memory_format=torch.channels_last)
    raw = F.conv2d(values.permute(2, 0, 1)[None], weight, padding=1)
    # Instance normalisation of a single image equals batch normalisation, whose torch kernel also accepts an image of
    # one pixel (which becomes 0).
    normalised = torch.native_batch_norm(raw, None, None, None, None, True, 0.0, VARIANCE_FLOOR)[0]
    return F.relu(normalised).squeeze(0).permute(1, 2, 0)


Reader = Callable[[int, int], Tensor]
"""Returns rows ``first`` to ``last`` - 1 of an image, (1, C, rows, W)."""


def _convolved(read: Reader, height: int, weight: Tensor, rows: int) -> Tensor:
    """(1, D, H, W) 3x3 convolution, padded with zeros, of the image of ``height`` rows that ``read`` gives."""
    for first in range(0, height, rows):
        last = min(first + rows, height)
        source = read(max(first - 1, 0), min(last + 1, height))
        if not first:
            result = weight.new_empty(1, len(weight), height, source.shape[3])
        result[:, :, first:last] = _convolution(source, weight, first, last, height)
    return result


def _convolve_in_place(raw: Tensor, weight: Tensor, rows: int) -> None:
    """Replace a raw output by that of the next layer, which has the same number of channels."""
    read, height = _activated(raw), raw.shape[2]
    above = None
    for first in range(0, height, rows):
        last = min(first + rows, height)
        # The row above is overwritten already.
        strip = read(first, min(last + 1, height))
        joined = strip if above is None else torch.cat([above, strip], dim=2)
        above = strip[:, :, last - first - 1 : last - first].clone()
        raw[:, :, first:last] = _convolution(joined, weight, first, last, height)


def _activated(raw: Tensor) -> Reader:
    """Rows of a raw output, each channel normalised by the statistics of the current image, and rectified."""
    variances, means = zip(*(torch.var_mean(plane, correction=0) for plane in raw[0]))
    mean = torch.stack(means)[:, None, None]
    scale = (torch.stack(variances)[:, None, None] + VARIANCE_FLOOR).rsqrt()

    def read(first: int, last: int) -> Tensor:
        return (raw[:, :, first:last] - mean).mul_(scale).relu_()

    return read


def _doubled(read: Reader, height: int) -> Reader:
    """Rows of the image of ``height`` rows from ``read`` at twice its size: bilinear, aligned corners."""

    def read_doubled(first: int, last: int) -> Tensor:
        step = (height - 1) / (2 * height - 1)
        low, high = int(step * first), min(int(step * (last - 1)) + 2, height)
        source = read(low, high)
        places = step * torch.arange(first, last, dtype=torch.float64, device=source.device)
        above = places.floor().long()
        below = (above + 1).clamp_max(height - 1)
        share = (places - above).to(source.dtype)[:, None]
        upper, lower = (source.index_select(2, rows - low) for rows in (above, below))
        enlarged = torch.lerp(upper, lower, share)
        return F.interpolate(
            enlarged, (last - first, 2 * source.shape[3]), mode="bilinear", align_corners=True
        )

    return read_doubled


def _convolution(values: Tensor, weight: Tensor, first: int, last: int, height: int) -> Tensor:
    """Rows ``first`` to before ``last`` of an image's convolution, of these rows and their neighbours in the image."""
    return F.conv2d(F.pad(values, (1, 1, int(first == 0), int(last == height))), weight)
