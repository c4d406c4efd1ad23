"""Entry point of the console script, and signal handling of the program and its workers. Light to import.

Ctrl-C, SIGTERM and SIGHUP end a command with a one-line message. Its output is kept, so that a restart continues.
Signals raise an exception, which closes open resources. During an import, which an exception would leave incomplete,
or if the program has not ended after `GRACE_S`, the process exits at once, also without loss.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from .errors import ExitCode, Interruption

GRACE_S = 10.0
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main() -> int:
    """Run the command line; returns the exit code. Signals that the caller ignores (``nohup``) stay ignored."""
    handled = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in handled:
        signal.signal(number, _interrupt)
    from .cli import main as run  # takes seconds, so import after the handlers are set

    code = run()
    for number in handled:
        signal.signal(number, lambda *signalled: os._exit(code))  # everything is done and printed
    return code


def _interrupt(number: int, frame: FrameType | None) -> None:
    for other in SIGNALS:
        if signal.getsignal(other) is not signal.SIG_IGN:
            signal.signal(other, _leave)
    if _importing(frame):
        _leave(number)
    timer = threading.Timer(GRACE_S, _leave, (number,))
    timer.daemon = True
    timer.start()
    raise Interruption(number)


def _leave(number: int, frame: FrameType | None = None) -> None:
    begin = "\n" if os.isatty(2) else ""  # below the display of progress
    os.write(2, f"{begin}headbench: {Interruption(number)}\n".encode())
    os._exit(Interruption(number).code)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def starting_workers() -> Iterator[None]:
    """Let processes started in the block ignore Ctrl-C and SIGHUP, which a terminal sends to all; this process handles them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Make this worker process end as soon as its parent has ended for any reason."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:

        def wait() -> None:
            parent.join()
            os._exit(ExitCode.UNEXPECTED)

        threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
