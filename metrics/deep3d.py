"""Deep3DFaceRecon, which estimates coefficients of the Basel Face Model from a picture.

Deng, Yang, Xu, Chen, Jia, Tong, "Accurate 3D Face Reconstruction with Weakly-Supervised Learning: From Single Image to Image
Set", CVPR Workshops 2019: ResNet-50 (He et al., 2016) with linear layers, with the parameter names of the authors' file, so that it
loads as it is. Only expression and rotation are computed, which need no face model.

Formats read:

- Weights of Deep3DFaceRecon (`epoch_20.pth`). Written by sicxu/Deep3DFaceRecon_pytorch. Not checked on a file of the program.
- Landmarks of its mean face (`similarity_Lm3D_all.mat`). Written by sicxu/Deep3DFaceRecon_pytorch. Not checked on a file of the
  program.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.io import loadmat
from torch import Tensor, nn

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import InputError
from ..bench.io.arrays import check_numbers
from ..bench.io.files import read_bytes, reading
from .lpips_network import with_weights

SIDE = 224
"""Side of the network's input, pixels."""
FACE = 102.0
"""Scale of the mean face in the input."""
EXPRESSIONS, ANGLES = 64, 3
LANDMARKS_FILE = "similarity_Lm3D_all.mat"


class Deep3D:
    """The network with weights from a file; the mean face's landmarks are in `LANDMARKS_FILE` in the same folder."""

    def __init__(self, path: Path):
        self._mean_face = five_corners(read_landmarks(path.with_name(LANDMARKS_FILE)))
        self._network = with_weights(CoefficientNetwork(), path, "net_recon")

    def __call__(self, image: ByteArray, landmarks: FloatArray) -> FloatArray:
        """(67,) coefficients of the face in an (H, W, 3) 8-bit RGB image with (68, 2) landmarks of 300-W, pixels.

        First the 64 of the expression, then three angles in radians.
        """
        crop = aligned(image, five_corners(landmarks), self._mean_face)
        x = torch.from_numpy(crop).permute(2, 0, 1)[None] / 255
        with torch.inference_mode():
            return self._network(x)[0].numpy().astype(float)


class Bottleneck(nn.Module):
    """Residual block of a 3 x 3 convolution between two 1 x 1 convolutions."""

    def __init__(self, inputs: int, width: int, stride: int, *, first: bool) -> None:
        super().__init__()
        outputs = 4 * width
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if first:
            self.downsample.extend(
                [nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)]
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, 4 * width, H / stride, W / stride)."""
        inner = torch.relu(self.bn1(self.conv1(x)))
        inner = torch.relu(self.bn2(self.conv2(inner)))
        return torch.relu(self.bn3(self.conv3(inner)) + self.downsample(x))


def _stage(inputs: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    rest = [Bottleneck(4 * width, width, 1, first=False) for _ in range(blocks - 1)]
    return nn.Sequential(Bottleneck(inputs, width, stride, first=True), *rest)


class Backbone(nn.Module):
    """ResNet-50 without its classifier."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = _stage(64, 64, 3, 1)
        self.layer2 = _stage(256, 128, 4, 2)
        self.layer3 = _stage(512, 256, 6, 2)
        self.layer4 = _stage(1024, 512, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, 3, H, W) to (N, 2048, 1, 1), means over pixels."""
        x = self.maxpool(torch.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return x.mean(dim=(2, 3), keepdim=True)


class CoefficientNetwork(nn.Module):
    """The backbone, and the linear layers of expression and rotation, by their numbers in the authors' list."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone()
        self.final_layers = nn.ModuleDict(
            {"1": nn.Conv2d(2048, EXPRESSIONS, 1), "3": nn.Conv2d(2048, ANGLES, 1)}
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, 3, 224, 224) RGB in [0, 1] to (N, 67) coefficients."""
        features = self.backbone(x)
        return torch.cat([layer(features) for layer in self.final_layers.values()], dim=1).flatten(1)


def five_corners(landmarks: FloatArray) -> FloatArray:
    """(5, D) middles between the corners of each eye, tip of the nose and corners of the mouth, from (68, D) landmarks of 300-W."""
    eyes = [landmarks[[36, 39]].mean(axis=0), landmarks[[42, 45]].mean(axis=0)]
    return np.stack([*eyes, landmarks[30], landmarks[48], landmarks[54]])


def aligned(image: ByteArray, points: FloatArray, mean_face: FloatArray) -> ByteArray:
    """(224, 224, 3) crop of an image at the authors' scale and place, black outside of the image.

    The affine map from the (5, 3) mean face to the (5, 2) points, in least squares, has the place of the mean face's origin and the
    scale, the mean length of its two rows.
    """
    height, width = image.shape[:2]
    upwards = np.stack([points[:, 0], height - 1 - points[:, 1]], axis=1)
    map_of_face, *_ = np.linalg.lstsq(
        np.column_stack([mean_face, np.ones(len(mean_face))]), upwards, rcond=None
    )
    x, y = map_of_face[3]
    scale = FACE / np.linalg.norm(map_of_face[:3], axis=0).mean()
    size = int(width * scale), int(height * scale)
    left = int(size[0] / 2 - SIDE / 2 + (x - width / 2) * scale)
    top = int(size[1] / 2 - SIDE / 2 + (height / 2 - y) * scale)
    resized = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
    return np.array(resized.crop((left, top, left + SIDE, top + SIDE)))


def read_landmarks(path: Path) -> FloatArray:
    """Read (68, 3) landmarks from a file of MATLAB."""
    expected = "a file of MATLAB with the entry lm of shape (68, 3), of the project Deep3DFaceRecon_pytorch"
    content = read_bytes(path, expected)
    with reading(path, expected):
        landmarks = np.array(loadmat(io.BytesIO(content))["lm"], float)
    if landmarks.shape != (68, 3):
        raise InputError(path, "lm", expected, f"shape {landmarks.shape}")
    check_numbers(path, "lm", landmarks)
    return landmarks
