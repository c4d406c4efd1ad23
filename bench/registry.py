"""Finds methods, readers, metrics and reports by entry points; imports an implementation when it is used.

The command line does not import these packages: an entry point names a light spec, and the spec names its
implementation as ``"package.module:attribute"``. That of a command names its function; `INDEX` has the specs of our own.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import json
import logging
import os
import sys
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib import metadata
from importlib.metadata import Distribution, EntryPoint
from pathlib import Path
from typing import Any, Literal

from .errors import HeadbenchError, InputError
from .specs import (
    BenchmarkSpec,
    CommandSpec,
    ConditionSpec,
    DatasetSpec,
    MethodSpec,
    MetricSpec,
    ProfileSpec,
    ReportSpec,
)

Group = Literal[
    "methods", "datasets", "metrics", "profiles", "reports", "conditions", "benchmarks", "commands"
]
SPEC_TYPES: dict[str, type] = {
    "methods": MethodSpec,
    "datasets": DatasetSpec,
    "metrics": MetricSpec,
    "profiles": ProfileSpec,
    "reports": ReportSpec,
    "conditions": ConditionSpec,
    "benchmarks": BenchmarkSpec,
    "commands": CommandSpec,
}
log = logging.getLogger(__name__)
_OWN = "headbench"
INDEX = Path(__file__).with_name("commands.json")
"""Specs of headbench's commands, so that a list of them imports none of their modules; ``make index`` writes it."""
MOST_NAMES, NEAREST = 20, 5
"""Of more names, the error for an unknown one shows the nearest only; their number."""


@dataclass(frozen=True)
class Plugin:
    """An entry point with its spec, or the reason why it could not be loaded."""

    name: str
    origin: str  # distribution and version that provides it
    spec: Any | None
    error: str = ""


def discover(group: Group) -> dict[str, Plugin]:
    """All plug-ins of a group by name. One that cannot be loaded is listed with its error.

    If two distributions register the same name, headbench's takes precedence and the conflict is logged.
    """
    plugins: dict[str, Plugin] = {}
    for entry in sorted(entry_points(group=f"headbench.{group}"), key=lambda e: _origin(e) != _OWN):
        plugin, first = _load(entry, group), plugins.get(entry.name)
        if first is None:
            plugins[entry.name] = plugin
        elif first.origin != plugin.origin:
            log.warning("%s %r of %s is hidden by that of %s", group, entry.name, plugin.origin, first.origin)
    return plugins


def get(group: Group, name: str) -> Any:
    """Return the spec called ``name``, or named by ``"package.module:ATTRIBUTE"`` (a plug-in not yet packaged); no other is loaded."""
    if ":" in name:
        return _checked(resolve(name), group, name)
    entries = entry_points(group=f"headbench.{group}")
    named = sorted((entry for entry in entries if entry.name == name), key=lambda e: _origin(e) != _OWN)
    if not named:
        hint = "A plug-in is known when its package is installed here."
        raise unknown(f"registry of {group}", "name", name, {entry.name for entry in entries}, hint)
    plugin = _load(named[0], group)
    if plugin.spec is None:
        raise HeadbenchError(f"{group[:-1]} {name!r} of {plugin.origin} is broken: {plugin.error}")
    return plugin.spec


def is_outside(reference: str) -> bool:
    """Whether ``"package.module:Object"`` names an object outside this package."""
    return bool(reference) and reference.partition(":")[0].partition(".")[0] != _OWN


def resolve(reference: str) -> Any:
    """Import ``"package.module:attribute"``."""
    module_name, _, attribute = reference.partition(":")
    try:
        value: Any = importlib.import_module(module_name)
        for name in attribute.split("."):
            value = getattr(value, name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        where = " It is looked for on PYTHONPATH." if isinstance(error, ModuleNotFoundError) else ""
        raise HeadbenchError(f"{reference}: cannot be imported: {error}.{where}") from error
    return value


def readers() -> dict[str, DatasetSpec]:
    """The readers that are installed, by name."""
    specs = {name: plugin.spec for name, plugin in discover("datasets").items()}
    return {name: spec for name, spec in specs.items() if spec is not None and spec.reads}


def finds(spec: DatasetSpec, root: Path) -> bool:
    """Whether a reader finds captures; one that cannot be imported or fails finds none."""
    try:
        return bool(spec.find and resolve(spec.find)(root))
    except HeadbenchError:
        return False
    except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way; the others must still be asked
        log.warning("reader %s cannot check %s: %s: %s", spec.name, root, type(error).__name__, error)
        return False


def unknown(file: str, key: str, name: str, known: Any, remedy: str = "") -> InputError:
    """Build the error for a name that is not among ``known``, with the nearest one as a hint before ``remedy``.

    Of many names it shows the nearest ones only.
    """
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=NEAREST, cutoff=0.4)
    hint = f"Did you mean {near[0]!r}?" if near else ""
    many = near and len(names) > MOST_NAMES
    listed = f"{', '.join(near)} or {len(names) - len(near)} others" if many else ", ".join(names)
    return InputError(file, key, f"one of {listed}", repr(name), f"{hint} {remedy}".strip())


def entry_points(group: str) -> tuple[EntryPoint, ...]:
    """Entry points of a group. Cached, since searching all distributions takes 5 ms and there are hundreds of calls."""
    return _entries(group, tuple((folder, _changed_at(folder or ".")) for folder in sys.path))


def _changed_at(folder: str) -> int:
    """Modification time of a folder, which an installation changes; 0 if there is no folder."""
    try:
        return os.stat(folder).st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=64)
def _entries(group: str, folders: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    return tuple(metadata.entry_points(group=group))


def _origin(entry: EntryPoint) -> str:
    return _name_and_version(entry.dist)[0] if entry.dist is not None else "unknown"


@lru_cache(maxsize=64)
def _name_and_version(distribution: Distribution) -> tuple[str, str]:
    """Name and version of a distribution. Cached, since each access parses all of its metadata."""
    metadata = distribution.metadata
    return metadata["Name"], metadata["Version"]


def _load(entry: EntryPoint, group: str) -> Plugin:
    version = f" {_name_and_version(entry.dist)[1]}" if entry.dist is not None else ""
    origin = f"{_origin(entry)}{version}"
    try:
        indexed = _index().get(entry.value) if group == "commands" else None
        return Plugin(entry.name, origin, indexed or _checked(entry.load(), group, entry.name))
    except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way; the others must still load
        return Plugin(entry.name, origin, None, f"{type(error).__name__}: {error}")


@lru_cache
def _index() -> dict[str, CommandSpec]:
    """The commands of `INDEX` by function."""
    specs = (CommandSpec(**{**each, "kinds": tuple(each["kinds"])}) for each in json.loads(INDEX.read_text()))
    return {spec.function: spec for spec in specs}


def index_text() -> str:
    """What `INDEX` should contain: the specs of the functions that headbench's entry points name."""
    entries = [entry for entry in entry_points("headbench.commands") if _origin(entry) == _OWN]
    specs = [asdict(entry.load().spec) for entry in sorted(entries, key=lambda entry: entry.name)]
    return "[\n" + ",\n".join(map(json.dumps, specs)) + "\n]\n"


def _checked(value: Any, group: str, name: str) -> Any:
    spec = getattr(value, "spec", value) if group == "commands" else value
    if not isinstance(spec, SPEC_TYPES[group]):
        expected = "a function with @command" if group == "commands" else f"a {SPEC_TYPES[group].__name__}"
        raise InputError(f"registry of {group}", name, expected, f"a {type(spec).__name__}")
    return spec


@cache
def code_digest(reference: str) -> str:
    """First 12 hex digits of a SHA-256 over the Python files in the folder of ``"package.module:Object"``; "" without files.

    For a module of a package outside this one, all files below the package are included. The result is cached,
    see `forget_code`.
    """
    resolve(reference)  # imports the module
    source = getattr(sys.modules[reference.partition(":")[0]], "__file__", None)
    if source is None:
        return ""
    folder, files = Path(source).parent, Path(source).parent.glob("*.py")
    while is_outside(reference) and (folder / "__init__.py").is_file():
        files, folder = folder.rglob("*.py"), folder.parent
    digest = hashlib.sha256()
    for path in sorted(files):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:12]


def forget_code() -> None:
    """Clear the cache of `code_digest`, since files may have changed."""
    code_digest.cache_clear()
