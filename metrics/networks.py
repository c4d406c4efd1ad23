"""The convolutional parts of AlexNet, SqueezeNet 1.1 and VGG-16, tapped where LPIPS reads them.

Parameter names are torchvision's (``features.0.weight``, ...), so its published weights load as they are; the
classifiers are left out. Architectures: Krizhevsky, "One weird trick for parallelizing convolutional neural
networks", 2014; Iandola et al., "SqueezeNet", 2016 (release 1.1); Simonyan, Zisserman, "Very deep convolutional
networks for large-scale image recognition", 2015 (configuration D).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn


class Fire(nn.Module):
    """SqueezeNet's module: a 1 x 1 squeeze, then 1 x 1 and 3 x 3 expansions side by side."""

    def __init__(self, inputs: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, 2 expand, H, W)."""
        x = torch.relu(self.squeeze(x))
        return torch.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class TappedNetwork(nn.Module):
    """A chain of layers that also returns what some of them put out."""

    def __init__(self, layers: list[nn.Module], taps: tuple[int, ...]) -> None:
        super().__init__()
        self.features = nn.Sequential(*layers[: taps[-1] + 1])
        self.taps = taps

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map (N, 3, H, W) to the output of each tapped layer, shallow to deep."""
        outputs: list[Tensor] = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.taps:
                outputs.append(x)
        return outputs


@dataclass(frozen=True)
class NetworkSpec:
    """A feature network of LPIPS and where its weights are published.

    Attributes
    ----------
    name : as `Lpips` and the files of linear layers call it.
    channels : of each tapped layer, shallow to deep.
    smallest : pixels that height and width must have for the deepest layer to see anything.
    file : published name; its last part before the suffix begins the SHA-256 of the content.
    features_file : customary name of a file with the convolutional part alone.
    """

    name: str
    channels: tuple[int, ...]
    smallest: int
    file: str
    features_file: str

    @property
    def url(self) -> str:
        """Where PyTorch publishes the weights."""
        return f"https://download.pytorch.org/models/{self.file}"

    @property
    def sha256_prefix(self) -> str:
        """The first digits of the file's SHA-256."""
        return self.file.removesuffix(".pth").rpartition("-")[2]

    def build(self) -> TappedNetwork:
        """Make the network, weights not yet meaningful."""
        return {"alex": _alexnet, "squeeze": _squeezenet, "vgg": _vgg16}[self.name]()


ALEX = NetworkSpec("alex", (64, 192, 384, 256, 256), 31, "alexnet-owt-7be5be79.pth", "alexnet_features.pth")
SQUEEZE = NetworkSpec(
    "squeeze",
    (64, 128, 256, 384, 384, 512, 512),
    17,
    "squeezenet1_1-b8a52dc0.pth",
    "squeezenet1_1_features.pth",
)
VGG = NetworkSpec("vgg", (64, 128, 256, 512, 512), 16, "vgg16-397923af.pth", "vgg16_features.pth")
NETWORKS = {spec.name: spec for spec in (ALEX, SQUEEZE, VGG)}


def _alexnet() -> TappedNetwork:
    layers: list[nn.Module] = [
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(inplace=True),
    ]
    return TappedNetwork(layers, (1, 4, 7, 9, 11))


def _squeezenet() -> TappedNetwork:
    layers: list[nn.Module] = [
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(64, 16, 64),
        Fire(128, 16, 64),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(128, 32, 128),
        Fire(256, 32, 128),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(256, 48, 192),
        Fire(384, 48, 192),
        Fire(384, 64, 256),
        Fire(512, 64, 256),
    ]
    return TappedNetwork(layers, (1, 4, 7, 9, 10, 11, 12))


def _vgg16() -> TappedNetwork:
    layers: list[nn.Module] = []
    inputs = 3
    for block, (channels, repeats) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        if block:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(repeats):
            layers += [nn.Conv2d(inputs, channels, 3, padding=1), nn.ReLU(inplace=True)]
            inputs = channels
    return TappedNetwork(layers, (3, 8, 15, 22, 29))
