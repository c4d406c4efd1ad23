"""Standard output and error of the command line: written in any encoding, and to readers that go."""

from __future__ import annotations

import codecs
import io
import json
import os
import sys

IN_ASCII = dict(
    zip("↑↓±×·–—…²µ•→°", ("^", "v", "+/-", "x", "-", "-", "--", "...", "^2", "u", "*", "->", " deg"))
)
"""What our output has beyond ASCII, for terminals that have no more."""


def prepare_streams() -> None:
    """Let standard output and error write in ASCII what their encoding lacks, where they would raise otherwise."""
    codecs.register_error("headbench", _in_ascii)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="headbench")


def on_terminal() -> bool:
    """Whether standard output is a terminal, which a person reads."""
    return sys.stdout.isatty()


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Handle characters that an encoding lacks: ours by `IN_ASCII`, others as JSON escapes them."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(IN_ASCII.get(c) or json.dumps(c)[1:-1] for c in lacking), error.end


def show(text: str = "", end: str = "\n") -> None:
    """Print the result of a command. A reader that has gone (``headbench compare … | head -1``) changes no exit code."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        # What is still buffered must not fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            error.filename = "standard output"
            raise
