"""Errors that a user can act on."""

from __future__ import annotations

from os import PathLike


class HeadbenchError(Exception):
    """Base of all errors the command line reports as one paragraph, without a traceback (exit code 2)."""


class InputError(HeadbenchError):
    """Bad input, found before any long work started.

    Parameters
    ----------
    file : the file (or option, or registry) the fault is in.
    key : the entry inside it (array name, JSON path, option name), or "" for the file as a whole.
    expected : what a valid input has there.
    found : what is there.
    remedy : what to do about it, if that does not follow from ``expected``.
    """

    def __init__(self, file: str | PathLike[str], key: str, expected: str, found: str, remedy: str = ""):
        self.file, self.key = str(file), key
        self.expected, self.found, self.remedy = expected, found, remedy
        where = f"{self.file}, {key}" if key else self.file
        message = f"{where}: expected {expected}, found {found}."
        super().__init__(f"{message} {remedy}" if remedy else message)


class UnavailableError(HeadbenchError):
    """Something optional is not there (a package, weights, a compiler); says how to get it.

    A metric that raises this is shown as missing with the reason, never guessed.
    """

    def __init__(self, what: str, remedy: str):
        self.what, self.remedy = what, remedy
        super().__init__(f"{what} {remedy}")
