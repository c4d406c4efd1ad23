"""Progress that a waiting person can read: a bar with time left on a terminal, log lines elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from .contracts import Progress

LOG_EVERY_S = 15.0
log = logging.getLogger("headbench")


@contextmanager
def log_to(path: Path | None, *, quiet: bool = False) -> Iterator[None]:
    """Send headbench's log to the terminal (messages) and to a file (with times) while the block runs."""
    root = logging.getLogger("headbench")
    level, propagate = root.level, root.propagate
    handlers: list[logging.Handler] = []
    console = logging.StreamHandler(sys.stderr)
    console.setFormatter(logging.Formatter("%(message)s"))
    console.setLevel(logging.WARNING if quiet else logging.INFO)
    handlers.append(console)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(path, encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        handlers.append(file)
    root.setLevel(logging.INFO)
    root.propagate = False
    for handler in handlers:
        root.addHandler(handler)
    try:
        yield
    finally:
        for handler in handlers:
            root.removeHandler(handler)
            handler.close()
        root.setLevel(level)
        root.propagate = propagate


@contextmanager
def progress(label: str) -> Iterator[Progress]:
    """Give a `Progress` callback that shows ``label``, the share done and the time left."""
    if sys.stderr.isatty():
        with logging_redirect_tqdm([log]), tqdm(desc=label, leave=False, dynamic_ncols=True) as bar:

            def show(done: int, total: int, note: str = "") -> None:
                bar.total = total
                bar.set_postfix_str(note, refresh=False)
                bar.update(done - bar.n)

            yield show
    else:
        yield _LogProgress(label)


class _LogProgress:
    """Writes a line at most every `LOG_EVERY_S` seconds."""

    def __init__(self, label: str):
        self.label = label
        self.first: tuple[float, int] | None = None
        self.last = time.monotonic()

    def __call__(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = (now, done)
        if now - self.last < LOG_EVERY_S:
            return
        self.last = now
        start, base = self.first
        left = (total - done) * (now - start) / max(done - base, 1)
        log.info(
            "%s: %d of %d, %s left%s", self.label, done, total, duration(left), f" ({note})" if note else ""
        )


def duration(seconds: float) -> str:
    """Write a duration as a person would say it: 42 s, 3 min 10 s, 2 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
