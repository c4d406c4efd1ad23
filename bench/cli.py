"""The command line: finds the named command, parses its arguments by its settings, and turns every error into one line and an exit code.

Light to import: the parser and the settings of a command are loaded on demand.
"""

# Without `from __future__ import annotations`, since the parser reads annotations created when a command is called.

import difflib
import errno
import json as json_module
import os
import re
import select
import signal
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

from .errors import EXIT_CODES, ExitCode, HeadbenchError, InputError, Interruption
from .machine import environment_variable, limit_threads
from .registry import Plugin, discover, get, resolve
from .specs import COMMAND_GROUPS, HELP, CommandSpec
from .terminal import prepare_streams, show, wrapped

_ALIASES = {
    "compare": "analyze",
    "doctor": "diagnose info",
    "evaluate": "eval evaluation metrics test",
    "inspect": "visualize",
    "lint": "check validate",
    "prepare nersemble": "preprocess process-data process",
    "run": "benchmark fit train",
    "run sweep": "prune",
    "synth": "generate synthesize",
    "table": "results show",
    "view": "viewer gui",
}
COMMAND_ALIASES = {word: name for name, words in _ALIASES.items() for word in words.split()}
"""Command names of other toolkits, and the equivalent command of headbench."""

START = """\
headbench compares methods that make animatable 3D avatars of heads from videos. Every method is trained on the same \
recordings and scored on the same frames that it has not seen: image quality, size, speed.

Try it; needs no data and no GPU, and takes a few minutes:
  headbench demo                       compare all methods on a synthetic head

With your own recordings, in the folder DATA, and results in a new folder OUT:
  headbench lint DATA                  check the recordings for faults
  headbench run --data DATA --out OUT  train, measure, write OUT/report.html

Results:
  headbench table OUT                  print the table, also for a paper
  headbench compare OUT                test the differences between methods

`headbench list methods` lists the methods, `headbench --help` all commands, and `headbench run --help` the options of one.\
"""
"""Printed without a command."""
FIRST = ("demo", "run", "status", "table", "compare")
"""Commands listed first in their group of the help."""

Command = Callable[..., Callable[[], int]]
"""Takes settings and returns a function that runs the command, which separates parsing errors from errors of the command."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command line, by default the process's own; returns the exit code, one of `ExitCode`."""
    # OpenMP's workers spin by default while they wait, which makes several threads many times slower than one on a
    # busy machine, so let them sleep. The variable is read once, when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    limit_threads()
    prepare_streams()
    words = sys.argv[1:] if arguments is None else arguments
    try:
        try:
            return _call(words)
        except BrokenPipeError:
            if not _reader_has_gone():
                raise
            return ExitCode.OK  # `headbench --help | head -1`: not an error
        finally:
            show(end="")  # flush buffered output while errors can still be reported
    except SystemExit as exited:  # of the parser: help, wrong usage
        return int(exited.code or ExitCode.OK)
    except HeadbenchError as error:
        return _fail(str(error), ExitCode.BAD_INPUT)
    except KeyboardInterrupt as error:
        ended = error if isinstance(error, Interruption) else Interruption(signal.SIGINT)
        return _fail(str(ended), ended.code)
    except OSError as error:
        return _fail(_described(error), ExitCode.BAD_INPUT)
    except Exception:  # noqa: BLE001
        traceback.print_exc()
        return _fail("unexpected error; please report it with the lines above", ExitCode.UNEXPECTED)


def _fail(message: str, code: ExitCode) -> ExitCode:
    print(wrapped(f"headbench: {message}", sys.stderr), file=sys.stderr)
    return code


def _described(error: OSError) -> str:
    """A system error as one line: file, reason and, if it is not obvious, remedy."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    if error.errno == errno.EEXIST and os.path.isfile(error.filename or ""):
        reason = "expected a folder, found a file"  # creating a folder fails with this error only if a file is there
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
    remedy = ". Free disk space or allow writing, then start again." if full else ""
    return f"{'' if error.filename is None else f'{error.filename}: '}{reason}{remedy}"


def _reader_has_gone() -> bool:
    """Whether standard output is a pipe whose reader has closed it."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _call(words: list[str]) -> int:
    """Call the command named by the arguments, or print help (without arguments `START`); return the exit code.

    Help of all commands only reads their specs; help of one command also loads its settings.
    """
    if words and words[0] in ("--version", "-V", "version"):
        show(f"headbench {version('headbench')}")
        return ExitCode.OK
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words:
        show(wrapped(START))
        return ExitCode.OK
    plugins = discover("commands")
    if words[0] in HELP:
        show(wrapped(help_page(plugins)))
        return ExitCode.OK
    name = next((name for name in (" ".join(words[:2]), words[0]) if name in plugins), "")
    if name:
        words = [with_home(word) for word in words[len(name.split()) :]]
        run: Callable[[], int] = _parse(_command(name, plugins[name], words), f"headbench {name}", words)
        return run()
    table = {name: plugin for name, plugin in plugins.items() if name.partition(" ")[0] == words[0]}
    if table and words[1:2] and words[1] in HELP:
        show(wrapped(help_page(table)))
        return ExitCode.OK
    if table and (len(words) == 1 or words[1].startswith("-")):
        seconds = ", ".join(sorted(name.partition(" ")[2] for name in table))
        raise InputError(
            "command line", words[0], f"followed by one of {seconds}", " ".join(words[1:]) or "nothing"
        )
    raise _unknown(words, plugins)


def help_page(plugins: Mapping[str, Plugin]) -> str:
    """List commands by group (`COMMAND_GROUPS` first), then `FIRST`, then by name; two-word commands are nested."""
    width = max(map(len, plugins)) + 2
    lines = ["usage: headbench COMMAND [OPTIONS]", "", "`headbench COMMAND --help` explains a command."]
    groups: dict[str, list[str]] = {group: [] for group in COMMAND_GROUPS}
    for name, plugin in sorted(plugins.items(), key=lambda item: (_place(item[0]), item[0])):
        group, summary = ("broken", "It cannot be loaded; calling it shows why.")
        if plugin.spec is not None:
            group, summary = plugin.spec.group, plugin.spec.summary
        groups.setdefault(group, []).append(f"  {name:<{width}}{summary}")
    for group, entries in groups.items():
        lines += ["", group.capitalize(), *entries] if entries else []
    return "\n".join([*lines, "", EXIT_CODES])


def _place(name: str) -> int:
    first = name.partition(" ")[0]
    return FIRST.index(first) if first in FIRST else len(FIRST)


def _unknown(words: Sequence[str], plugins: Mapping[str, Plugin]) -> InputError:
    """The error for an unknown command, with the nearest command."""
    firsts = {name.partition(" ")[0] for name in plugins}
    asked = " ".join(words[: 2 if words[0] in firsts else 1])
    name = COMMAND_ALIASES.get(asked.lower().replace("_", "-"), "")
    if name not in plugins:
        name = next(iter(difflib.get_close_matches(asked, plugins, n=1, cutoff=0.5)), "")
    remedy = "`headbench --help` lists them."
    if name:
        spec = plugins[name].spec
        summary = f" ({spec.summary.rstrip('.')})" if spec is not None else ""
        remedy = f"Did you mean `headbench {name}`{summary}? {remedy}"
    return InputError("command line", "", "a command of headbench", repr(asked[:60]), remedy)


def with_home(word: str) -> str:
    """Expand ``~`` in an argument, which shells do not do after ``=`` and in quotes."""
    match = re.fullmatch(r"((?:[^=]*=)*?)(~.*)", word)
    if match is None:
        return word
    option = match[1].startswith("--") and match[1].count("=") == 1
    if match[2] == "~" and match[1] and not option:  # null in YAML
        return word
    from .io.files import expand_home

    return match[1] + expand_home(match[2], "command line")


def _parse(command: Any, program: str, words: Sequence[str]) -> Any:
    """Parse arguments; return the result of ``command``. Exits with code 2 after printing what is wrong with them."""
    import tyro  # slow to import, like all that the functions below import

    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    # The parser knows dumb terminals, but not the variable.
    with environment_variable("TERM", "dumb" if os.environ.get("NO_COLOR") else None):
        return tyro.cli(command, prog=program, args=words, config=config, registry=_values())


def _command(name: str, plugin: Plugin, words: Sequence[str]) -> Command:
    """The command as a function of its settings, for the parser."""
    import tyro

    from .io.files import check_kind, to_jsonable
    from .io.lock import locked
    from .progress import log_to_terminal, progress

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
        if dependent := getattr(settings_class, "dependent", ()):
            from .options import check_dependent

            check_dependent(dependent, settings)
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


def _parts(words: Sequence[str], kind: Callable[[str], Any]) -> tuple[Any, ...]:
    """The values of a list, also separated by commas. Raises `ValueError` for none, since the option would be ignored."""
    parts = tuple(kind(part) for word in words for part in word.split(",") if part)
    if not parts:
        raise ValueError("expected at least one value, found none")
    return parts


def _values() -> Any:
    """Parsing and display of two kinds of options.

    Optional ones (``str | None``) are parsed like their values; lists (``tuple[str, ...]``) also with commas.
    """
    import tyro

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
