"""Requirements of the trackers of other authors on the machine, for ``headbench doctor``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...bench.configuration import build
from ...bench.errors import InputError
from ...bench.specs import Need
from .programs import PROGRAMS, check_checkout, check_interpreter


@dataclass(frozen=True)
class ProgramPlace:
    """Where a tracker is installed."""

    checkout: str = ""
    """Folder of its repository."""

    python: str = "python3"
    """Interpreter of its environment."""


def vhap(settings: Mapping[str, Any], device: str) -> Iterator[Need]:
    """Checkout of VHAP with FLAME, and its environment."""
    return _needs("vhap", settings)


def pixel3dmm(settings: Mapping[str, Any], device: str) -> Iterator[Need]:
    """Checkout of Pixel3DMM with its weights, and its environment."""
    return _needs("pixel3dmm", settings)


def _needs(name: str, settings: Mapping[str, Any]) -> Iterator[Need]:
    """Needs of a program. Raises `InputError` for settings that it does not have."""
    place = build(ProgramPlace, settings, "command line", f"--set settings.{name}.")
    if not place.checkout:
        remedy = (
            f"git clone --recursive {PROGRAMS[name].url}, install it as its page says, and give "
            f"--set settings.{name}.checkout=DIR --set settings.{name}.python=FILE."
        )
        yield Need("checkout and environment", "", remedy)
        return
    checkout = Path(place.checkout).absolute()
    try:
        check_checkout(name, checkout)
    except InputError as error:
        yield Need("checkout", "", str(error))
    else:
        yield Need("checkout", str(checkout))
    try:
        yield Need(
            "environment", str(check_interpreter(name, place.python, f"--set settings.{name}.python=FILE"))
        )
    except InputError as error:
        yield Need("environment", "", str(error))
