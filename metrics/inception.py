"""Inception V3 as FID uses it: the network of the file inception-2015-12-05, up to the mean over pixels of its last block.

Szegedy, Vanhoucke, Ioffe, Shlens, Wojna, "Rethinking the Inception Architecture for Computer Vision", CVPR 2016, with the parameter
names of torchvision. That file differs from the publication: means of pooling leave out the border's padding, and the last block pools
by the maximum.

Formats read:

- Weights of FID's Inception V3 (`pt_inception-2015-12-05-6726825d.pth`). Written by mseitzer/pytorch-fid. Not checked on a file of the program.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn

from ..bench.contracts import ByteArray, FloatArray
from .lpips_network import with_weights

SIDE = 299
"""Side of the network's input, pixels."""
FEATURES = 2048


class Inception:
    """The network with weights from a file."""

    def __init__(self, path: Path, device: str = "cpu") -> None:
        self._device = torch.device(device)
        self._network = with_weights(InceptionNetwork(), path).to(self._device)

    def __call__(self, images: Sequence[ByteArray]) -> FloatArray:
        """(N, 2048) features of (H, W, 3) 8-bit images."""
        pixels = torch.from_numpy(np.stack([resized(image) for image in images])).to(self._device)
        with torch.inference_mode():
            return np.asarray(self._network(((pixels - 128) / 128).permute(0, 3, 1, 2)).cpu().numpy())


def resized(image: ByteArray) -> FloatArray:
    """(299, 299, 3) float32 levels from 0 to 255: each channel resized by Pillow's bicubic filter, antialiased and not rounded."""
    channels = (Image.fromarray(image[..., i].astype(np.float32)) for i in range(3))
    planes = [np.asarray(c.resize((SIDE, SIDE), Image.Resampling.BICUBIC)) for c in channels]
    return np.stack(planes, axis=2).clip(0, 255)


class Convolution(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(
        self, inputs: int, outputs: int, kernel: tuple[int, int], stride: int = 1, *, padded: bool = True
    ) -> None:
        super().__init__()
        padding = (kernel[0] // 2, kernel[1] // 2) if padded else 0
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, h, w)."""
        return torch.relu(self.bn(self.conv(x)))


class Layer(NamedTuple):
    """Convolutions of one input: ``outputs`` channels for each of the kernels. With stride 2 they have no padding."""

    outputs: int
    kernels: tuple[tuple[int, int], ...] = ((1, 1),)
    stride: int = 1


class Mixed(nn.Module):
    """Chains of layers of one input, and a pooling with a 1 x 1 convolution if it has ``pooled`` channels; all joined."""

    def __init__(
        self, inputs: int, chains: Mapping[str, Sequence[Layer]], pool: nn.Module, pooled: int
    ) -> None:
        super().__init__()
        self._chains: list[list[list[str]]] = []
        for name, layers in chains.items():
            channels, chain = inputs, []
            for number, layer in enumerate(layers, 1):
                place = name if len(layers) == 1 else f"{name}_{number}"
                suffixes = "ab" if len(layer.kernels) > 1 else [""]
                for suffix, kernel in zip(suffixes, layer.kernels, strict=True):
                    padded = layer.stride == 1
                    part = Convolution(channels, layer.outputs, kernel, layer.stride, padded=padded)
                    self.add_module(f"{place}{suffix}", part)
                chain.append([f"{place}{suffix}" for suffix in suffixes])
                channels = layer.outputs
            self._chains.append(chain)
        self.pool = pool
        self.branch_pool = Convolution(inputs, pooled, (1, 1)) if pooled else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, C, h, w)."""
        outputs = []
        for chain in self._chains:
            branch = x
            for names in chain:
                branch = torch.cat([self.get_submodule(name)(branch) for name in names], dim=1)
            outputs.append(branch)
        return torch.cat([*outputs, self.branch_pool(self.pool(x))], dim=1)


ROW, COLUMN = (1, 7), (7, 1)
SQUARE = ((3, 3),)
HALVES = ((1, 3), (3, 1))


def _mean() -> nn.Module:
    return nn.AvgPool2d(3, 1, 1, count_include_pad=False)


def _at_35(inputs: int, pooled: int) -> Mixed:
    chains = {
        "branch1x1": [Layer(64)],
        "branch5x5": [Layer(48), Layer(64, ((5, 5),))],
        "branch3x3dbl": [Layer(64), Layer(96, SQUARE), Layer(96, SQUARE)],
    }
    return Mixed(inputs, chains, _mean(), pooled)


def _to_17() -> Mixed:
    chains = {
        "branch3x3": [Layer(384, SQUARE, 2)],
        "branch3x3dbl": [Layer(64), Layer(96, SQUARE), Layer(96, SQUARE, 2)],
    }
    return Mixed(288, chains, nn.MaxPool2d(3, 2), 0)


def _at_17(inner: int) -> Mixed:
    double = [Layer(inner), *(Layer(inner, (kernel,)) for kernel in (COLUMN, ROW, COLUMN))]
    chains = {
        "branch1x1": [Layer(192)],
        "branch7x7": [Layer(inner), Layer(inner, (ROW,)), Layer(192, (COLUMN,))],
        "branch7x7dbl": [*double, Layer(192, (ROW,))],
    }
    return Mixed(768, chains, _mean(), 192)


def _to_8() -> Mixed:
    chains = {
        "branch3x3": [Layer(192), Layer(320, SQUARE, 2)],
        "branch7x7x3": [Layer(192), Layer(192, (ROW,)), Layer(192, (COLUMN,)), Layer(192, SQUARE, 2)],
    }
    return Mixed(768, chains, nn.MaxPool2d(3, 2), 0)


def _at_8(inputs: int, pool: nn.Module) -> Mixed:
    chains = {
        "branch1x1": [Layer(320)],
        "branch3x3": [Layer(384), Layer(384, HALVES)],
        "branch3x3dbl": [Layer(448), Layer(384, SQUARE), Layer(384, HALVES)],
    }
    return Mixed(inputs, chains, pool, 192)


class InceptionNetwork(nn.Sequential):
    """The layers in order; their names are those of the file."""

    def __init__(self) -> None:
        super().__init__()
        parts: dict[str, nn.Module] = {
            "Conv2d_1a_3x3": Convolution(3, 32, (3, 3), 2, padded=False),
            "Conv2d_2a_3x3": Convolution(32, 32, (3, 3), padded=False),
            "Conv2d_2b_3x3": Convolution(32, 64, (3, 3)),
            "maxpool1": nn.MaxPool2d(3, 2),
            "Conv2d_3b_1x1": Convolution(64, 80, (1, 1)),
            "Conv2d_4a_3x3": Convolution(80, 192, (3, 3), padded=False),
            "maxpool2": nn.MaxPool2d(3, 2),
            "Mixed_5b": _at_35(192, 32),
            "Mixed_5c": _at_35(256, 64),
            "Mixed_5d": _at_35(288, 64),
            "Mixed_6a": _to_17(),
            "Mixed_6b": _at_17(128),
            "Mixed_6c": _at_17(160),
            "Mixed_6d": _at_17(160),
            "Mixed_6e": _at_17(192),
            "Mixed_7a": _to_8(),
            "Mixed_7b": _at_8(1280, _mean()),
            "Mixed_7c": _at_8(FEATURES, nn.MaxPool2d(3, 1, 1)),
            "avgpool": nn.AdaptiveAvgPool2d(1),
            "flat": nn.Flatten(),
        }
        for name, part in parts.items():
            self.add_module(name, part)
