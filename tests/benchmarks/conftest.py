"""Fixtures of the packages that the benchmarks measure."""

from ..methods.conftest import clip, head
from ..metrics.conftest import bare_machine

__all__ = ["bare_machine", "clip", "head"]
