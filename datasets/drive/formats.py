"""Formats of driving signals: how each is recognised and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ...bench.engine.captures import finds, readers
from ...bench.errors import InputError
from ...bench.registry import unknown
from .blendshapes import is_blendshapes, read_blendshapes
from .coefficients import is_coefficients, read_coefficients
from .mapping import read_mapped
from .signal import DrivingSignal, SignalRequest
from .table import SignalTable, read_table
from .tracked import is_flame_parameters, read_capture_signal, read_flame_parameters


@dataclass(frozen=True)
class SignalFormat:
    """A format of driving signals.

    Attributes
    ----------
    name, summary : str
        Name for ``--form``, and a description.
    fits : Callable[[SignalTable], bool]
        Whether a table without a map is of this format.
    read : Callable[[SignalRequest], DrivingSignal]
        Reader; its errors are `InputError`.
    """

    name: str
    summary: str
    fits: Callable[[SignalTable], bool]
    read: Callable[[SignalRequest], DrivingSignal]


FORMATS = (
    SignalFormat(
        "flame_param",
        "FLAME parameters of VHAP, by frame or in one npz",
        is_flame_parameters,
        read_flame_parameters,
    ),
    SignalFormat(
        "coefficients", "FLAME coefficients of DECA, EMOCA, SMIRK, SHeaP", is_coefficients, read_coefficients
    ),
    SignalFormat("blendshapes", "52 blendshapes of ARKit or MediaPipe", is_blendshapes, read_blendshapes),
    SignalFormat(
        "capture", "a capture in a layout that a reader knows", lambda table: False, read_capture_signal
    ),
    SignalFormat("mapped", "a table of numbers with --map", lambda table: False, read_mapped),
)
"""In the order in which they are tried. A folder that a reader of captures finds is a capture, a table with a map is mapped."""


def read_signal(request: SignalRequest, name: str = "") -> DrivingSignal:
    """Read a signal in the named format, or in the one that recognises it."""
    formats = {form.name: form for form in FORMATS}
    if name and name not in formats:
        raise unknown("command line", "--form", name, [*formats])
    path = request.path
    if not path.exists():
        raise InputError(path, "", "a signal", "no such file or folder")
    known = readers().values() if path.is_dir() else ()
    if name == "capture" or (not name and not request.map and any(finds(spec, path) for spec in known)):
        return formats["capture"].read(request)
    if request.sequence:
        raise InputError("command line", "--sequence", "a signal that is a capture", str(path))
    return read_rows(replace(request, table=read_table(path)), name)


def read_rows(request: SignalRequest, name: str = "") -> DrivingSignal:
    """Read the signal of a request with a table, as `read_signal` does."""
    formats = {form.name: form for form in FORMATS}
    if request.map or name == "mapped":
        if not request.map or name not in ("", "mapped"):
            expected = "--form mapped" if request.map else "the map of --form mapped"
            raise InputError("command line", "--map", expected, f"--form {name}")
        return formats["mapped"].read(request)
    fitting = [form for form in FORMATS if form.fits(request.columns)]
    if not name and not fitting:
        expected = "; ".join(f"{form.name}: {form.summary}" for form in FORMATS)
        found = ", ".join([*request.columns.columns][:12])
        raise InputError(
            request.path, "columns", expected, found, "Name other columns in a map file: --map FILE.yaml."
        )
    return (formats[name] if name else fitting[0]).read(request)
