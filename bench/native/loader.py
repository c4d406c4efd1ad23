"""Loads compiled kernels, which may be missing, for example without a C++ compiler at installation."""

from __future__ import annotations

import functools
import importlib
import logging
from functools import cached_property
from types import ModuleType

from ..errors import UnavailableError
from ..specs import Need

log = logging.getLogger(__name__)


class Kernel:
    """A compiled module, imported when first used.

    Parameters
    ----------
    module : str
        Absolute name of the module, built by ``bench/native/kernel.cmake``.
    label : str
        Name of the kernel in messages.
    substitute : str
        Replacement used without the kernel; "" if there is none and its users raise an error.
    """

    def __init__(self, module: str, label: str, substitute: str = "") -> None:
        self.module, self.label, self.required = module, label, not substitute
        remedy = "Install a C++17 compiler and Python's headers, and reinstall headbench"
        self.remedy = f"{remedy}; {substitute}." if substitute else f"{remedy}."

    @cached_property
    def imported(self) -> ModuleType | ImportError:
        """The module, or the reason why it cannot be imported."""
        try:
            return importlib.import_module(self.module)
        except ImportError as error:
            return error

    def load(self) -> ModuleType:
        """The module. Raises `UnavailableError` if it is missing."""
        if isinstance(self.imported, ImportError):
            raise UnavailableError(f"{self.label} is not available: {self.imported}.", self.remedy)
        return self.imported

    def load_or_warn(self) -> ModuleType | None:
        """The module; None if it is missing, with one warning per process that gives the reason."""
        if isinstance(self.imported, ImportError):
            _warn_once(self.label, str(self.imported), self.remedy)
            return None
        return self.imported

    def need(self) -> Need:
        """The kernel as a requirement for ``needs`` of a spec; optional if there is a substitute."""
        found = "" if isinstance(self.imported, ImportError) else ", ".join(self.instruction_sets) or "there"
        return Need(self.label, found, self.remedy, required=self.required)

    @cached_property
    def instruction_sets(self) -> tuple[str, ...]:
        """Variants that run on this machine, the fastest first; empty if the module is missing."""
        found = self.imported
        return () if isinstance(found, ImportError) else tuple(found.instruction_sets())


@functools.cache
def _warn_once(label: str, reason: str, remedy: str) -> None:
    log.warning("%s cannot be used (%s). %s", label, reason, remedy)
