"""Commands of the command line that the rooms offer: found in the registry, described by their settings."""

from __future__ import annotations

import json as json_module
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import tyro

from .errors import HeadbenchError
from .files import plain
from .progress import log_to, progress
from .registry import discover, resolve
from .specs import CommandSpec, Findings

EXIT_NOT_PASSED = 1

Command = Callable[..., int]


def offered_commands() -> dict[str, Command | dict[str, Command]]:
    """Commands by name; a word that several share ("prepare nersemble") leads to a table of its own.

    A command whose settings cannot be loaded is listed; it raises when it is called.
    """
    found: dict[str, Command | dict[str, Command]] = {}
    for name, plugin in sorted(discover("commands").items()):
        if plugin.spec is None:
            found[name] = _broken(name, f"{plugin.origin}: {plugin.error}")
            continue
        first, _, second = plugin.spec.name.partition(" ")
        if not second:
            found[first] = _command(plugin.spec)
            continue
        group = found.setdefault(first, {})
        if isinstance(group, dict):
            group[second] = _command(plugin.spec)
    return found


def with_groups(commands: Mapping[str, Command | dict[str, Command]]) -> dict[str, Command]:
    """Stand-ins for the tables of `offered_commands`, so that the list of commands shows them."""
    return {
        name: _listed(name, command) if isinstance(command, dict) else command
        for name, command in commands.items()
    }


def _command(spec: CommandSpec) -> Command:
    try:
        settings_type = resolve(spec.settings)
    except HeadbenchError as error:
        return _broken(spec.name, str(error))

    def command(settings: Any, json: bool = False) -> int:
        implementation = resolve(spec.implementation)
        with log_to(None), progress(spec.name) as report:
            findings: Findings = implementation(settings, report)
        print(json_module.dumps(findings.data, indent=1, default=plain) if json else findings.text)
        if findings.code is not None:
            return findings.code
        return 0 if findings.passed else EXIT_NOT_PASSED

    # The options are those of this command's own settings, which only its specification knows.
    command.__annotations__ = {
        "settings": Annotated[settings_type, tyro.conf.OmitArgPrefixes],
        "json": Annotated[bool, tyro.conf.arg(help="Print the result as JSON.")],
        "return": int,
    }
    command.__doc__ = spec.summary
    return command


def _broken(name: str, why: str) -> Command:
    def command() -> int:
        raise HeadbenchError(f"command {name!r} is broken: {why}")

    command.__doc__ = "Broken; calling it tells why."
    return command


def _listed(name: str, group: Mapping[str, Command]) -> Command:
    def command() -> int:
        raise HeadbenchError(f"{name}: say what: {', '.join(sorted(group))}")

    command.__doc__ = f"Followed by one of: {', '.join(sorted(group))}."
    return command
