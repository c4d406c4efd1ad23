"""Settings of the comparison with an official repository."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from ....bench.engine.config import parse_size
from ....bench.executors.settings import ExecutionOptions
from ....bench.options import DependentOptions

WITHOUT_PERCEPTUAL_LOSS = 15_000
"""Iterations up to which the authors' code of FlashAvatar has no perceptual loss, which the native method never has."""


@dataclass(frozen=True)
class ParitySettings(ExecutionOptions):
    """Trains both on one capture with the published settings for a run of this length and the same image in each iteration, and
    scores all renders by one implementation of the metrics. This is repeated with other orders of the images, since the order
    itself changes results by half a decibel. Writes parity.md, parity.json and the run. The same command continues a run that
    was killed. Exit code 1: the mean PSNR over orders differs by more than the tolerance, or a training failed.
    """

    method: tyro.conf.Positional[Literal["flashavatar", "ga", "gbs", "ours", "rgbavatar"]]
    """The native method. The authors' code of method ours is TensorialGaussianAvatar (`tga-official`)."""

    checkout: str
    """Folder of a checkout of the authors' repository; it is not changed."""

    out: str
    """Folder to write."""

    data: str | None = None
    """Capture to train on, of one subject or several. Default: a synthetic one is made in OUT/capture, of --subjects heads, SIZE, with
    --cameras and --timesteps."""

    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""

    iterations: int = 1_000
    """Length of each training; with rgbavatar, steps of ten images."""

    orders: int = 5
    """Number of orders of the images, each with one training of either method. A single order on one capture gives no interval."""

    device: Literal["cuda", "cpu-shim"] = "cuda"
    """Device of the authors' code: CUDA, or headbench's CPU renderer instead of its rasteriser
    (docs/explanation/methods/official.md), which shows differences of training and head model, not of the rasterisers."""

    python: str = ""
    """Interpreter for the authors' code, as settings.ga-official.python of `headbench run`. Default with cpu-shim: this one."""

    commit: str | None = None
    """Expected commit; default: the one that the adapter was written for; "" accepts any."""

    frames: int | None = None
    """Held-out frames scored for each task, evenly spread; default: all."""

    tolerance: float = 0.3
    """Difference of PSNR, in decibels, within which the two count as equivalent; also the limit of the mean difference."""

    samples: int | None = None
    """Number of splats on the head. gbs: initial number, 5,000 by default; published: 50,000, whose differences for each expression
    take gigabytes. flashavatar: 13,500 by default, as published; others only on heads of another topology than FLAME's.
    rgbavatar: the same, 60,000 by default."""

    subjects: int = 2
    """Heads of the synthetic capture; both methods are trained on each with every order."""

    size: str = "96x136"
    """Width x height of the synthetic capture's images in pixels."""

    cameras: int = 8
    """Views of the synthetic capture, including the held-out one."""

    timesteps: int = 24
    """Timesteps of the synthetic capture."""

    dependent = (
        DependentOptions(("subjects", "size", "cameras", "timesteps"), "data", False),
        DependentOptions(("samples",), "method", ("flashavatar", "gbs", "rgbavatar")),
    )

    def __post_init__(self) -> None:
        """Raise ValueError for invalid settings."""
        parse_size(self.size)
        if self.method == "flashavatar" and self.iterations > WITHOUT_PERCEPTUAL_LOSS:
            raise ValueError(
                f"iterations must be at most {WITHOUT_PERCEPTUAL_LOSS} with flashavatar, as the native method has no perceptual loss"
            )
        if (
            min(self.iterations, self.orders, self.subjects) < 1
            or (self.samples is not None and self.samples < 10)
            or not self.tolerance > 0
        ):
            raise ValueError(
                "iterations, orders and subjects must be at least 1, samples 10, the tolerance above 0"
            )
