"""Converts mappings and ``--set a.b=c`` into frozen dataclasses of settings. Unknown keys and wrong types are refused."""

from __future__ import annotations

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from .errors import InputError
from .io.documents import parse_setting, read_yaml, shown
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

    Raises
    ------
    InputError
        A key is unknown or missing, or a value has the wrong type.
    """
    if not isinstance(values, Mapping):
        raise InputError(source, prefix.rstrip("."), "a group of settings", shown(values))
    hints = get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key not in fields:
            raise unknown(source, f"{prefix}{key}", str(key), fields)
        arguments[key] = _convert(hints[key], value, source, f"{prefix}{key}")
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in arguments:
            raise InputError(source, f"{prefix}{name}", "a value", "nothing")
    try:
        return cls(**arguments)
    except ValueError as error:
        raise InputError(source, prefix.rstrip(".") or cls.__name__, "valid settings", str(error)) from error


def build_folder(cls: type[T], folder: Path) -> dict[str, T]:
    """Build ``cls`` from every YAML file of a folder, by file name. Raises `InputError` as `build` does."""
    return {path.stem: build_file(cls, path) for path in sorted(folder.glob("*.yaml"))}


def build_named(cls: type[T], folder: Path, name: str, option: str) -> T:
    """Build ``cls`` from the YAML file of a name. Raises `InputError` for an unknown one, naming the option, and as `build` does."""
    names = [path.stem for path in folder.glob("*.yaml")]
    if name not in names:
        raise unknown("command line", option, name, names)
    return build_file(cls, folder / f"{name}.yaml")


def build_file(cls: type[T], path: Path) -> T:
    """Build ``cls`` from a YAML file. Raises `InputError` as `build` does."""
    return build(cls, read_yaml(path), str(path))


def setting_paths(cls: Any, prefix: str = "") -> list[str]:
    """Dotted path of every setting of a dataclass, groups before their members."""
    hints, found = get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        found.append(f"{prefix}{field.name}")
        if dataclasses.is_dataclass(hints[field.name]):
            found += setting_paths(hints[field.name], f"{prefix}{field.name}.")
    return found


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
    known = {p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)} - {*harness}
    anything = any(p.kind == p.VAR_KEYWORD for p in parameters)
    hints = get_type_hints(function)
    arguments = {}
    for key, value in values.items():
        if key not in known and not (anything and key not in harness):
            raise unknown(source, key, str(key), known)
        arguments[key] = _convert(hints.get(key, Any) if key in known else Any, value, source, key)
    return arguments


def _convert(hint: Any, value: Any, source: str, key: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is typing.Literal:
        if value not in arguments:
            raise unknown(source, key, str(value), [str(a) for a in arguments])
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        refusals = []
        for candidate in (a for a in arguments if a is not type(None)):
            try:
                return _convert(candidate, value, source, key)
            except InputError as error:
                refusals.append(error)
        if len(refusals) == 1:
            raise refusals[0]
        raise InputError(source, key, " or ".join(error.expected for error in refusals), shown(value))
    if origin is Sequence:
        origin, arguments = tuple, (*arguments, Ellipsis)
    if origin is tuple:
        if isinstance(value, str):
            parts = [part.strip() for part in value.split(",") if part.strip()]
            value = [
                parse_setting(part, source, key) if part[0] in "+-.0123456789" else part for part in parts
            ]
        if not isinstance(value, (list, tuple)):
            raise InputError(source, key, "a list", shown(value))
        repeated = len(arguments) == 2 and arguments[1] is Ellipsis
        if not repeated and len(arguments) != len(value):
            raise InputError(source, key, f"{len(arguments)} values", f"{len(value)}")
        kinds = [arguments[0]] * len(value) if repeated else arguments
        return tuple(_convert(k, v, source, f"{key}[{i}]") for i, (k, v) in enumerate(zip(kinds, value)))
    if origin in (dict, Mapping) or hint is dict:
        if not isinstance(value, Mapping):
            raise InputError(source, key, "a group of settings", shown(value))
        if arguments and dataclasses.is_dataclass(arguments[1]):
            return {
                name: _convert(arguments[1], each, source, f"{key}.{name}") for name, each in value.items()
            }
        return dict(value)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if isinstance(value, hint):
            return value
        return build(hint, value, source, f"{key}.")
    return _convert_scalar(hint, value, source, key)


def _convert_scalar(hint: Any, value: Any, source: str, key: str) -> Any:
    if hint is Any:
        return value
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and not isinstance(value, bool):
        if isinstance(value, int):
            return value
        if isinstance(value, float) and value.is_integer():
            return int(value)
    if hint is float and not isinstance(value, bool) and isinstance(value, (int, float)):
        if math.isfinite(value):
            return float(value)
        raise InputError(source, key, "a finite number", str(value))
    if hint in (str, Path) and isinstance(value, (str, Path)):
        return hint(value)
    if hint is str and isinstance(value, (int, float)) and not isinstance(value, bool):
        return str(value)
    names = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
    raise InputError(source, key, names.get(hint, getattr(hint, "__name__", str(hint))), shown(value))
