"""FID: Fréchet distance between the features of renders and of ground truth, as Gaussian distributions.

Heusel, Ramsauer, Unterthiner, Nessler, Hochreiter, "GANs Trained by a Two Time-Scale Update Rule Converge to a Local Nash
Equilibrium", NeurIPS 2017. Images are resized as by the mode "clean" of Parmar, Zhang, Zhu, "On Aliased Resizing and Surprising
Subtleties in GAN Evaluation", CVPR 2022.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import UnavailableError
from ..bench.machine import use_device
from ..bench.specs import MetricSpec, Need
from .faces import named_file, network_need
from .psnr import check_pair

if TYPE_CHECKING:
    from .inception import Inception

VARIABLE = "HEADBENCH_INCEPTION"
BATCH = 4
"""Number of pairs that the network is given at a time."""
REMEDY = (
    f"Set {VARIABLE} to the file pt_inception-2015-12-05-6726825d.pth, which the project pytorch-fid (mseitzer on GitHub) publishes "
    "with its releases."
)


class Fid:
    """Fréchet distance of the 2048 features of Inception V3 of all frames of a task, resized as clean-fid does by Pillow's bicubic filter.

    The trace of the matrix square root is a sum of singular values, which is exact, too, for fewer frames than features; clean-fid
    takes the root of a singular matrix then. FID falls with the number of frames: only values of equal numbers are comparable.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._device = device

    def on(self, device: str) -> Fid:
        """This metric on another device; on a GPU in float32 without TF32."""
        return Fid(device)

    def __call__(self, pairs: Iterable[tuple[ByteArray, ByteArray]]) -> float:
        """FID of pairs of an (H, W, 3) 8-bit image and its ground truth. Raises `UnavailableError` for fewer than two."""
        network = _network(named_file("FID", VARIABLE, REMEDY), self._device)
        features: list[FloatArray] = []
        left = iter(pairs)
        while batch := list(islice(left, BATCH)):
            for pair in batch:
                check_pair(*pair)
            features.append(network([image for pair in batch for image in pair]))
        if sum(map(len, features)) < 4:
            raise UnavailableError("FID needs at least two frames.", "Score more frames.")
        joined = np.concatenate(features)
        features.clear()
        return frechet_distance(joined[::2], joined[1::2])


def frechet_distance(first: FloatArray, second: FloatArray) -> float:
    """Squared Fréchet distance of the normal distributions with the means and covariances of two (N, D) samples."""
    means = [sample.mean(axis=0, dtype=np.float64) for sample in (first, second)]
    apart = np.square(means[0] - means[1]).sum()
    a, b = (_root(sample, mean) for sample, mean in zip((first, second), means))
    # The trace of (A^T A B^T B)^(1/2) is the sum of the singular values of A B^T.
    spread = np.square(a).sum() + np.square(b).sum() - 2 * np.linalg.norm(a @ b.T, "nuc")
    return max(0.0, float(apart + spread))


def _root(sample: FloatArray, mean: FloatArray) -> FloatArray:
    """A matrix R of at most D rows, where R^T R is the covariance of an (N, D) sample; D rows at a time, to save memory."""
    size = sample.shape[1]
    root = np.empty((0, size))
    for start in range(0, len(sample), size):
        part = sample[start : start + size] - mean
        root = np.asarray(np.linalg.qr(np.concatenate([root, part]), mode="r"))
    return root / math.sqrt(len(sample) - 1)


@functools.cache
def _network(path: Path, device: str) -> Inception:
    from .inception import Inception  # imports torch

    use_device(device)
    return Inception(path, device)


def needs(config: object, device: str) -> Iterator[Need]:
    """The network's file."""
    yield network_need("weights of Inception V3, for FID", VARIABLE, REMEDY, _inception)


def _inception() -> Inception:
    from .inception import Inception

    return Inception(named_file("FID", VARIABLE, REMEDY))


FID = MetricSpec(
    name="fid",
    label="FID",
    unit="",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.fid:Fid",
    summary="Fréchet distance of Inception V3's features of all frames of a subject and task, resized as by clean-fid.",
    kind="set",
    needs="headbench.metrics.fid:needs",
)
