"""Reference pages that are generated from the registries, specs and docstrings of headbench.

`pages` returns the text of every page. As a Sphinx extension, this module writes them to ``reference/generated`` before
Sphinx looks for sources, and defines object types, so that lint codes, metrics and other names have permanent links and
are found by the search.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import os
import re
import sys
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from docutils import nodes

import headbench
from headbench.bench import contracts, specs
from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import EXIT_CODES, ExitCode
from headbench.bench.executors.settings import Execution
from headbench.bench.registry import discover, resolve
from headbench.bench.specs import COMMAND_GROUPS
from headbench.datasets.lint.catalogue import GROUPS, RULES
from headbench.datasets.synthetic.capture import synthesize
from headbench.datasets.synthetic.command import SynthSettings
from headbench.reports.papers import measured_figures, printed_figures

OBJECT_TYPES = {
    "lint": "lint code",
    "metric": "metric",
    "profile": "metric profile",
    "condition": "condition",
    "exitcode": "exit code",
}
"""Object types besides those of Sphinx (`option` for options of commands, `confval` for settings), with their titles."""

HARNESS = ("path", "progress", "use_cache", "out", "workers", "execution")
"""Parameters of readers that headbench itself passes, and that are no settings."""

API_PAGES: dict[str, tuple[str, str]] = {
    "functions": ("Functions", "Functions for scripts: open captures, train, render, measure, read results."),
    "contracts": ("Contracts", "What a method, a reader and a metric exchange: values and protocols."),
    "specifications": ("Specifications", "Descriptions of plug-ins, as entry points name them."),
    "results": ("Results and conditions", "Stored results, and changes against the plain comparison."),
    "errors": ("Errors", "Exceptions that a user can act on."),
}


# Descriptions of fields ------------------------------------------------------------------------------------------------


def field_texts(cls: type) -> dict[str, str]:
    """Descriptions of the fields of a dataclass: strings below them, or the section "Attributes" of the docstring."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base) or base.__module__ == "builtins":
            continue
        texts.update(section_texts(inspect.getdoc(base) or "", "Attributes"))
        if parameters := section_texts(
            inspect.getdoc(base) or "", "Parameters"
        ):  # of the function of a command
            texts.update(parameters)
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        group: list[ast.AnnAssign] = []  # fields in consecutive lines share the text below them
        for node in body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                follows = bool(group) and group[-1].end_lineno == node.lineno - 1
                group = [*group, node] if follows else [node]
                continue
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                texts |= dict.fromkeys(
                    (each.target.id for each in group), " ".join(str(node.value.value).split())
                )  # type: ignore[union-attr]
            group = []
    return texts


def section_texts(docstring: str, section: str) -> dict[str, str]:
    """Descriptions of the names in a section of a numpy docstring; names that share an entry share its text."""
    match = re.search(
        rf"^{section}\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)", inspect.cleandoc(docstring), re.DOTALL | re.MULTILINE
    )
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in match[1].splitlines() if match else ():
        if line and not line[0].isspace():
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
            texts.update(dict.fromkeys(names, ""))
        for name in names if line[:1].isspace() else ():
            texts[name] = f"{texts[name]} {line.strip()}".strip()
    return texts


def without_sections(docstring: str) -> str:
    """The summary and the description of a numpy docstring."""
    return re.split(r"^\w+\n-{3,}$", docstring, maxsplit=1, flags=re.MULTILINE)[0]


def type_text(hint: Any) -> str:
    """An annotation in words: "int", "one of paper, official", "list of text"."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is typing.Annotated:
        return type_text(arguments[0])
    if origin is Literal:
        return "one of " + ", ".join(f"`{value}`" if value != "" else '`""`' for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(type_text(argument) for argument in arguments)
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return f"list of {type_text(arguments[0])}"
    if origin is tuple:
        return "(" + ", ".join(map(type_text, arguments)) + ")"
    if origin in (list, Iterable) or getattr(origin, "__name__", "") == "Sequence":
        return f"list of {type_text(arguments[0])}"
    if origin is dict or getattr(origin, "__name__", "") == "Mapping":
        return "mapping"
    if hint is None or hint is types.NoneType:
        return "none"
    names = {str: "text", int: "int", float: "float", bool: "true or false", Path: "path", Any: "any"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def value_text(value: Any) -> str:
    """A default or a setting as YAML has it."""
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {value_text(each)}" for key, each in value.items()) + "}"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "true", False: "false"}[value]
    return '""' if value == "" else str(value)


def escaped(text: str) -> str:
    """Text of a docstring as Markdown: characters with a meaning are escaped outside of code."""
    parts = re.split(r"(``[^`]+``|`[^`]+`|(?<![\w-])--[a-z][\w-]*)", " ".join(text.split()))
    return "".join(
        part
        if part.startswith("`")
        else f"`{part}`"
        if part.startswith("--")
        else re.sub(r"([*<>\[\]#|\\])", r"\\\1", part)
        for part in parts
    )


def default_of(field: Any) -> Any:
    """The default of a field of a dataclass; MISSING where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def directive(name: str, argument: str, text: str = "", **options: str) -> str:
    """A directive in MyST."""
    lines = [f":{key}: {value}" for key, value in options.items() if value]
    if name in ("option", "confval"):  # hundreds on a page
        lines.append(":no-contents-entry:")
    return "\n".join([f":::{{{name}}} {argument}", *lines, *([""] if lines else []), text, ":::", ""])


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in map(list, lines)) + "\n"


def link(page: str, text: str = "") -> str:
    """A link to another generated page."""
    return f"[{text}]({page})"


# Commands --------------------------------------------------------------------------------------------------------------


class Option(typing.NamedTuple):
    """An option of a command, or a positional argument."""

    name: str
    metavar: str
    text: str
    default: str


def options_of(cls: type) -> Iterator[Option]:
    """Options that the parser builds of a dataclass of settings."""
    import tyro

    hints, texts = get_type_hints(cls, include_extras=True), field_texts(cls)
    for field in dataclasses.fields(cls):
        hint, marks = hints[field.name], ()
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield from options_of(hint)  # the parser leaves out the name of the group
            continue
        if get_origin(hint) is typing.Annotated:
            marks = hint.__metadata__
            hint = get_args(hint)[0]
        metavar = next((mark.metavar for mark in marks if getattr(mark, "metavar", None)), "")
        given = next((mark.name for mark in marks if getattr(mark, "name", None)), "") or field.name
        value = default_of(field)
        choices = get_args(hint) if get_origin(hint) is Literal else ()
        if not metavar and hint is not bool:
            metavar = "{" + ",".join(map(str, choices)) + "}" if choices else metavar_text(hint)
        positional = tyro.conf.Positional in marks
        name = given.upper() if positional else "--" + given.replace("_", "-")
        default = "" if value is dataclasses.MISSING or value in ((), False, None) else value_text(value)
        text = texts.get(field.name) or next((m.help for m in marks if getattr(m, "help", None)), "")
        yield Option(name, "" if positional else metavar, text, default)


def metavar_text(hint: Any) -> str:
    """How the help writes the values of an option."""
    arguments = [kind for kind in get_args(hint) if kind not in (types.NoneType, Ellipsis)]
    if get_origin(hint) is Literal:
        return "{" + ",".join(map(str, arguments)) + "}"
    if get_origin(hint) in (Union, types.UnionType):
        return "|".join(map(metavar_text, arguments))
    if get_origin(hint) is tuple:
        repeated = len(get_args(hint)) == 2 and get_args(hint)[1] is Ellipsis
        return (
            f"{metavar_text(arguments[0])} ..." if repeated else " ".join(map(metavar_text, get_args(hint)))
        )
    return getattr(hint, "__name__", str(hint)).upper()


def page_name(command: str) -> str:
    """File of a command's page, without extension."""
    return command.replace(" ", "-")


def command_pages() -> dict[str, str]:
    """A page for each command, and one that lists them in groups."""
    plugins = {name: plugin.spec for name, plugin in own("commands").items()}
    pages = {}
    for name, spec in plugins.items():
        cls = resolve(spec.settings)
        positional = [option for option in options_of(cls) if not option.name.startswith("--")]
        words = " ".join([f"headbench {name}", *(option.name for option in positional), "[OPTIONS]"])
        parts = [f"# headbench {name}\n", escaped(spec.summary), f"\n```text\n{words}\n```\n"]
        notes = inspect.getdoc(cls) or ""
        # Neither the docstring that dataclasses write themselves, nor one that says what the heading says.
        if not notes.startswith((f"{cls.__name__}(", "Settings of ``headbench")):
            parts.append(paragraphs(without_sections(notes)))
        if hasattr(cls, "notes"):
            parts.append("\n" + escaped(cls.notes()) + "\n")
        seconds = [other for other in plugins if other.startswith(f"{name} ")]
        if seconds:
            links = ", ".join(link(f"{page_name(other)}.md", f"`headbench {other}`") for other in seconds)
            parts.append(f"\nRelated commands: {links}.\n")
        parts.append(f"\n## Options\n\n```{{program}} headbench {name}\n```\n")
        for option in sorted(options_of(cls), key=lambda option: option.name.startswith("--")):
            text = escaped(option.text) + (f"\n\nDefault: `{option.default}`" if option.default else "")
            parts.append(directive("option", f"{option.name} {option.metavar}".strip(), text))
        parts.append(directive("option", "--json", "Print the result as JSON."))
        for options, other, values in getattr(cls, "dependent", ()):
            named = ", ".join(f"`--{one.replace('_', '-')}`" for one in options)
            what = "with" if values is not False else "without"
            value = " or ".join(values) if isinstance(values, tuple) else ""
            parts.append(
                f"{named}: only {what} `--{other.replace('_', '-')}{' ' * bool(value)}{value}`, refused otherwise.\n"
            )
        pages[f"commands/{page_name(name)}"] = "\n".join(parts)
    lines = ["# Commands\n", "Every command explains itself with `--help`. Options are read from the same"]
    lines += ["descriptions as this page.\n", escaped(EXIT_CODES), ""]
    for group in [
        *COMMAND_GROUPS,
        *sorted({spec.group for spec in plugins.values()} - set(COMMAND_GROUPS)),
    ]:
        rows = [
            (link(f"{page_name(name)}.md", f"`headbench {name}`"), escaped(spec.summary))
            for name, spec in plugins.items()
            if spec.group == group
        ]
        lines += [f"## {group.capitalize()}\n", table(("command", "what it does"), rows)]
    lines += ["```{toctree}\n:hidden:\n", *(page_name(name) for name in plugins), "```\n"]
    pages["commands/index"] = "\n".join(lines)
    return pages


def paragraphs(text: str) -> str:
    """Paragraphs of a docstring as Markdown."""
    return "\n\n".join(escaped(part) for part in text.strip().split("\n\n") if part.strip()) + "\n"


def own(group: Any) -> dict[str, Any]:
    """Plug-ins that headbench itself registers."""
    return {
        name: plugin
        for name, plugin in discover(group).items()
        if plugin.spec is not None and plugin.origin.split()[0] == "headbench"
    }


# Settings --------------------------------------------------------------------------------------------------------------


class Setting(typing.NamedTuple):
    """A setting that ``--set`` or a YAML file can change."""

    path: str
    kind: str
    default: str
    text: str


def settings_of(cls: type, prefix: str = "") -> Iterator[Setting]:
    """All settings of a dataclass, those of groups with their dotted paths."""
    hints, texts = get_type_hints(cls), field_texts(cls)
    for field in dataclasses.fields(cls):
        hint, path = hints[field.name], f"{prefix}{field.name}"
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield from settings_of(hint, f"{path}.")
            continue
        value = default_of(field)
        default = "" if value is dataclasses.MISSING else value_text(value)
        yield Setting(path, type_text(hint), default, texts.get(field.name, ""))


def confval(setting: Setting, name: str = "") -> str:
    """A setting as an object of the reference."""
    default = f"`{setting.default}`" if setting.default else "required"
    return directive(
        "confval", name or setting.path, escaped(setting.text), type=setting.kind, default=default
    )


def preset_rows(spec: Any) -> tuple[list[str], list[list[str]]]:
    """Settings that the presets of a method change, as a table: a row for each setting, a column for each preset."""
    flat = {preset: dict(flattened(values)) for preset, values in spec.presets.items()}
    keys = dict.fromkeys(key for values in flat.values() for key in values)
    rows = [
        [f"`{key}`", *(shown_value(flat[p][key]) if key in flat[p] else "" for p in flat)] for key in keys
    ]
    return ["setting", *(f"`{preset}`" for preset in flat)], rows


def shown_value(value: Any) -> str:
    """A value in a table."""
    text = value_text(value)
    return f"`{text}`" if "--" in text else text


def flattened(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings by their dotted paths."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def method_pages() -> dict[str, str]:
    """A page for each method with its presets and settings, and one that lists them."""
    pages, listed = {}, []
    for name, plugin in own("methods").items():
        spec = plugin.spec
        listed.append((link(f"{name}.md", f"`{name}`"), escaped(spec.summary), ", ".join(spec.presets)))
        head = ", ".join(spec.head_models) or "any"
        facts = [
            ("version", spec.version),
            ("head models", head),
            ("input", "one video, views joined" if spec.monocular else "all views"),
            ("devices", ", ".join(spec.devices) or "any"),
            ("implementation", "of this package" if spec.native else "adapter to the authors' program"),
            ("in a run that names no methods", "yes" if spec.default else "no"),
        ]
        parts = [
            f"# {name}\n",
            escaped(spec.summary),
            "",
            *(f"- {name}: {value}" for name, value in facts),
            "",
        ]
        parts += card_parts(spec)
        parts += ["## Presets\n", "Settings that a preset changes; the others have the defaults below.\n"]
        parts += [table(*preset_rows(spec)), "## Settings\n"]
        parts.append(f"In `--set settings.{name}.KEY=VALUE`, or under `settings: {name}:` in a YAML file.\n")
        for setting in settings_of(contracts.Budget, f"settings.{name}.budget."):
            parts.append(confval(setting))
        for setting in settings_of(resolve(spec.config), f"settings.{name}.") if spec.config else ():
            parts.append(confval(setting))
        pages[f"methods/{name}"] = "\n".join(parts)
    lines = ["# Methods, presets and settings\n", table(("method", "what it is", "presets"), listed)]
    lines += ["```{toctree}\n:hidden:\n", *own("methods"), "```\n"]
    pages["methods/index"] = "\n".join(lines)
    return pages


def card_parts(spec: Any) -> list[str]:
    """Source, citation, and printed and measured figures of a method."""
    if not spec.source:
        return []
    parts = ["## Source\n", escaped(spec.source), ""]
    parts += [f"```bibtex\n{spec.bibtex.strip()}\n```\n"] if spec.bibtex else []
    figures = printed_figures(spec)
    if figures:
        keys = [k for k in PRINTED if any(k in figure.values for figure in figures)]
        rows = [
            (
                f"{figure.paper}, {escaped(figure.table)}",
                "its own paper" if figure.own else "run by others",
                escaped(figure.data),
                *(figure.values.get(key, "") for key in keys),
            )
            for figure in figures
        ]
        parts += [
            "## Printed figures\n",
            "As papers printed them, on their own data and by their own protocols.",
        ]
        parts += ["Not comparable with each other or with measurements here.\n"]
        parts += [table(("table", "by", "data", *(PRINTED[key] for key in keys)), rows), ""]
    measured = measured_figures(spec.name)
    if measured:
        keys = [key for key in PRINTED if key in measured.values]
        parts += [
            "## Measured figures\n",
            f"Measured by headbench in {measured.suite}: {escaped(measured.data)}.\n",
        ]
        parts += [table([PRINTED[key] for key in keys], [[measured.values[key] for key in keys]]), ""]
    return parts


PRINTED = {
    f"{task}/{metric}": f"{title} {metric.upper()}"
    for task, title in (("novel_view", "novel view"), ("self_reenactment", "self-reenactment"))
    for metric in ("psnr", "ssim", "lpips")
} | {"storage": "MB", "fps": "FPS"}
"""Columns of the figures of a method."""


def run_settings_page() -> str:
    """Settings of a run: those of its YAML file and of ``--set``."""
    lines = ["# Settings of a run\n"]
    lines.append(
        "Keys of the YAML file that `headbench run --config FILE` reads, and of `--set KEY=VALUE`. Options of the "
        "command line have precedence over the file, `--set` over both. Unknown keys are refused.\n"
    )
    lines += [confval(setting) for setting in settings_of(RunConfig)]
    lines.append("## Execution\n\nWhere cells are executed. These settings do not change results.\n")
    lines += [confval(setting) for setting in settings_of(Execution, "execution.")]
    return "\n".join(lines)


def function_settings(function: Any, leave_out: Iterable[str]) -> Iterator[Setting]:
    """Keyword parameters of a function as settings; those of the synthetic capture are described at its command."""
    hints = get_type_hints(function)
    described = field_texts(SynthSettings) if function is synthesize else {}
    texts = described | section_texts(inspect.getdoc(function) or "", "Parameters")
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is not parameter.KEYWORD_ONLY or name in leave_out:
            continue
        default = "" if parameter.default is parameter.empty else value_text(parameter.default)
        yield Setting(name, type_text(hints.get(name, Any)), default, texts.get(name, ""))


def readers_page() -> str:
    """Readers and the synthetic capture, with their settings."""
    lines = ["# Readers and their settings\n"]
    lines.append(
        "A reader opens captures of one layout. `headbench run` takes its settings as `--set reader_settings.KEY=VALUE`, "
        "other commands as `--set KEY=VALUE`.\n"
    )
    for name, plugin in own("datasets").items():
        lines += [f"## {name}\n", escaped(plugin.spec.summary) + "\n"]
        for setting in function_settings(resolve(plugin.spec.implementation), HARNESS):
            lines.append(confval(setting, f"{name}: {setting.path}"))
    return "\n".join(lines)


class Format(NamedTuple):
    """A format of other programs, as the docstring of the module that reads it states under "Formats read:"."""

    module: str
    name: str
    writer: str
    checked: str
    """A public file of the program on which the reader was checked; "" if there was none."""


def formats() -> list[Format]:
    """Formats of other programs, by module. Raises `ValueError` for an entry that does not state writer and check."""
    found = []
    root = Path(headbench.bench.__path__[0]).parent
    for path in sorted(path for package in PACKAGES for path in (root / package).rglob("*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        _, heading, entries = text.partition("\nFormats read:\n")
        for entry in re.findall(r"^- .*(?:\n  .*)*", entries if heading else "", re.MULTILINE):
            match = FORMAT.fullmatch(" ".join(entry.split()))
            if not match:
                raise ValueError(
                    f"{path}: expected `- NAME. Written by WHO. Checked on WHAT.`, found {entry!r}"
                )
            found.append(Format(path.relative_to(root).as_posix(), match[1], match[2], match[3] or ""))
    return found


PACKAGES = ("bench", "datasets", "methods", "metrics", "reports")
FORMAT = re.compile(
    r"- (.+?)\. Written by (.+?)\. (?:Checked on (.+)|Not checked on a file of the program)\."
)


def formats_page() -> str:
    """Formats of other programs, and the public file on which each reader was checked."""
    known = formats()
    rows = ([one.name, one.writer, one.checked or "**not checked**", f"`{one.module}`"] for one in known)
    return (
        "# Formats of other programs\n\n"
        f"{sum(bool(one.checked) for one in known)} of {len(known)} formats were checked on a file that the program wrote: it was read, "
        "and its values were compared with what the program means by them. The others were written from the "
        "code or the description of the program, as no file of it was public; a report with such a file is welcome.\n\n"
        + table(("format", "written by", "checked on", "reader"), rows)
    )


# Lists -----------------------------------------------------------------------------------------------------------------


def lint_page() -> str:
    """Every code of the linter."""
    lines = ["# Lint codes\n"]
    lines.append(
        "Codes of `headbench lint`. *error*: results would be wrong, or the capture cannot be read; *warning*: results "
        "may be wrong; *note*: information. `--ignore CODE` leaves a code out.\n"
    )
    for digit, subject in GROUPS.items():
        lines.append(f"## HB{digit}xx: {subject}\n")
        for rule in (rule for rule in RULES if rule.code[2] == digit):
            layout = "" if not rule.of_layout else " Only in captures of the GaussianAvatars/VHAP layout."
            title = rule.title[:1].upper() + rule.title[1:]
            text = f"**{escaped(title)}** ({rule.severity}). {escaped(rule.remedy)}{layout}"
            lines.append(directive("lint", rule.code, text))
    return "\n".join(lines)


def metrics_page() -> str:
    """Every metric, and every profile with its metrics."""
    lines = ["# Metrics\n"]
    lines.append(
        "Metrics of frames are computed from the stored 8-bit frames. Names with an `@` belong to a "
        "[profile](#profiles). The text of each is the definition; *implementation* names the function.\n"
    )
    for name, plugin in own("metrics").items():
        lines.append(metric_entry(name, plugin.spec))
    lines.append("## Profiles\n")
    lines.append(
        "Definitions that libraries and the code of papers use under the same names. "
        "`--set metric_profiles=canonical,NAME` measures them; each has a table of its own.\n"
    )
    for name, plugin in own("profiles").items():
        spec = plugin.spec
        text = f"{escaped(spec.summary[:1].upper() + spec.summary[1:])}.\n\nSource: {escaped(spec.source)}."
        lines += [f"### Profile {name}\n", directive("profile", name, text)]
        lines += [metric_entry(metric.name, metric) for metric in spec.metrics if "@" in metric.name]
    return "\n".join(lines)


def metric_entry(name: str, spec: Any) -> str:
    """A metric as an object of the reference."""
    better = "higher" if spec.higher_is_better else "lower"
    function = resolve(spec.implementation)
    definition = paragraphs(without_sections(inspect.getdoc(function) or ""))
    facts = [
        f"{better} is better",
        f"unit {spec.unit}" if spec.unit else "no unit",
        f"measured for each {spec.kind}"
        if spec.kind in ("avatar", "training", "frame")
        else KINDS[spec.kind],
    ]
    if spec.machine_bound:
        facts.append("depends on the machine and its load")
    if spec.suspect_above is not None:
        facts.append(f"values above {spec.suspect_above:g} {spec.unit} are marked as suspect")
    text = f"**{escaped(spec.label)}.** {escaped(spec.summary)}\n\n{definition}\n"
    facts[0] = facts[0].capitalize()
    text += f"\n{'; '.join(facts)}. Implementation: `{spec.implementation}`."
    return directive("metric", name, text)


KINDS = {
    "regional": "measured for each frame and region",
    "face": "measured for each frame in which the face is visible",
    "temporal": "measured for each frame and its predecessor",
    "sequence": "measured for all frames of a sequence at a camera together",
    "set": "measured for all frames of a subject and task together",
    "mechanism": "measured for each avatar over the poses of its training",
}


def conditions_page() -> str:
    """Registered changes that conditions of a run name."""
    lines = ["# Conditions\n"]
    lines.append(
        "Changes that a condition of a run can name. See [conditions and experiments]"
        "(../../howto/conditions.md).\n"
    )
    for name, plugin in own("conditions").items():
        spec = plugin.spec
        function = resolve(spec.implementation)
        about = paragraphs(without_sections(inspect.getdoc(function) or ""))
        kind = {
            "clip": "changes the clip",
            "derive": "changes a trained avatar",
            "drive": "drives avatars otherwise",
            "views": "changes the views of scored frames",
        }
        text = f"{escaped(spec.summary)} ({kind[spec.kind]})\n\n{about}\n"
        rows = [
            (f"`{s.path}`", s.kind, f"`{s.default}`" if s.default else "required", escaped(s.text))
            for s in function_settings(function, HARNESS)
        ]
        text += "\n" + table(("parameter", "type", "default", ""), rows) if rows else ""
        lines.append(directive("condition", name, text))
    return "\n".join(lines)


def lists_page() -> str:
    """Reports and benchmarks of the toolkit."""
    lines = ["# Reports and benchmarks\n", "## Reports\n"]
    lines.append("Views of stored results; those of a run are written when it ends.\n")
    lines.append(
        table(
            ("report", "what it shows"),
            ((f"`{n}`", escaped(p.spec.summary)) for n, p in own("reports").items()),
        )
    )
    lines += ["## Benchmarks\n", "Measurements of headbench itself: `headbench doctor bench NAME`.\n"]
    lines.append(
        table(
            ("benchmark", "what it measures"),
            ((f"`{n}`", escaped(p.spec.summary)) for n, p in own("benchmarks").items()),
        )
    )
    return "\n".join(lines)


def exit_codes_page() -> str:
    """Exit codes of all commands."""
    texts = dict(
        line.split(" ", 1) for line in EXIT_CODES.removeprefix("Exit codes: ").rstrip(".").split("; ")
    )
    lines = ["# Exit codes\n", "The same in every command.\n"]
    for code in ExitCode:
        text = texts.get(str(code.value), f"Ended by {code.name.lower()}.")
        if code >= 129:
            text = {129: "Ended by SIGHUP.", 130: "Ended by Ctrl-C (SIGINT).", 143: "Ended by SIGTERM."}[code]
        lines.append(
            directive("exitcode", str(code.value), text[:1].upper() + escaped(text[1:]).rstrip(".") + ".")
        )
    return "\n".join(lines)


# Python ----------------------------------------------------------------------------------------------------------------


def api_group(name: str) -> str:
    """The page of `API_PAGES` that documents a public name."""
    value = getattr(headbench, name)
    if inspect.isfunction(value):
        return "functions"
    if isinstance(value, type) and issubclass(value, Exception):
        return "errors"
    if getattr(value, "__module__", "") == specs.__name__ or name in ("DependentOptions", "MethodNeeds"):
        return "specifications"
    if getattr(value, "__module__", "") == contracts.__name__ or name in ("STAGES", "AdaptedClip"):
        return "contracts"
    return "results"


def api_pages() -> dict[str, str]:
    """Pages of the public names of `headbench`, from their docstrings."""
    grouped: dict[str, list[str]] = {page: [] for page in API_PAGES}
    for name in headbench.__all__:
        grouped[api_group(name)].append(name)
    pages = {}
    for page, (title, about) in API_PAGES.items():
        parts = [f"# {title}\n", about + "\n"]
        parts.append(", ".join(f"{{py:obj}}`~headbench.{name}`" for name in grouped[page]) + "\n")
        if page == "contracts":
            parts.append(f"{inspect.getdoc(contracts)}\n")  # its headings and lists are Markdown, too
        for name in grouped[page]:
            value = getattr(headbench, name)
            if not isinstance(value, type) and not inspect.isfunction(value):
                parts.append(directive("py:data", name, escaped(constant_text(name)), module="headbench"))
                continue
            lines = [f"```{{eval-rst}}\n.. {api_directive(value)}:: headbench.{name}"]
            if isinstance(value, type) and not issubclass(value, Exception):
                lines.append("   :members:")
                if getattr(value, "_is_protocol", False):  # what a plug-in has to provide
                    lines.append("   :undoc-members:")
                    lines += ["   :special-members: __call__"] * ("__call__" in vars(value))
            parts += [*lines, "```\n"]
        pages[f"api/{page}"] = "\n".join(parts)
    rows = [
        (link(f"{p}.md", API_PAGES[p][0]), API_PAGES[p][1], ", ".join(f"`{n}`" for n in names))
        for p, names in grouped.items()
    ]
    lines = ["# Python API\n", "Everything that a script or a plug-in needs is imported from `headbench`.\n"]
    lines += [
        table(("page", "what it has", "names"), rows),
        "```{toctree}\n:hidden:\n",
        *API_PAGES,
        "```\n",
    ]
    pages["api/index"] = "\n".join(lines)
    return pages


def constant_text(name: str) -> str:
    """The string below a public constant in its module."""
    source = inspect.getsource(sys.modules[next(m for m in HOMES if hasattr(sys.modules[m], name))])
    body = ast.parse(source).body
    for statement, text in itertools.pairwise(body):
        target = (
            statement.targets[0] if isinstance(statement, ast.Assign) else getattr(statement, "target", None)
        )
        if isinstance(target, ast.Name) and target.id == name and isinstance(text, ast.Expr):
            return str(ast.literal_eval(text.value))
    raise ValueError(f"{name} has no string below it")


HOMES = ("headbench.bench.contracts", "headbench.bench.condition", "headbench.bench.rows")
"""Modules with public constants, in which their text is looked for."""


def api_directive(value: Any) -> str:
    """The directive of autodoc for a value."""
    if inspect.isfunction(value):
        return "autofunction"
    return "autoexception" if issubclass(value, Exception) else "autoclass"


# Sphinx ----------------------------------------------------------------------------------------------------------------


def pages() -> dict[str, str]:
    """All generated pages: text by path below ``reference/generated``, without extension."""
    return {
        **command_pages(),
        **method_pages(),
        **api_pages(),
        "run-settings": run_settings_page(),
        "readers": readers_page(),
        "formats": formats_page(),
        "lint": lint_page(),
        "metrics": metrics_page(),
        "conditions": conditions_page(),
        "lists": lists_page(),
        "exit-codes": exit_codes_page(),
    }


def write_pages(app: Any) -> None:
    """Write the pages that changed, and remove those that are no longer made."""
    folder = Path(app.srcdir, "reference", "generated")
    made = {folder / f"{name}.md": f"{text.rstrip()}\n" for name, text in pages().items()}
    for path in folder.rglob("*.md"):
        if path not in made:
            path.unlink()
    for path, text in made.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")


def parseable_signature(
    app: Any, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str, str | None] | None:
    """Show defaults that are no Python as dots, without which types are not linked; protocols are not called."""
    if isinstance(value, type) and getattr(value, "_is_protocol", False):
        return "", returns
    if signature is None:
        return None
    return re.sub(r"<factory>|<function [\w.]+(?:<lambda>)?>", "...", signature), returns


def name_outside_pages(app: Any, page: str, source: list[str]) -> None:
    """Show the path of a page that is not on the site, such as the README of the repository, in place of a link."""
    folder = Path(app.srcdir, page).parent

    def shown(match: re.Match[str]) -> str:
        path = (folder / match[2]).resolve()
        if path.is_relative_to(app.srcdir) or not path.is_file():
            return match[0]
        return f"{match[1]} (`{path.relative_to(Path(app.srcdir).parent)}`)"

    source[0] = re.sub(r"\[([^\]]+)\]\(((?:\.\./)+[^)#]+\.md)(?:#[^)]*)?\)", shown, source[0])


def setup(app: Any) -> dict[str, bool]:
    """Register pages, object types and the role."""
    os.environ.setdefault("COLUMNS", "100")
    for name, title in OBJECT_TYPES.items():
        app.add_object_type(name, name, objname=title, indextemplate=f"pair: %s; {title}")
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-signature", parseable_signature)
    app.connect("source-read", name_outside_pages)
    app.add_role("public", public_name_role)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def public_name_role(
    role: str,
    rawtext: str,
    text: str,
    lineno: int,
    inliner: Any,
    options: Any = None,
    content: Any = (),
) -> Any:
    """A link to a public name of headbench, or code: the default role of docstrings."""
    if text.split(".")[0] in headbench.__all__:
        from sphinx.addnodes import pending_xref

        reference = pending_xref(
            rawtext, refdomain="py", reftype="obj", reftarget=f"headbench.{text}", refwarn=False
        )
        reference += nodes.literal("", text)
        return [reference], []
    return [nodes.literal(rawtext, text)], []
