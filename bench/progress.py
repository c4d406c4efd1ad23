"""Progress with the remaining time: one live display on a terminal, log lines elsewhere."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from .contracts import Progress
from .terminal import wrapped

BAR, ASCII_BAR = "█░", "#."
BAR_WIDTH, MOST_CELLS = 12, 8
"""Width of the bar in characters, and number of cells with separate lines."""


@dataclass(frozen=True)
class Position:
    """Progress of some work."""

    text: str
    """Complete text in one line, for logs."""
    label: str
    """First line of a display."""
    share: float
    """Completed fraction, from 0 to 1."""
    cells: Mapping[str, str] = field(default_factory=dict)
    """Activity of each running cell by name, one line each."""


class Display:
    """Lines at the end of a terminal that are updated in place."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        class Steady(Console):
            """A console that leaves the cursor visible, so that nothing is left to restore after a kill."""

            def show_cursor(self, show: bool = True) -> bool:
                return False

        self._console = Steady(
            file=sys.stderr,
            force_terminal=True,
            force_interactive=True,
            color_system=None,
            highlight=False,
            markup=False,
            emoji=False,
        )
        # Other output appears above the display; standard output is not redirected unless it is a terminal.
        self._live = Live(
            console=self._console, auto_refresh=False, transient=True, redirect_stdout=sys.stdout.isatty()
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, position: Position) -> None:
        """Update the lines."""
        from rich.text import Text

        lines = "\n".join(self._lines(position))
        self._live.update(Text(lines, no_wrap=True, overflow="crop"), refresh=True)

    def print(self, text: str) -> None:
        """Print above the display; the terminal wraps long lines."""
        self._console.print(text, soft_wrap=True)

    def _lines(self, position: Position) -> list[str]:
        bar = ASCII_BAR if self._console.options.ascii_only else BAR
        done = round(BAR_WIDTH * min(max(position.share, 0.0), 1.0))
        lines = [f"{bar[0] * done}{bar[1] * (BAR_WIDTH - done)} {position.label}"]
        lines += [f"  {name}: {doing}" for name, doing in list(position.cells.items())[:MOST_CELLS]]
        more = len(position.cells) - MOST_CELLS
        return [*lines, f"  and {more} more"] if more > 0 else lines


_displays: list[Display] = []
"""The current display, if any; a process has at most one."""


def is_interactive() -> bool:
    """Whether standard error is a terminal on which lines can be updated."""
    # A display replaces standard error by an object that does not report a terminal.
    return bool(_displays) or (sys.stderr.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown"))


def current() -> Display | None:
    """The current display."""
    return _displays[0] if _displays else None


@contextmanager
def displayed() -> Iterator[Display]:
    """Show a display while the block runs, and remove it at its end."""
    with Display() as display:
        _displays.append(display)
        try:
            yield display
        finally:
            _displays.remove(display)


class TerminalHandler(logging.StreamHandler):
    """Writes messages to standard error, wrapped, above the display if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        return wrapped(super().format(record), self.stream)

    def emit(self, record: logging.LogRecord) -> None:
        display = current()
        if display is None:
            super().emit(record)
        else:
            display.print(self.format(record))


LOG_EVERY_S, SHOW_EVERY_S = 15.0, 0.2
"""Seconds between lines of a log, and between changes of the display on a terminal."""
BASIS_S, SAMPLES, SAMPLE_EVERY_S = 5.0, 60, 1.0
"""Seconds of steps before a speed is estimated, number of samples kept, and seconds between
samples."""
Show = Callable[[Callable[[], Position]], None]
"""Shows the position returned by a function if the refresh interval has passed."""
log = logging.getLogger("headbench")


def log_to_terminal() -> AbstractContextManager[None]:
    """Send the messages of headbench's log to the terminal while the block runs."""
    return _logging(TerminalHandler(sys.stderr), "%(message)s")


def log_to_file(path: Path) -> AbstractContextManager[None]:
    """Append headbench's log, with times, to a file while the block runs."""
    return _logging(
        _LogFile(path, encoding="utf-8", errors="backslashreplace"),
        "%(asctime)s %(levelname)s %(name)s: %(message)s",
    )


@contextmanager
def _logging(handler: logging.Handler, form: str) -> Iterator[None]:
    handler.setFormatter(logging.Formatter(form))
    level, propagate = log.level, log.propagate
    log.setLevel(logging.INFO)
    log.propagate = False
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        handler.close()
        log.setLevel(level)
        log.propagate = propagate


class _LogFile(logging.FileHandler):
    """A log file. Failure to write it is an error of the run."""

    def handleError(self, record: logging.LogRecord) -> None:
        error = sys.exception()
        if not isinstance(error, OSError):
            super().handleError(
                record
            )  # a malformed message of a plug-in is printed and does not stop the run
            return
        error.filename = self.baseFilename
        raise error


class CellProgress(Protocol):
    """A `Progress` that also receives the activity of each running cell by name, shown on terminals only."""

    def __call__(
        self, done: int, total: int, note: str = "", cells: Callable[[], Mapping[str, str]] = dict
    ) -> None: ...


@contextmanager
def progress(label: str, tasks: TasksLeft | None = None) -> Iterator[CellProgress]:
    """Yield a `Progress` callback that shows ``label``, the completed share and the remaining time, by steps or of ``tasks``."""
    with _line() as show:
        left = tasks or TimeLeft()

        def report(
            done: int, total: int, note: str = "", cells: Callable[[], Mapping[str, str]] = dict
        ) -> None:
            if isinstance(left, TimeLeft):
                left.step(done, total)
            text = _text(f"{label}: {done} of {total}", left.seconds, note)
            running = cells() if is_interactive() else {}
            show(lambda: Position(text, text, done / total if total else 1.0, running))

        yield report


class TimeLeft:
    """Estimates the remaining time from the most recent steps, since their speed may change."""

    def __init__(self) -> None:
        self._left = 0
        self._samples: deque[tuple[float, int]] = deque(maxlen=SAMPLES)

    def step(self, done: int, total: int) -> None:
        """Record the current position."""
        now = time.monotonic()
        self._left = total - done
        if self._samples and done < self._samples[-1][1]:
            self._samples.clear()
        if done and (not self._samples or now - self._samples[-1][0] >= SAMPLE_EVERY_S):
            self._samples.append((now, done))  # the time before the first step is that of starting

    @property
    def seconds(self) -> float | None:
        """Seconds left; None while the speed is unknown."""
        if not self._samples:
            return None
        (start, base), (end, done) = self._samples[0], self._samples[-1]
        if end - start < BASIS_S or done == base:
            return None
        return self._left * (end - start) / (done - base)


class TasksLeft:
    """Estimates the remaining time of tasks that run beside each other, from those that ended and the relative costs of all."""

    def __init__(self, costs: Mapping[str, float]) -> None:
        self._costs = dict(costs)
        self._since: dict[str, float] = {}
        self._ended_s = self._ended_cost = 0.0

    def running(self, names: Iterable[str]) -> None:
        """Set the tasks that run now."""
        now = time.monotonic()
        self._since = {name: self._since.get(name, now) for name in names}

    def end(self, name: str) -> None:
        """Record the end of a task."""
        now = time.monotonic()
        self._ended_s += now - self._since.pop(name, now)
        self._ended_cost += self._costs.pop(name)

    @property
    def seconds(self) -> float | None:
        """Seconds left; None before tasks of a cost of 1 have ended: in short ones, starting takes most of the time."""
        if self._ended_cost < 1.0:
            return None
        now, rate = time.monotonic(), self._ended_s / self._ended_cost
        each = [
            max(0.0, rate * cost - now + self._since.get(name, now)) for name, cost in self._costs.items()
        ]
        return max([sum(each) / max(len(self._since), 1), *each], default=0.0)


@contextmanager
def run_progress(cells: Mapping[str, Mapping[str, str]]) -> Iterator[RunProgress]:
    """Show the progress of all cells of a run, see `RunProgress`."""
    with _line() as show:
        yield RunProgress(cells, show)


class RunProgress:
    """Progress of all cells of a run: the current cell, its step, and the remaining time of both.

    The time of a step is estimated from its own count, or, before it starts, from finished steps of the same
    kind. While some steps have no estimate, only a lower bound is shown.

    Parameters
    ----------
    cells : Mapping[str, Mapping[str, str]]
        Steps of each cell, by name and in order, each with its kind (for example the method's name).
        Steps of one name and kind are assumed to take equally long.
    show : Show
        Shows a position if the refresh interval has passed.
    """

    def __init__(self, cells: Mapping[str, Mapping[str, str]], show: Show):
        self._cells, self._show = cells, show
        self._names = list(cells)
        self._took: dict[tuple[str, str], list[float]] = {}

    @contextmanager
    def step(self, cell: str, step: str) -> Iterator[Progress]:
        """Start a step of a cell; yield its `Progress`. A failed step does not affect estimates of others."""
        left, started = TimeLeft(), time.monotonic()
        first: list[tuple[float, int]] = []
        steps = 0

        def report(done: int, total: int, note: str = "") -> None:
            nonlocal steps
            steps = total
            if not first:
                first.append((time.monotonic(), done - 1))
            left.step(done, total)
            self._show(lambda: self._shown(cell, step, (done, total), left.seconds, started, note))

        self._show(lambda: self._shown(cell, step, None, None, started, ""))
        yield report
        seconds = time.monotonic() - started
        if first and steps > first[0][1]:  # steps done by an earlier start would distort the speed
            since, before = first[0]
            seconds += (time.monotonic() - since) * before / (steps - before)
        if step in self._cells[cell]:
            self._took.setdefault((step, self._cells[cell][step]), []).append(seconds)

    def _shown(
        self, cell: str, step: str, at: tuple[int, int] | None, left: float | None, started: float, note: str
    ) -> Position:
        index = self._names.index(cell)
        steps = list(self._cells[cell])
        if left is None and step in steps:
            took, spent = self._mean(step, self._cells[cell][step]), time.monotonic() - started
            left = took - spent if took is not None and took > spent else None
        later = steps[steps.index(step) + 1 :] if step in steps else []
        ahead = [(name, self._cells[cell][name]) for name in later]
        ahead += [part for name in self._names[index + 1 :] for part in self._cells[name].items()]
        parts = [left, *(self._mean(*part) for part in ahead)]
        estimates = [part for part in parts if part is not None]
        bound = "" if len(estimates) == len(parts) else "more than "
        count = "" if at is None else f" {at[0]} of {at[1]}"
        place = f"avatar {index + 1} of {len(self._names)}"
        total = sum(estimates) if estimates else None
        text = _text(f"{place} ({cell}): {step}{count}", total, note, bound)
        # All steps of a cell have the same weight, which is sufficient for a bar.
        share = at[0] / at[1] if at is not None and at[1] else 0.0
        before = steps.index(step) if step in steps else 0
        share = (index + (before + share) / max(len(steps), 1)) / len(self._names)
        return Position(
            text, _text(place, total, "", bound), share, {cell: _text(f"{step}{count}", left, note)}
        )

    def _mean(self, step: str, kind: str) -> float | None:
        took = self._took.get((step, kind))
        return sum(took) / len(took) if took else None


def _text(text: str, left: float | None, note: str, bound: str = "") -> str:
    time_left = "" if left is None or left < 1 else f", {bound}{duration(left)} left"
    return f"{text}{time_left}{f' ({note})' if note else ''}"


@contextmanager
def _line() -> Iterator[Show]:
    """Return a function that shows a position: in the live display on a terminal, as a log line elsewhere."""
    on_terminal = is_interactive()
    every = SHOW_EVERY_S if on_terminal else LOG_EVERY_S
    last = time.monotonic() - (every if on_terminal else 0.0)
    with ExitStack() as stack:

        def show(position: Callable[[], Position]) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last < every:
                return
            last = now
            if not on_terminal:
                log.info("%s", position().text)
                return
            # Created here, so that work without output has no line; nested work shares the outer display.
            display = current() or stack.enter_context(displayed())
            display.show(position())

        yield show


def some(names: Iterable[Any], limit: int = 4) -> str:
    """The first few names, and the number of others."""
    names = [str(name) for name in names]
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def counted(number: int, noun: str) -> str:
    """Format a count, such as "1 subject" or "2 subjects"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def duration(seconds: float) -> str:
    """Format a duration: 42 s, 3 min 10 s, 2 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
