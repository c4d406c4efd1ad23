"""What the synthetic capture needs of a machine, for `DatasetSpec.needs`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...bench.specs import Need


def needs(config: Any, device: str) -> Iterator[Need]:
    """Mitsuba, which traces the pictures, and the kernel of the second edition's light."""
    try:
        import mitsuba

        from .renderer import VARIANT

        found = str(mitsuba.__version__) if VARIANT in mitsuba.variants() else ""
    except ImportError as error:
        yield Need("Mitsuba", "", f"Install headbench again, with its dependencies ({error}).")
        return
    yield Need("Mitsuba", found, f"Install a build of it with the variant {VARIANT}.")
    from .panels import KERNEL

    yield KERNEL.need()
