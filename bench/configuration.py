"""Converts mappings and ``--set a.b=c`` into frozen dataclasses of settings. Unknown keys and wrong types are refused."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from typing_extensions import TypedDict

from .errors import InputError
from .io.documents import parse_setting, read_yaml, settings_of
from .io.files import expand_home
from .registry import unknown

T = TypeVar("T")


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Turn ``["a.b=1", "c=x"]`` into ``{"a": {"b": 1}, "c": "x"}``; values are YAML scalars or lists."""
    nested: dict[str, Any] = {}
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        keys = path.strip().split(".")
        if not equals or not all(keys):
            raise InputError("--set", assignment, "KEY=VALUE with dots in KEY for nesting", "no such form")
        value = parse_setting(text, "--set", path)
        level = nested
        for key in keys[:-1]:
            level = level.setdefault(key, {})
            if not isinstance(level, dict):
                raise InputError("--set", path, f"{key} to be a group of settings", "a value set before")
        level[keys[-1]] = value
    return with_homes(nested, "--set")


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings; ``over`` wins."""
    result = dict(base)
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merge(result[key], value)
        else:
            result[key] = value
    return result


def with_homes(value: Any, source: str) -> Any:
    """Return settings with ``~`` in paths replaced by the home folder, see `expand_home`."""
    if isinstance(value, Mapping):
        return {key: with_homes(each, source) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(with_homes(each, source) for each in value)
    return expand_home(value, source) if isinstance(value, str) else value


def build(cls: type[T], values: Mapping[str, Any], source: str, prefix: str = "") -> T:
    """Build dataclass ``cls`` from a mapping.

    Parameters
    ----------
    source : str
        File or option of the values, for error messages.
    prefix : str
        Dotted path of ``values`` in the source.
    """
    built: T = settings_of(values, cls, source, prefix)
    return built


def build_folder(cls: type[T], folder: Path) -> dict[str, T]:
    """Build ``cls`` from every YAML file of a folder, by file name."""
    return {path.stem: build_file(cls, path) for path in sorted(folder.glob("*.yaml"))}


def build_named(cls: type[T], folder: Path, name: str, option: str) -> T:
    """Build ``cls`` from the YAML file of a name."""
    names = [path.stem for path in folder.glob("*.yaml")]
    if name not in names:
        raise unknown("command line", option, name, names)
    return build_file(cls, folder / f"{name}.yaml")


def build_file(cls: type[T], path: Path) -> T:
    """Build ``cls`` from a YAML file."""
    return build(cls, read_yaml(path), str(path))


def setting_paths(cls: Any, prefix: str = "") -> list[str]:
    """Dotted path of every setting of a dataclass, groups before their members."""
    hints, paths = get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        paths.append(f"{prefix}{field.name}")
        if dataclasses.is_dataclass(hints[field.name]):
            paths += setting_paths(hints[field.name], f"{prefix}{field.name}.")
    return paths


def deciding_settings(config: Any) -> Any:
    """The settings of a dataclass that affect results, as plain values for digests; other values are returned unchanged.

    Settings in the class variable ``places`` are left out: paths on this machine, and time limits.
    """
    if isinstance(config, tuple):
        return tuple(map(deciding_settings, config))
    if not dataclasses.is_dataclass(config):
        return config
    return {
        field.name: deciding_settings(getattr(config, field.name))
        for field in dataclasses.fields(config)
        if field.name not in getattr(config, "places", ())
    }


def build_arguments(
    function: Callable[..., Any], values: Mapping[str, Any], source: str, *, harness: Collection[str] = ()
) -> dict[str, Any]:
    """Check keyword arguments for a function, and convert them to its annotations.

    The first parameter and those named in ``harness`` are not settings: the caller provides them. Raises
    `InputError` as `build` does.
    """
    parameters = list(inspect.signature(function).parameters.values())[1:]
    names = {p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)} - {*harness}
    for key in values.keys() & {*harness}:
        raise unknown(source, key, key, names)
    hints = get_type_hints(function)
    kinds = {name: hints.get(name, Any) if name in values else Any for name in names}
    kind = TypedDict("Arguments", kinds, total=False)  # type: ignore[misc]
    others = any(p.kind == p.VAR_KEYWORD for p in parameters)
    arguments: dict[str, Any] = settings_of(values, kind, source, others=others)
    return arguments
