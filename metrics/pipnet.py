"""PIPNet, which detects the 98 landmarks of the WFLW benchmark.

Jin, Liao, Shao, "Pixel-in-Pixel Net: Towards Efficient Facial Landmark Detection in the Wild", International Journal of
Computer Vision, 2021: the network with ResNet-18 (He et al., 2016), stride 32 and 10 neighbours, with the parameter names of
the authors' file, so that it loads as it is.

Formats read:

- Weights of PIPNet (WFLW, ResNet-18). Written by jhb86253817/PIPNet. Not checked on a file of the program.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from ..bench.contracts import ByteArray, FloatArray, IntArray
from ..bench.errors import InputError
from ..bench.io.arrays import check_numbers
from ..bench.io.files import read_bytes, reading
from .lpips_network import with_weights

COUNT = 98
NEIGHBOURS = 10
SIDE = 256
"""Side of the network's input, pixels."""
SCALE = 1.2
"""Width of the crop, relative to that of the face's bounding box."""
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
MEAN_FACE = "meanface.txt"


class PipNet:
    """The network with weights from a file; the mean face is in the file `MEAN_FACE` in the same folder."""

    def __init__(self, path: Path):
        self._mean_face = read_mean_face(path.with_name(MEAN_FACE))
        self._votes = votes(self._mean_face)
        self._network = with_weights(Network(), path)

    def __call__(self, image: ByteArray, landmarks: FloatArray) -> FloatArray | None:
        """As `find_in`, in the box of (N, 2) landmarks of a face, which extend from ear to ear and from brows to chin."""
        return self.find_in(image, face_box(landmarks, self._mean_face))

    def find_in(self, image: ByteArray, box: IntArray) -> FloatArray | None:
        """(98, 2) landmarks in pixels of an (H, W, 3) 8-bit RGB image, or None if the box does not overlap the image.

        ``box`` is the bounding box of a face (left, top, width, height), whole pixels. The crop is that of
        the authors' demo: with margins at the left, right and bottom, and less of the forehead.
        """
        left, top, width, height = map(int, box)
        beside, below = (int(size * (SCALE - 1) / 2) for size in (width, height))
        right = min(left + width - 1 + beside, image.shape[1] - 1)
        bottom = min(top + height - 1 + below, image.shape[0] - 1)
        left, top = max(left - beside, 0), max(top + below, 0)
        if right <= left or bottom <= top:
            return None
        crop = (
            torch.from_numpy(cv2.resize(image[top:bottom, left:right], (SIDE, SIDE))).permute(2, 0, 1) / 255
        )
        x = (crop - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(DEVIATION).view(3, 1, 1)
        with torch.inference_mode():
            maps = [one[0].numpy() for one in self._network(x[None])]
        return decode(maps, self._votes) * (right - left + 1, bottom - top + 1) + (left, top)


class Block(nn.Module):
    """Residual block of two 3 x 3 convolutions."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if inputs != outputs:
            self.downsample.extend(
                [nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)]
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        residual = self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))
        return torch.relu(residual + self.downsample(x))


class Network(nn.Module):
    """ResNet-18 without its last two layers, and five 1 x 1 convolutions of its features."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = nn.Sequential(Block(64, 64, 1), Block(64, 64, 1))
        self.layer2 = nn.Sequential(Block(64, 128, 2), Block(128, 128, 1))
        self.layer3 = nn.Sequential(Block(128, 256, 2), Block(256, 256, 1))
        self.layer4 = nn.Sequential(Block(256, 512, 2), Block(512, 512, 1))
        self.cls_layer = nn.Conv2d(512, COUNT, 1)
        self.x_layer = nn.Conv2d(512, COUNT, 1)
        self.y_layer = nn.Conv2d(512, COUNT, 1)
        self.nb_x_layer = nn.Conv2d(512, COUNT * NEIGHBOURS, 1)
        self.nb_y_layer = nn.Conv2d(512, COUNT * NEIGHBOURS, 1)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map (N, 3, H, W) to the five maps of `decode`, each (N, C, H / 32, W / 32)."""
        x = self.maxpool(torch.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        layers = self.cls_layer, self.x_layer, self.y_layer, self.nb_x_layer, self.nb_y_layer
        return [layer(x) for layer in layers]


def decode(maps: list[FloatArray], votes: IntArray) -> FloatArray:
    """(98, 2) landmarks in the crop, from 0 to 1.

    The cell with the highest score of a landmark predicts its position and those of its neighbours. The result is the mean
    of a landmark's own prediction and the ``votes`` for it by others.

    - ``maps``: (98, S, S) scores of cells, x and y in the cell, and (980, S, S) x and y of each landmark's neighbours.
    - ``votes``: (98, V) indices, see `votes`.
    """
    scores, x, y, neighbour_x, neighbour_y = maps
    best = scores.reshape(len(scores), -1).argmax(axis=1)
    positions = _places(x, y, best)
    neighbours = _places(neighbour_x, neighbour_y, np.repeat(best, NEIGHBOURS))
    return np.concatenate([positions[:, None], neighbours[votes]], axis=1).mean(axis=1)


def _places(x: FloatArray, y: FloatArray, cells: IntArray) -> FloatArray:
    """(N, 2) positions, from 0 to 1, from (N, S, S) offsets in the cell of each, one of S * S."""
    rows, columns = np.divmod(cells, x.shape[2])
    each = np.arange(len(cells)), rows, columns
    return np.stack([(columns + x[each]) / x.shape[2], (rows + y[each]) / x.shape[1]], axis=1)


def votes(mean_face: FloatArray) -> IntArray:
    """(98, V) indices into the 980 neighbour predictions: those for a landmark, repeated up to V, the maximum of any landmark.

    The neighbours of a landmark are the `NEIGHBOURS` nearest to it in the (98, 2) mean face.
    """
    neighbours = _neighbours(mean_face).ravel()
    voters = [np.flatnonzero(neighbours == landmark) for landmark in range(COUNT)]
    return np.stack([np.resize(one, max(map(len, voters))) for one in voters])


def _neighbours(mean_face: FloatArray) -> IntArray:
    """(98, 10) nearest landmarks, the nearest first."""
    distances = np.square(mean_face[:, None] - mean_face).sum(axis=2)
    return np.argsort(distances, axis=1, kind="stable")[:, 1 : NEIGHBOURS + 1]


def face_box(landmarks: FloatArray, mean_face: FloatArray) -> IntArray:
    """(4,) box for `PipNet.find_in` such that (N, 2) landmarks have the extent of the mean face in its crop."""
    crop = np.ptp(landmarks, axis=0) / np.ptp(mean_face, axis=0)
    size = crop / (SCALE, 1)
    corner = landmarks.min(axis=0) - mean_face.min(axis=0) * crop + size * (SCALE - 1) / 2 * (1, -1)
    return np.rint([*corner, *size]).astype(int)


def read_mean_face(path: Path) -> FloatArray:
    """Read (98, 2) positions in the crop, from 0 to 1, from a text file of 196 numbers."""
    expected = f"the {2 * COUNT} numbers of the project PIPNet's file data/WFLW/meanface.txt"
    text = read_bytes(path, expected)
    with reading(path, expected):
        numbers = np.array(text.split(), float)
    if numbers.size != 2 * COUNT:
        raise InputError(path, "", expected, f"{numbers.size}")
    check_numbers(path, "", numbers, 1, 0)
    places = numbers.reshape(COUNT, 2)
    if not np.ptp(places, axis=0).all():
        raise InputError(path, "", expected, "landmarks on a line")
    if len(np.unique(_neighbours(places))) < COUNT:
        raise InputError(path, "", expected, "a landmark that is the neighbour of none")
    return places
