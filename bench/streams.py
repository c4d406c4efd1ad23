"""Standard output and error of the command line: handles any encoding and closed pipes."""

from __future__ import annotations

import codecs
import io
import json
import os
import sys

IN_ASCII = dict(
    zip("↑↓±×·–—…²µ•→°", ("^", "v", "+/-", "x", "-", "-", "--", "...", "^2", "u", "*", "->", " deg"))
)
"""ASCII replacements of the characters in headbench's output, for ASCII terminals."""


def prepare_streams() -> None:
    """Let standard output and error replace characters that their encoding lacks instead of raising an error.

    A stream that the caller has closed (``headbench … >&-``) is discarded.
    """
    codecs.register_error("headbench", _in_ascii)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - open until the process ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="headbench")


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Error handler for characters that an encoding lacks: replace them by `IN_ASCII`, or by JSON escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(IN_ASCII.get(c) or json.dumps(c)[1:-1] for c in lacking), error.end


def show(text: str = "", end: str = "\n") -> None:
    """Print the result of a command. A closed pipe (``headbench compare … | head -1``) does not change the exit code."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        # Buffered output must not fail again when the interpreter exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            error.filename = "standard output"
            raise
