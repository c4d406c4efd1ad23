"""JOD of FovVideoVDP: predicted quality of a sequence as a video, in just-objectionable differences.

R. Mantiuk et al., "FovVideoVDP: A visible difference predictor for wide field-of-view video", ACM Transactions on Graphics 40(4), 2021.
The program is not a dependency, since its licence (CC BY-NC 4.0) excludes commercial use.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.errors import UnavailableError
from ..bench.specs import MetricSpec, Need
from .pairs import check_pair

DISPLAY = "standard_4k"
RATE = 24.3
"""Frames per second of the NeRSemble benchmark's videos of avatars; captures do not record theirs."""
REMEDY = "If its licence (CC BY-NC 4.0: no commercial use) suits you, install it: pip install pyfvvdp==1.2.2."

JOD = MetricSpec(
    name="jod",
    label="JOD",
    unit="",
    higher_is_better=True,
    digits=2,
    implementation="headbench.metrics.jod:Jod",
    summary=f"FovVideoVDP 1.2 of each sequence and camera as a video of {RATE} frames a second on a 4K display, not foveated; 10 is equal.",
    kind="sequence",
    needs="headbench.metrics.jod:needs",
)


class Jod:
    """JOD of a sequence of 8-bit frames against its ground truth, as the NeRSemble benchmark's first author computes it.

    Raises `UnavailableError` without the package.
    """

    def __call__(self, images: Sequence[ByteArray], targets: Sequence[ByteArray]) -> float:
        """JOD, at most 10, of (H, W, 3) frames in the order of time; a single frame is a still picture."""
        for image, target in zip(images, targets, strict=True):
            check_pair(image, target)
        program = _program()
        rate = RATE if len(images) > 1 else 0  # a still picture has none
        stacks = np.stack(images), np.stack(targets)
        found, _ = program.predict(*stacks, dim_order="FHWC", frames_per_second=rate)
        return float(found)


@cache
def _program() -> Any:
    before = list(sys.path)
    try:
        import pyfvvdp
    except ImportError as error:
        raise UnavailableError(
            f"JOD needs the Python package {error.name}; it is not installed.", REMEDY
        ) from error
    finally:
        sys.path[:] = before  # which it extends by its own folder
    return pyfvvdp.fvvdp(display_name=DISPLAY, heatmap=None, quiet=True)


def needs(config: Any, device: str) -> Iterator[Need]:
    """The package pyfvvdp."""
    found = find_spec("pyfvvdp") is not None
    yield Need("pyfvvdp, for JOD", "installed" if found else "", REMEDY, required=False)
