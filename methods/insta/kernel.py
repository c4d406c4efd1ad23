"""The compiled kernel: nearest triangles, ray marching, hash encoding. Every part has a slow twin in torch."""

from __future__ import annotations

import functools
import importlib
import logging
from types import ModuleType

log = logging.getLogger(__name__)

REMEDY = "Install a C++17 compiler and reinstall headbench; the reference works meanwhile, very slowly."


@functools.cache
def load() -> ModuleType | None:
    """The kernel module, or None where it cannot be imported; then one warning per process says why."""
    try:
        return importlib.import_module("._kernel", __package__)
    except ImportError as error:
        log.warning("INSTA's kernel cannot be used (%s). %s", error, REMEDY)
        return None
