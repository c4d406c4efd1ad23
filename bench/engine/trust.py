"""The one rule for code that a run folder names: it may be from somebody else, so nothing in it runs without consent."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from ..condition import Condition
from ..errors import InputError
from ..registry import get
from .config import RunConfig

PROGRAMS = "settings"
"""Key of names of methods that run a program, which their settings name."""


def check_trusted(
    run: Path,
    named: Mapping[str, Iterable[str]],
    given: Mapping[str, Collection[str]] | None = None,
    *,
    trust: bool,
) -> None:
    """Refuse names by which a run folder would run code: a name with ":" imports a module, a method may run a program.

    Parameters
    ----------
    run : Path
        The file with the names, for messages.
    named : Mapping[str, Iterable[str]]
        Names in the file by key of `RunConfig`; those of `PROGRAMS` are methods that run a program.
    given : Mapping[str, Collection[str]], optional
        Names in this command or its configuration file by key, which are allowed.
    trust : bool
        Allow all.
    """
    for key, names in named.items() if not trust else ():
        for name in names:
            if (":" in name or key == PROGRAMS) and name not in (given or {}).get(key, ()):
                expected = f"names that run no code of others: {_ALLOWED[key == PROGRAMS]}"
                raise InputError(run, f"configuration.{key}", expected, repr(name), _REMEDY)


_ALLOWED = ("registered ones", "methods without a program")
_REMEDY = (
    "If you trust who made the run, name it in this call, or give --trust to a command that has this option."
)


def names_of(config: RunConfig, conditions: Iterable[Condition] | None = None) -> dict[str, tuple[str, ...]]:
    """Names of plug-ins in a configuration by key, for `check_trusted`; ``conditions`` replace its own."""
    of_conditions = config.conditions if conditions is None else conditions
    changes = [change.name for c in of_conditions for change in (c.clip, c.derive, c.drive, c.views)]
    return {
        "reader": (config.reader,),
        "conditions": (*changes, config.clip.name),
        "methods": config.methods,
        "metrics": config.metrics,
        "metric_profiles": config.metric_profiles,
    }


def programs(names: Iterable[str]) -> Iterator[str]:
    """The methods that run a program, of those with these names."""
    return (name for name in names if not get("methods", name).native)
