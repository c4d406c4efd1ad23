"""Layers of super-resolution row strip by row strip, without gradients: large images in bounded memory.

Normalisation needs statistics of a layer's whole output. So each layer's raw output is kept, one at a time, and
normalised strip by strip where the next layer reads it; enlarged and normalised images never exist whole. Nothing is
computed twice, for each strip reads the rows around it that its convolution needs.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

Reader = Callable[[int, int], Tensor]
"""Rows from the first number to before the second of an image, (1, C, rows, W)."""


def rows_at_once(width: int, channels: int, numbers: int) -> int:
    """Rows of an image in a strip of at most so many numbers; one at least."""
    return max(1, numbers // (width * channels))


def convolved(read: Reader, height: int, weight: Tensor, rows: int) -> Tensor:
    """(1, D, H, W) 3x3 convolution, padded with zeros, of the image of ``height`` rows that ``read`` gives."""
    strips = range(0, height, rows)
    result = None
    for first in strips:
        last = min(first + rows, height)
        strip = _convolution(read(max(first - 1, 0), min(last + 1, height)), weight, first, last, height)
        if result is None:
            result = strip.new_empty(1, strip.shape[1], height, strip.shape[3])
        result[:, :, first:last] = strip
    assert result is not None
    return result


def convolve_in_place(raw: Tensor, weight: Tensor, rows: int, floor: float) -> None:
    """Replace a raw output by that of the next layer, which has as many channels."""
    read, height = activated(raw, floor), raw.shape[2]
    above = None
    for first in range(0, height, rows):
        last = min(first + rows, height)
        # The row above is overwritten already.
        strip = read(first, min(last + 1, height))
        joined = strip if above is None else torch.cat([above, strip], dim=2)
        above = strip[:, :, last - first - 1 : last - first].clone()
        raw[:, :, first:last] = _convolution(joined, weight, first, last, height)


def activated(raw: Tensor, floor: float) -> Reader:
    """Rows of a raw output, each channel normalised by the present image's statistics, and rectified."""
    variances, means = zip(*(torch.var_mean(plane, correction=0) for plane in raw[0]))
    mean = torch.stack(means)[:, None, None]
    scale = (torch.stack(variances)[:, None, None] + floor).rsqrt()

    def read(first: int, last: int) -> Tensor:
        return (raw[:, :, first:last] - mean).mul_(scale).relu_()

    return read


def doubled(read: Reader, height: int) -> Reader:
    """Rows of the image of ``height`` rows that ``read`` gives, at twice its size: bilinear, corners on corners."""

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
