"""Entry point of the console script, and how signals end the program and its workers. Light to import.

Ctrl-C, SIGTERM and SIGHUP end a command in one line, and what it has written is kept: started again, it continues.
They raise an exception, so that what is open is closed. Inside an import, where an exception leaves modules half
made, and where the exception leads to no end within `GRACE_S`, the process exits at once, which loses nothing either.
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
    own = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in own:
        signal.signal(number, _interrupt)
    from .cli import main as run  # takes seconds, with the handlers in place

    code = run()
    for number in own:
        signal.signal(number, lambda *signalled: os._exit(code))  # all is done and printed
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
    """Let processes that are started in the block leave Ctrl-C and SIGHUP, which all of a terminal get, to this one."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Make this process, a worker, end as soon as the one that started it has ended, however that did."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:

        def wait() -> None:
            parent.join()
            os._exit(ExitCode.UNEXPECTED)

        threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
