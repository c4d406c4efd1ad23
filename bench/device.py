"""Whether the device that a run asks for is there, found out before any work."""

from __future__ import annotations

from typing import Any

from .errors import HeadbenchError, InputError
from .registry import resolve


def check_device(device: str) -> None:
    """Raise `InputError` unless torch can use ``device`` ("cpu", "cuda", "cuda:1", "mps", "xpu").

    The CPU needs no question; for others torch is asked by name, as this room knows it no more than it knows methods.
    """
    kind, _, index = device.partition(":")
    if kind == "cpu":
        return
    try:
        backend: Any = resolve(f"torch:{kind}")
        available = bool(backend.is_available())
    except HeadbenchError:  # a torch that never heard of this kind, or none at all
        available = False
    if not available:
        remedy = "Use device=cpu, or install a torch and a driver that support it."
        raise InputError("device", kind, f"a device for {device!r}", "none that torch can use", remedy)
    count = int(backend.device_count())
    if index and int(index) >= count:
        raise InputError("device", device, f"a number from 0 to {count - 1}", index)
