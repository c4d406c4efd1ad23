"""Requirements of the synthetic capture on the machine, for `DatasetSpec.needs`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...bench.specs import Need


def needs(config: Any, device: str) -> Iterator[Need]:
    """The kernel that renders the pictures."""
    from .panels import KERNEL

    yield KERNEL.need()
