"""JOD: predicted video quality of a sequence in just-objectionable differences, by FovVideoVDP or ColorVideoVDP.

R. Mantiuk et al., "FovVideoVDP: A visible difference predictor for wide field-of-view video", ACM Transactions on Graphics 40(4), 2021.
R. Mantiuk et al., "ColorVideoVDP: A visual difference predictor for image, video and display distortions", ACM Transactions on Graphics
43(4), 2024. The programs are not dependencies: the licence of the first (CC BY-NC 4.0) excludes commercial use, and the second needs
torchvision.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.errors import UnavailableError
from ..bench.specs import MetricSpec, Need
from .psnr import check_pair

DISPLAY = "standard_4k"
RATE = 24.3
"""Frames per second of the NeRSemble benchmark's videos of avatars; captures do not record theirs."""


class Jod:
    """JOD of a sequence of 8-bit frames by FovVideoVDP, computed as by the NeRSemble benchmark's first author.

    Raises `UnavailableError` without the package.
    """

    package, program = "pyfvvdp", "fvvdp"
    modules: tuple[str, ...] = ("pyfvvdp", "ffmpeg")
    remedy = (
        "If its licence (CC BY-NC 4.0: no commercial use) suits you, install it: pip install pyfvvdp==1.2.2."
    )

    def __call__(self, images: Sequence[ByteArray], targets: Sequence[ByteArray]) -> float:
        """JOD, at most 10, of (H, W, 3) frames in temporal order; a single frame is a still image."""
        for image, target in zip(images, targets, strict=True):
            check_pair(image, target)
        program = _program(self.package, self.program, self.remedy)
        rate = RATE if len(images) > 1 else 0  # still image
        stacks = np.stack(images), np.stack(targets)
        jod, _ = program.predict(*stacks, dim_order="FHWC", frames_per_second=rate)
        return float(jod)


class ColorJod(Jod):
    """JOD by ColorVideoVDP, which also models colour differences."""

    package, program = "pycvvdp", "cvvdp"
    modules = ("pycvvdp", "torchvision", "ffmpeg")
    remedy = "Install it with the torchvision that belongs to the installed PyTorch (MIT licence): pip install cvvdp==0.5.7."


@cache
def _program(package: str, name: str, remedy: str) -> Any:
    before = list(sys.path)
    try:
        module = import_module(package)
    except Exception as error:  # a torchvision for another PyTorch raises errors other than ImportError
        what = f"JOD needs the Python package {package}, which cannot be imported: {error}."
        raise UnavailableError(what, remedy) from error
    finally:
        sys.path[:] = before  # the packages append their own folders
    return getattr(module, name)(display_name=DISPLAY, heatmap=None, quiet=True)


def _needs(metric: type[Jod]) -> Iterator[Need]:
    installed = all(find_spec(name) is not None for name in metric.modules)
    yield Need(
        f"{' and '.join(metric.modules)}, for JOD",
        "installed" if installed else "",
        metric.remedy,
        required=False,
    )


def needs(config: Any, device: str) -> Iterator[Need]:
    """The package pyfvvdp and its dependencies."""
    return _needs(Jod)


def color_needs(config: Any, device: str) -> Iterator[Need]:
    """The package pycvvdp and its dependencies."""
    return _needs(ColorJod)


def _spec(name: str, label: str, by: str, implementation: str, needs: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label=label,
        unit="",
        higher_is_better=True,
        digits=2,
        implementation=f"headbench.metrics.jod:{implementation}",
        summary=f"{by} of each sequence and camera as a video of {RATE} frames per second on a 4K display; 10 is equal.",
        kind="sequence",
        needs=f"headbench.metrics.jod:{needs}",
    )


JOD = _spec("jod", "JOD", "FovVideoVDP 1.2, not foveated,", "Jod", "needs")
JOD_COLOR = _spec("jod-color", "JOD (colour)", "ColorVideoVDP 0.5", "ColorJod", "color_needs")
