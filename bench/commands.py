"""Finds the registered command named on the command line, and prints the help of all commands.

Light to import: the parser and the settings of a command are loaded on demand.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

from .errors import EXIT_CODES, ExitCode, InputError
from .registry import Plugin, discover
from .specs import COMMAND_GROUPS, HELP
from .terminal import show, wrapped

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


def call(words: Sequence[str]) -> int:
    """Call the command named by the arguments, or print help (without arguments `START`); return the exit code.

    Help of all commands only reads their specs; help of one command also loads its settings.
    Raises `InputError` for an unknown command, `HeadbenchError` for a command that cannot be loaded.
    """
    if not words:
        show(wrapped(START))
        return ExitCode.OK
    plugins = discover("commands")
    if words[0].startswith("--tyro-"):
        from .parsing import print_completion

        return print_completion(plugins, words)
    if words[0] in HELP:
        show(wrapped(help_page(plugins)))
        return ExitCode.OK
    name = next((name for name in (" ".join(words[:2]), words[0]) if name in plugins), "")
    if name:
        from .parsing import call_command

        return call_command(name, plugins, words[len(name.split()) :])
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
