"""Options of a command: those that have no effect without, or with, another one are refused; numbers by name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields
from typing import Any, NamedTuple, get_type_hints

import tyro

from .errors import InputError


class DependentOptions(NamedTuple):
    """Options that have an effect only if another setting has certain values.

    A dataclass of settings lists its own in the class variable ``dependent``.
    """

    options: tuple[str, ...]
    other: str
    """Name of the attribute that they depend on."""
    values: tuple[str, ...] | bool = True
    """Values of ``other`` with which the options have an effect. True: ``other`` is given; False: it is not."""


def numbers(words: Iterable[str], option: str) -> dict[str, int]:
    """Parse words NAME=NUMBER of an option, whole numbers from 1."""
    parsed = {}
    for word in words:
        name, _, number = word.partition("=")
        if not name or not re.fullmatch("[1-9][0-9]{0,8}", number):
            raise InputError("command line", option, "NAME=NUMBER, whole numbers from 1", word)
        parsed[name] = int(number)
    return parsed


def iterations(words: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Settings of methods from words METHOD=NUMBER of the option ``--iterations``."""
    return {name: {"budget": {"iterations": n}} for name, n in numbers(words, "--iterations").items()}


def check_dependent(
    dependent: Iterable[DependentOptions], settings: Any, given: Mapping[str, str] | None = None
) -> None:
    """Raise `InputError` for an option that is given and has no effect with the other settings.

    Parameters
    ----------
    settings : Any
        Dataclass with the attributes `DependentOptions.other`.
    given : Mapping[str, str] | None
        Given attributes and their names in the error; None for those that differ from their defaults.
    """
    if given is None:
        given = {
            f.name: _option(f.name) for f in fields(settings) if getattr(settings, f.name) != _default(f)
        }
    for options, other, values in dependent:
        value, name = getattr(settings, other), _shown(settings, other)
        present = value not in (None, False, "", ())
        if value in values if isinstance(values, tuple) else present == values:
            continue
        expected = (
            f"{name} {' or '.join(values)}" if isinstance(values, tuple) else name if values else f"no {name}"
        )
        relation = "with" if values is False else "without"
        found = "none" if not present else name if value is True else f"{name} {value}"
        for option in (option for option in options if option in given):
            wanted = f"{expected}, {relation} which it has no effect"
            raise InputError("command line", given[option], wanted, found)


def _default(field: Field[Any]) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _shown(settings: Any, name: str) -> str:
    """Name of a setting in the help: an option, or a positional argument."""
    hint = get_type_hints(type(settings), include_extras=True)[name]
    return name.upper() if tyro.conf.Positional in getattr(hint, "__metadata__", ()) else _option(name)
