"""From a feature image to a colour image of up to four times its size, by a small convolutional network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from .networks import Weights, uniform
from .strips import Reader, activated, convolve_in_place, convolved, doubled, rows_at_once

VARIANCE_FLOOR = 1e-5

AT_ONCE = 2**24
"""Numbers of the largest tensor up to which images are computed whole, and of a strip above (64 MiB of float32)."""


@dataclass(frozen=True)
class SuperResolution:
    """Blocks of two 3x3 convolutions, each normalised over the image and rectified; a 1x1 convolution; a sigmoid.

    The first block works at the size of the features, each further one at twice the size before it.

    Attributes
    ----------
    channels : of the feature image.
    widths : channels of the blocks.
    residual : add to the splatted colours, enlarged bilinearly, as far as something is drawn, instead of making
        colours; there is no sigmoid then, and the start is nothing to be added.
    """

    channels: int
    widths: tuple[int, ...]
    residual: bool = False

    @property
    def upscale(self) -> int:
        """Size of the output over that of the input."""
        return 2 ** (len(self.widths) - 1)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every tensor, by name. Convolutions have no bias but for the last one."""
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

    def __call__(self, weights: Weights, features: Tensor, alpha: Tensor) -> Tensor:
        """(u H, u W, 3) colours of an (H, W, C) feature image with its (H, W) alpha; in (0, 1) without ``residual``."""
        values = features.permute(2, 0, 1)[None]
        for block in range(len(self.widths)):
            if block:
                height, width = values.shape[2:]
                values = F.interpolate(values, (2 * height, 2 * width), mode="bilinear", align_corners=True)
            for layer in range(2):
                values = F.conv2d(values, weights[f"sr.conv_{block}_{layer}"], padding=1)
                values = F.relu(_normalised(values))
        colors = F.conv2d(values, weights["sr.color"], weights["sr.color_bias"])
        return self._finished(colors, features, alpha)

    @torch.no_grad()
    def bounded(self, weights: Weights, features: Tensor, alpha: Tensor, at_once: int = AT_ONCE) -> Tensor:
        """What calling gives, without gradients, in bounded memory: see `strips`.

        By calling, where no tensor there has more than ``at_once`` numbers. Otherwise no more than a block's output and
        that of the block before exist at a time, beside strips of so many numbers.
        """
        height, width = features.shape[:2]
        before = (self.channels, *self.widths[:-1])
        largest = [4**b * max(pair) * height * width for b, pair in enumerate(zip(before, self.widths))]
        if max(largest) <= at_once:
            return self(weights, features, alpha)
        planes = features.permute(2, 0, 1)[None]

        def given(first: int, last: int) -> Tensor:
            return planes[:, :, first:last]

        read: Reader = given
        for block, channels in enumerate(zip(before, self.widths)):
            if block:
                read, height, width = doubled(read, height), 2 * height, 2 * width
            rows = rows_at_once(width, max(channels), at_once)
            raw = convolved(read, height, weights[f"sr.conv_{block}_0"], rows)
            convolve_in_place(raw, weights[f"sr.conv_{block}_1"], rows, VARIANCE_FLOOR)
            read = activated(raw, VARIANCE_FLOOR)
        colors = features.new_empty(1, 3, height, width)
        for first in range(0, height, rows):
            strip = read(first, min(first + rows, height))
            colors[:, :, first : first + rows] = F.conv2d(
                strip, weights["sr.color"], weights["sr.color_bias"]
            )
        return self._finished(colors, features, alpha)

    def _finished(self, colors: Tensor, features: Tensor, alpha: Tensor) -> Tensor:
        """(u H, u W, 3) image of the last layer's (1, 3, u H, u W) output."""
        if not self.residual:
            return torch.sigmoid(colors)[0].permute(1, 2, 0)
        plain = torch.cat([features[..., :3], alpha[..., None]], dim=2).permute(2, 0, 1)[None]
        if self.upscale > 1:
            plain = F.interpolate(plain, colors.shape[2:], mode="bilinear", align_corners=False)
        return (plain[:, :3] + plain[:, 3:] * colors)[0].permute(1, 2, 0)


def _normalised(values: Tensor) -> Tensor:
    """Each channel with mean 0 and variance 1 over the image: instance normalisation.

    Of one image that is what batch normalisation does, and torch's kernel for it takes an image of one pixel too
    (which becomes 0).
    """
    return torch.native_batch_norm(values, None, None, None, None, True, 0.0, VARIANCE_FLOOR)[0]
