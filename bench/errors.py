"""Errors that a user can act on, and the exit codes of all commands. Light to import."""

from __future__ import annotations

import signal
from enum import IntEnum
from os import PathLike


class ExitCode(IntEnum):
    """Exit codes, with the same meaning for every command."""

    OK = 0
    NEGATIVE = 1
    """The command finished with a negative result: a method failed, a number got worse, a check did not
    pass."""
    BAD_INPUT = 2
    """Wrong usage, bad input, a missing package or program, or a file or folder that cannot be read or written."""
    NO_VERDICT = 3
    """Data that the verdict needs is missing or invalid."""
    UNEXPECTED = 70
    """An unexpected exception, to be reported; its traceback is printed (EX_SOFTWARE of sysexits.h)."""
    HANGUP = 129
    INTERRUPTED = 130
    TERMINATED = 143


EXIT_CODES = (
    "Exit codes: 0 done; 1 done, but a method failed, a number got worse or a check did not pass; "
    "2 wrong usage, bad input, a missing package or program, or a file that cannot be read or written; 3 data needed for a verdict is missing or invalid; "
    "70 unexpected error, please report; 129, 130, 143 ended by SIGHUP, Ctrl-C, SIGTERM."
)


class Interruption(KeyboardInterrupt):
    """A signal (Ctrl-C, SIGTERM or SIGHUP) requests the end of the program."""

    def __init__(self, number: int):
        self.code = ExitCode(128 + number)
        reason = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        super().__init__(f"{reason}; start it again to continue")


class HeadbenchError(Exception):
    """Base of all errors the command line reports as one paragraph, without a traceback (exit code 2)."""


LONGEST_PLACE, LONGEST_WORDS, LONGEST_FOUND = 400, 1200, 300
"""Maximum characters of an error's parts; longer text is shortened in the middle."""


class InputError(HeadbenchError):
    """Bad input, found before any long work started.

    Its message is short for any input and has no control characters.

    Parameters
    ----------
    file : str | PathLike[str]
        The file, option or registry with the error.
    key : str
        The entry in it (array name, JSON path, option name), or "" for the whole file.
    expected : str
        What a valid input contains.
    found : str
        What the input contains.
    remedy : str
        How to fix it, if that does not follow from ``expected``.
    """

    def __init__(self, file: str | PathLike[str], key: str, expected: str, found: str, remedy: str = ""):
        self.file, self.key = shortened(str(file), LONGEST_PLACE), shortened(key, LONGEST_PLACE)
        self.expected, self.found = shortened(expected, LONGEST_WORDS), shortened(found, LONGEST_FOUND)
        self.remedy = shortened(remedy, LONGEST_WORDS)
        where = f"{self.file}, {self.key}" if key else self.file
        message = f"{where}: expected {self.expected}, found {self.found}."
        super().__init__(f"{message} {self.remedy}" if remedy else message)

    def __reduce__(self) -> tuple[type, tuple[str, ...]]:
        """Between processes."""
        return type(self), (self.file, self.key, self.expected, self.found, self.remedy)


def text_of(error: BaseException) -> str:
    """The message of an error, or its type if the class fails to provide the message."""
    try:
        return str(error)
    except Exception:  # noqa: BLE001
        return f"{type(error).__name__} without a readable message"


def reason_of(error: Exception) -> str:
    """Reason of a failed cell for its rows; any memory error becomes "out of memory"."""
    name, text = type(error).__name__, text_of(error)
    wanted = ("out of memory", "can't allocate memory", "cannot allocate memory")
    if isinstance(error, MemoryError) or name == "OutOfMemoryError" or any(w in text.lower() for w in wanted):
        return f"out of memory: {text or name}"
    return f"{name}: {text}"


def is_damage(error: BaseException) -> bool:
    """Whether a reading error is caused by the file's content, not by the disk, permissions or lack of
    memory."""
    cause = error.__cause__
    machine = isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno is not None)
    return not machine and (cause is None or is_damage(cause))


class LeftOutError(HeadbenchError):
    """A frame to which a metric does not apply, such as one without a face; left out of means and counted."""


class UnavailableError(HeadbenchError):
    """An optional component (a package, weights, a compiler) is missing; the message says how to get it.

    A metric that raises this is shown as missing with the reason. ``note`` is the short reason in tables; by
    default the whole message.
    """

    def __init__(self, what: str, remedy: str, note: str = ""):
        self.what, self.remedy, self.note = what, remedy, note or f"{what} {remedy}"
        super().__init__(f"{what} {remedy}")


def install_extra(extra: str) -> str:
    """How to install an optional extra of pyproject.toml from the checkout, since headbench is on no package
    index."""
    return f"Run in the headbench checkout: pip install -e '.[{extra}]'"


def shortened(text: str, longest: int) -> str:
    """Shorten text in the middle, and remove control characters except line ends."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} [...] {text[-longest // 4 :]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
