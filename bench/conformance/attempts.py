"""Calls into a plug-in: what it raises is a breach of its contract, not an error of the kit."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import InputError, UnavailableError


@contextmanager
def attempt(breaches: list[str], what: str) -> Iterator[None]:
    """Note an exception of the block as a breach: ``what``, the exception and the line that raised it.

    `UnavailableError` passes through: the plug-in needs something that is not installed.
    """
    try:
        yield
    except UnavailableError:
        raise
    except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way
        breaches.append(f"{what} raised {described(error)}")


def described(error: Exception) -> str:
    """The exception in one line, with the place that raised it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message} ({Path(last.filename).name}, line {last.lineno})"


def refusal(call: Callable[[], Any], what: str, *, expected: type[Exception] = InputError) -> Iterator[str]:
    """A breach unless ``call`` raises ``expected``."""
    try:
        call()
    except expected:
        return
    except Exception as error:  # noqa: BLE001
        yield f"{what} raised {described(error)} instead of {expected.__name__}"
    else:
        yield f"{what} was taken instead of refused by {expected.__name__}"
