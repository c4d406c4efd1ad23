"""Parses the arguments of a command by its settings class, and calls the command."""

# Without `from __future__ import annotations`, since the parser reads annotations created when a command is called.

import inspect
import json as json_module
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

import tyro

from .errors import ExitCode, HeadbenchError
from .io.files import check_kind, expand_home, to_jsonable
from .io.lock import locked
from .options import check_dependent
from .process import environment_variable
from .progress import log_to_terminal, progress
from .registry import Plugin, discover, get, resolve
from .specs import HELP, CommandSpec
from .terminal import show, wrapped

Command = Callable[..., Callable[[], int]]
"""Takes settings and returns a function that runs the command, which separates parsing errors from errors of the command."""


def call_command(name: str, plugins: Mapping[str, Plugin], words: Sequence[str]) -> int:
    """Call a command with the arguments after its name, or print its help; return the exit code.

    Raises `HeadbenchError` for a command that cannot be loaded.
    """
    words = [with_home(word) for word in words]
    run: Callable[[], int] = _parse(_command(name, plugins[name], words), f"headbench {name}", words)
    return run()


def print_completion(plugins: Mapping[str, Plugin], words: Sequence[str]) -> int:
    """Print or write shell completion for all commands, by the parser's own options."""
    run: Callable[[], int] = _parse(_all_commands(plugins), "headbench", words)
    return run()


def with_home(word: str) -> str:
    """Expand ``~`` in an argument, which shells do not do after ``=`` and in quotes."""
    match = re.fullmatch(r"((?:[^=]*=)*?)(~.*)", word)
    if match is None:
        return word
    option = match[1].startswith("--") and match[1].count("=") == 1
    if match[2] == "~" and match[1] and not option:  # null in YAML
        return word
    return match[1] + expand_home(match[2], "command line")


def _parse(command: Any, program: str, words: Sequence[str]) -> Any:
    """Parse arguments; return the result of ``command``. Exits with code 2 after printing what is wrong with them."""
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    # The parser knows dumb terminals, but not the variable.
    with environment_variable("TERM", "dumb" if os.environ.get("NO_COLOR") else None):
        return tyro.cli(command, prog=program, args=words, config=config, registry=_values())


def _command(name: str, plugin: Plugin, words: Sequence[str]) -> Command:
    """The command as a function of its settings, for the parser."""
    try:
        spec: CommandSpec = get("commands", name)
        settings_class = resolve(spec.settings)
        if not isinstance(settings_class, type) or not is_dataclass(settings_class):
            raise HeadbenchError(f"{spec.settings}: expected a dataclass with the settings")
    except HeadbenchError as error:
        raise HeadbenchError(f"command {name!r} of {plugin.origin} is broken: {error}") from error
    settings_type: Any = Annotated[settings_class, tyro.conf.OmitArgPrefixes]

    def command(settings: settings_type, json: bool = False) -> Callable[[], int]:
        return lambda: run(settings, json)

    def run(settings: Any, json: bool) -> int:
        check_dependent(getattr(settings_class, "dependent", ()), settings)
        folder = getattr(settings, spec.writes) if spec.writes else None
        if folder:
            check_kind(Path(folder), *spec.kinds)
        lock = locked(Path(folder)) if folder else nullcontext()
        with log_to_terminal(), lock, progress(name) as report:
            function = resolve(spec.function)
            arguments = vars(settings) if hasattr(function, "options") else {"settings": settings}
            findings = function(**arguments, progress=report)
        if json:
            show(json_module.dumps(findings.data, indent=1, default=to_jsonable))
        else:
            show(findings.text if findings.verbatim else wrapped(findings.text))
        if findings.code is not None:
            return findings.code
        return ExitCode.OK if findings.passed else ExitCode.NEGATIVE

    notes = settings_class.notes() if hasattr(settings_class, "notes") and {*HELP} & {*words} else ""
    others = ", ".join(
        f"`headbench {other}`" for other in sorted(discover("commands")) if other.startswith(f"{name} ")
    )
    parts = (spec.summary, notes, f"With a second word: {others}." if others else "")
    command.__doc__ = (
        "\n\n".join(part for part in parts if part) + "\n\nArgs:\n    json: Print the result as JSON."
    )
    return command


def _all_commands(plugins: Mapping[str, Plugin]) -> Command:
    """All commands as nested subcommands, for completion. Commands that cannot be loaded are left out."""
    found: dict[str, dict[str, Command]] = {}
    for name, plugin in sorted(plugins.items()):
        first, _, second = name.partition(" ")
        with suppress(HeadbenchError):
            found.setdefault(first, {})[second] = _command(name, plugin, ())
    return _nested({first: _nested(seconds) for first, seconds in found.items()})


def _nested(group: Mapping[str, Command]) -> Command:
    """Commands as subcommands of one; a command without a name adds its options to this level."""
    # Not tyro's function for subcommands: it searches typing's sources for help, which doubles the time.
    own = group.get("")
    words = {name: command for name, command in group.items() if name}
    if own is not None and not words:
        return own
    choices = [Annotated[Any, tyro.conf.subcommand(name=n, constructor=c)] for n, c in words.items()]
    choice: Any = Union[(*choices, Annotated[None, tyro.conf.Suppress])]

    def chosen(command: choice) -> Callable[[], int]:
        return command

    if own is not None:
        chosen.__annotations__ = {"command": choice, "settings": own.__annotations__["settings"]}
        chosen.__signature__ = inspect.signature(lambda command, settings: None)  # type: ignore[attr-defined]
    return chosen


def _parts(words: Sequence[str], kind: Callable[[str], Any]) -> tuple[Any, ...]:
    """The values of a list, also separated by commas. Raises `ValueError` for none, since the option would be ignored."""
    parts = tuple(kind(part) for word in words for part in word.split(",") if part)
    if not parts:
        raise ValueError("expected at least one value, found none")
    return parts


def _values() -> tyro.constructors.ConstructorRegistry:
    """Parsing and display of two kinds of options.

    Optional ones (``str | None``) are parsed like their values; lists (``tuple[str, ...]``) also with commas.
    """
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def optional(
        info: tyro.constructors.PrimitiveTypeInfo,
    ) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
        kinds = get_args(info.type)
        if info.type_origin not in (Union, UnionType) or len(kinds) != 2 or NoneType not in kinds:
            return None
        (kind,) = set(kinds) - {NoneType}
        value = registry.get_primitive_spec(tyro.constructors.PrimitiveTypeInfo.make(kind, info.markers))
        if isinstance(value, tyro.constructors.UnsupportedTypeAnnotationError):
            return None
        return replace(
            value,
            str_from_instance=lambda found: ["none"] if found is None else value.str_from_instance(found),
        )

    @registry.primitive_rule
    def listed(
        info: tyro.constructors.PrimitiveTypeInfo,
    ) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
        kinds = get_args(info.type)
        named = {
            tyro.conf.Positional,
            tyro.conf.UseAppendAction,
        } & info.markers  # folders; each option one value
        if info.type_origin is not tuple or named or kinds not in [(kind, ...) for kind in (str, int, float)]:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs="*",
            metavar=f"{kinds[0].__name__.upper()} [{kinds[0].__name__.upper()} ...]",
            instance_from_str=lambda words: _parts(words, kinds[0]),
            is_instance=lambda found: isinstance(found, tuple),
            str_from_instance=lambda found: [str(value) for value in found],
        )

    return registry
