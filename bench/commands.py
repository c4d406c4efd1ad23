"""Commands of the command line, as the registry lists them: described by their settings."""

# Without `from __future__ import annotations`: the parser reads annotations that are made when a command is found.

import difflib
import json as json_module
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

import tyro

from .errors import EXIT_CODES, ExitCode, HeadbenchError, InputError
from .io.files import check_kind, expand_home, plain
from .io.lock import locked
from .options import check_dependent, given_options
from .progress import log_to_terminal, progress
from .registry import discover
from .specs import CommandSpec
from .streams import show

Command = Callable[..., int]

_ALIASES = {
    "compare": "analyze",
    "doctor": "diagnose info",
    "evaluate": "eval evaluation metrics test",
    "inspect": "visualize",
    "lint": "check validate",
    "prepare nersemble": "preprocess process-data process",
    "run": "benchmark fit train",
    "sweep": "prune",
    "synth": "generate synthesize",
    "table": "results show",
    "view": "viewer gui",
}
COMMAND_ALIASES = {word: name for name, words in _ALIASES.items() for word in words.split()}
"""Names that other toolkits use for a command, and the command of headbench that does the same."""


def call(words: Sequence[str]) -> int:
    """Call the command that the words of a command line name, or print its help; returns the exit code."""
    words = [with_home(word) for word in words]
    offered = offered_commands(words)
    check_known(words, offered)
    first = ("demo", "run", "table")  # what a newcomer needs
    commands = with_groups({name: offered[name] for name in (*first, *sorted(offered.keys() - set(first)))})
    description = "Benchmark of animatable 3D head avatars. Start with `headbench demo`."
    description += f" `headbench --version` prints the version.\n\n{EXIT_CODES}"
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    # Not tyro's own function for subcommands: it looks for help in typing's sources, which takes as long as the rest.
    code: int = tyro.cli(
        _nested(commands),
        prog="headbench",
        description=description,
        args=words,
        config=config,
        registry=_values(),
    )
    return code


def with_home(word: str) -> str:
    """A word of the command line with the home folder for ``~``, which shells leave as it is behind ``=`` and in quotes."""
    match = re.fullmatch(r"((?:[^=]*=)*?)(~.*)", word)
    if match is None:
        return word
    option = match[1].startswith("--") and match[1].count("=") == 1
    if match[2] == "~" and match[1] and not option:  # null in YAML
        return word
    return match[1] + expand_home(match[2], "command line")


def offered_commands(words: Sequence[str]) -> dict[str, Command | dict[str, Command]]:
    """Commands by name; a word that several share ("prepare nersemble") leads to a table of its own.

    ``words`` are those of the command line, which say what options are given.
    A command that cannot be loaded is offered where its name is free; it raises when it is called.
    """
    found: dict[str, Command | dict[str, Command]] = {}
    for name, plugin in sorted(
        discover("commands").items(), key=lambda item: (item[1].spec is None, item[0])
    ):
        spec = plugin.spec
        command = _broken(name, f"{plugin.origin}: {plugin.error}") if spec is None else _command(spec, words)
        first, _, second = name.partition(" ")
        place = found.setdefault(first, {} if second else command)
        if second and isinstance(place, dict):
            place[second] = command
    return found


def with_groups(commands: Mapping[str, Command | dict[str, Command]]) -> dict[str, Command]:
    """Each table of `offered_commands` as one command whose first argument names a command of the table."""
    return {
        name: _nested(dict(sorted(command.items()))) if isinstance(command, dict) else command
        for name, command in commands.items()
    }


def check_known(words: Sequence[str], commands: Mapping[str, Command | dict[str, Command]]) -> None:
    """Raise `InputError` where a command line names none of ``commands``.

    Raises `HeadbenchError` where it names a command that cannot be loaded: nobody knows what options that has.
    """
    word = next(iter(words), "-")
    table = commands.get(word)
    named = table.get(words[1]) if isinstance(table, dict) and words[1:] else table
    if getattr(named, "broken", False):
        named()  # type: ignore[operator,misc]
    if isinstance(table, dict) and words[1:]:
        if words[1].startswith("-") or words[1] in table:
            return
        word = f"{word} {words[1]}"
    elif word.startswith("-") or word in commands:
        return
    described: dict[str, Command] = {}
    for name, command in commands.items():
        parts = command if isinstance(command, dict) else {"": command}
        described |= {f"{name} {second}".strip(): part for second, part in parts.items()}
    name = COMMAND_ALIASES.get(word.lower().replace("_", "-"), "")
    if name not in described:
        name = next(iter(difflib.get_close_matches(word, described, n=1, cutoff=0.5)), "")
    remedy = "`headbench --help` lists them."
    if name:
        summary = (described[name].__doc__ or "").strip().splitlines()[0].rstrip(".")
        remedy = f"Did you mean `headbench {name}` ({summary})? {remedy}"
    raise InputError("command line", "", "a command of headbench", repr(word[:60]), remedy)


def _command(spec: CommandSpec, words: Sequence[str]) -> Command:
    settings_type: Any = Annotated[spec.settings, tyro.conf.OmitArgPrefixes]

    def command(settings: settings_type, json: bool = False) -> int:
        dependent = getattr(spec.settings, "dependent", ())
        check_dependent(dependent, given_options(words, spec.settings), settings)
        folder = getattr(settings, spec.writes) if spec.writes else None
        if folder:
            check_kind(Path(folder), *spec.kinds)
        lock = locked(Path(folder)) if folder else nullcontext()
        with log_to_terminal(), lock, progress(spec.name) as report:
            findings = spec.function(settings, report)
        show(json_module.dumps(findings.data, indent=1, default=plain) if json else findings.text)
        if findings.code is not None:
            return findings.code
        return ExitCode.OK if findings.passed else ExitCode.NEGATIVE

    command.__doc__ = f"{spec.summary}\n\nArgs:\n    json: Print the result as JSON."
    return command


def _broken(name: str, why: str) -> Command:
    def command() -> int:
        raise HeadbenchError(f"command {name!r} is broken: {why}")

    command.__doc__ = "Broken; calling it shows why."
    command.__dict__["broken"] = True
    return command


def _nested(group: Mapping[str, Command]) -> Command:
    # The parser calls the command that the second word names, and gives what it returned.
    choices = [Annotated[Any, tyro.conf.subcommand(name=n, constructor=c)] for n, c in group.items()]
    choice: Any = Union[(*choices, Annotated[None, tyro.conf.Suppress])]

    def chosen(command: choice) -> int:
        return command

    chosen.__doc__ = f"Followed by one of: {', '.join(group)}."
    return chosen


def _parts(words: Sequence[str], kind: Callable[[str], Any]) -> tuple[Any, ...]:
    """The values of a list, separated by commas, too. Raises `ValueError` for none: the option would be ignored."""
    parts = tuple(kind(part) for word in words for part in word.split(",") if part)
    if not parts:
        raise ValueError("expected at least one value, found none")
    return parts


def _values() -> tyro.constructors.ConstructorRegistry:
    """How two kinds of options are read and shown.

    Those that may be left out (``str | None``) as their values are; lists (``tuple[str, ...]``) also with commas.
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
