"""Chooses between the torch definition and the compiled kernel of an operation; no other module checks devices of tensors.

The definition of an operation is a function of torch tensors that runs on every device and in float64. It may have one
compiled form, for float32 in host memory.
"""

from __future__ import annotations

import functools
import importlib
import logging
from collections.abc import Callable
from functools import cached_property
from types import ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

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


P = ParamSpec("P")
Result = TypeVar("Result")
Tensor = Any
"""A torch tensor; this package does not import torch."""


def is_cuda(device: object) -> bool:
    """Whether a device, or its name, is a CUDA device."""
    return str(device).split(":")[0] == "cuda"


def on_host(values: Tensor) -> bool:
    """Whether a tensor is in host memory, accessible to numpy and kernels."""
    return str(values.device) == "cpu"


def is_float32(values: Tensor) -> bool:
    """Whether a tensor has the dtype of compiled forms."""
    return str(values.dtype) == "torch.float32"


def fits(kernel: Kernel, values: Tensor) -> bool:
    """Whether the kernel is available and accepts this tensor; if it is missing, a warning is logged once."""
    return on_host(values) and is_float32(values) and kernel.load_or_warn() is not None


def pinned(values: Tensor, device: object) -> Tensor:
    """Copy to pinned host memory for asynchronous copies to a CUDA device; unchanged for other devices."""
    return values.pin_memory() if is_cuda(device) else values


def to_device(values: Tensor, device: object) -> Tensor:
    """Copy host memory to a device, asynchronously for CUDA."""
    return pinned(values, device).to(device, non_blocking=True)


class Operation(Generic[P, Result]):
    """Decorates the definition of a function of tensors, which may have a compiled form.

    The compiled form runs if `fits` is true for the first tensor: the first argument, or its first element if that is a
    tuple.

    Attributes
    ----------
    kernel_form : Callable | None
        The compiled form, if there is one.
    """

    def __init__(self, definition: Callable[P, Result]) -> None:
        functools.update_wrapper(self, definition)
        self.definition = definition
        self.kernel_form: Callable[P, Result] | None = None

    def compiled(self, kernel: Kernel) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
        """Decorate the compiled form, which uses ``kernel``."""

        def register(form: Callable[P, Result]) -> Callable[P, Result]:
            self.kernel_form, self._kernel = form, kernel
            return form

        return register

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> Result:
        """Run the form for the first tensor."""
        first: Any = args[0]
        while isinstance(first, tuple):
            first = first[0]
        if self.kernel_form is not None and fits(self._kernel, first):
            return self.kernel_form(*args, **kwargs)
        return self.definition(*args, **kwargs)
