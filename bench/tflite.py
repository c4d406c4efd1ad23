"""Networks in files of TensorFlow Lite, read by the package ai-edge-litert, which is not a dependency."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .errors import InputError, UnavailableError, install_extra


def open_network(path: Path, expected: str, remedy: str) -> Any:
    """The interpreter of a file, with one thread.

    Parameters
    ----------
    expected, remedy : str
        Description of the file, and where to get it, for messages.

    Raises
    ------
    UnavailableError
        The package ai-edge-litert is missing.
    InputError
        The file is missing or cannot be read.
    """
    if not path.exists():
        raise InputError(path, "", expected, "no such file", remedy)
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        what = "Networks of MediaPipe need the package ai-edge-litert; it is not installed."
        raise UnavailableError(what, f"pip install ai-edge-litert, or: {install_extra('track')}") from error
    try:
        network = Interpreter(model_path=str(path), num_threads=1)
        network.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(path, "", expected, str(error)) from error
    return network
