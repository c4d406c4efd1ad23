"""Reads text, JSON and YAML from outside: without duplicate keys, checked against dataclasses.

A document that breaks a rule raises an `InputError` with the file, the dotted key, the expected and the found
value. Non-finite numbers are refused everywhere: JSON has none, and a missing value is written as null.
"""

from __future__ import annotations

import codecs
import functools
import json
import math
import re
import reprlib
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from ..errors import InputError
from ..registry import unknown
from .files import read_bytes, reading

T = TypeVar("T")
Source = str | PathLike[str]

_TAG = "tag:yaml.org,2002:"
_NUMBERS = {
    "int": r"[-+]?(0|[1-9][0-9]*)$",
    "float": r"([-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$",
}
"""Decimal numbers of YAML 1.2. YAML 1.1 takes 074 for 60, 1:30 for 90, and 1e-3 for text."""
_DAMAGE = (yaml.YAMLError, ValueError, KeyError, IndexError, RecursionError)
"""What the parser of YAML raises for a value that does not fit its tag."""


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file whose top level is an object."""
    return parse_json(read_text(path, "JSON"), path)


def parse_json(text: str | bytes, source: Source, key: str = "") -> dict[str, Any]:
    """Parse JSON from ``key`` of some file; errors as for `read_json`."""
    try:
        value = json.loads(text, object_pairs_hook=_object, parse_constant=float)
        _check_finite(value, source, key)
    except (ValueError, RecursionError) as error:
        raise InputError(source, key, "valid JSON", f"content that does not parse ({error})") from error
    if not isinstance(value, dict):
        raise InputError(source, key, "a JSON object", f"a {type(value).__name__}")
    return value


def read_yaml(path: Path) -> dict[Any, Any]:
    """Read a YAML mapping; an empty file is an empty mapping. It is read as data, never as code.

    Supported types are text, numbers, true and false, null, lists and mappings.
    """
    value = parse_setting(read_text(path, "YAML"), path, "")
    with reading(path, "valid YAML"):  # a list may contain itself
        _check_finite(value, path, "")
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(path, "", "a mapping", type(value).__name__)
    return value


def parse_setting(text: str, source: Source, key: str) -> Any:
    """Read a YAML value, such as that of a setting on the command line. Dates and numbers like 057 are text."""
    try:
        return yaml.load(text, _Loader)
    except _DAMAGE as error:
        raise InputError(source, key, "valid YAML", " ".join(str(error).split())) from error


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Text, numbers, true and false, null, lists, and mappings whose keys differ."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for name_node, _ in node.value:
            name, fault = self.construct_object(name_node, deep=True), ""
            if not isinstance(name, (str, int)) or isinstance(name, bool):
                fault = (
                    f"{shown(name)} as a key, which has to be text, in quotes where YAML takes it otherwise,"
                )
            elif str(name) in seen:  # 5 and "5" are the same key in JSON
                fault = f"the key {_REPR.repr(name)} again"
            if fault:
                raise yaml.constructor.ConstructorError(None, None, fault, name_node.start_mark)
            seen.add(str(name))
        return dict(super().construct_mapping(node, deep=deep))


_Loader.yaml_constructors = {
    tag: construct
    for tag, construct in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag[len(_TAG) :] in ("null", "bool", "int", "float", "str", "seq", "map")
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag[len(_TAG) :] in ("null", "bool")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _kind, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(_TAG + _kind, re.compile(_pattern), list("-+.0123456789"))


def checked(value: Any, kind: type[T], source: Source, prefix: str = "", *, foreign: bool = False) -> T:
    """Build a dataclass, including nested ones, from a parsed value.

    Parameters
    ----------
    kind : type[T]
        A dataclass or another annotation. Types are not converted: numbers, text and integers are
        distinct.
    source : Source
        File or option of the value, for the error; ``prefix`` is its dotted key there.
    foreign : bool
        Whether this is another program's format, whose unknown entries are ignored. They are refused
        otherwise.
    """
    from pydantic import ValidationError

    try:
        # JSON has no tuples and only text keys, so only this mode accepts lists as tuples without accepting text
        # as numbers.
        text = json.dumps(value, allow_nan=False)
        extra = "ignore" if foreign else "forbid"
        return _validator(kind).validate_json(text, strict=True, extra=extra)  # type: ignore[arg-type]
    except ValidationError as error:
        _refuse(error.errors(include_url=False), kind, source, prefix)
    except (TypeError, ValueError) as error:
        raise InputError(source, prefix, "plain values", str(error)) from error


def settings_of(value: Any, kind: Any, source: Source, prefix: str = "", *, others: bool = False) -> Any:
    """Build a dataclass or typed dictionary of settings from a value that a person wrote.

    As `checked`, but ``1e4`` is a whole number, a number is text where text is expected, and ``a,b`` is a list. With
    ``others``, unknown entries of a typed dictionary are kept.
    """
    from pydantic import ValidationError

    try:
        return _settings_validator(kind).validate_python([value], extra="allow" if others else "forbid")[0]
    except ValidationError as error:
        errors = [{**each, "loc": each["loc"][1:]} for each in error.errors(include_url=False)]
        _refuse(errors, kind, source, prefix)


def shown(value: Any) -> str:
    """A value for an error message, shortened, with its type."""
    return f"{_REPR.repr(value)} ({type(value).__name__})"


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60
_REPR.maxlevel = 2


@functools.cache
def _validator(kind: Any) -> Any:
    from pydantic import TypeAdapter  # takes a third of the start-up time of the command line

    return TypeAdapter(kind)


_CHOICE = "|"
"""Place of an error in an alternative of a union."""


@functools.cache
def _settings_validator(kind: Any) -> Any:
    """Validator of a list of ``kind``: a dataclass itself takes no configuration, but inherits that of the list."""
    from pydantic import ConfigDict, TypeAdapter
    from pydantic_core import SchemaValidator

    adapter = TypeAdapter(list[kind], config=ConfigDict(arbitrary_types_allowed=True))
    return SchemaValidator(_for_settings(adapter.core_schema))


def _for_settings(schema: Any) -> Any:
    """The schema of a type with the conversions of `settings_of`."""
    if isinstance(schema, list):
        return [_for_settings(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    kept = ("metadata", "serialization", "default", "json_schema")
    schema = {key: each if key in kept else _for_settings(each) for key, each in schema.items()}
    convert: Any = None
    match schema.get("type"):
        case "json-or-python" if schema["json_schema"]["type"] == "list":  # Sequence
            items = _for_settings(schema["json_schema"]["items_schema"])
            return _for_settings({"type": "tuple", "items_schema": [items], "variadic_item_index": 0})
        case "union":
            choices = [(each, _CHOICE) for each in schema["choices"]]
            return {**schema, "choices": choices, "mode": "left_to_right"}
        case "str":
            return {"coerce_numbers_to_str": True, **schema}
        case "dict" if schema["values_schema"]["type"] == "str":  # such as printed numbers
            schema["values_schema"]["coerce_numbers_to_str"] = False
        case "bool":
            return {**schema, "strict": True}
        case "float":
            return {**schema, "strict": True, "allow_inf_nan": False}
        case "int":
            schema, convert = {**schema, "strict": True}, _whole
        case "tuple":
            convert = _listed
    if convert is None:
        return schema
    return {
        "type": "function-before",
        "function": {"type": "no-info", "function": convert},
        "schema": schema,
    }


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _listed(value: Any) -> Any:
    """The parts of ``a,b``; those that begin like a number are parsed."""
    if not isinstance(value, str):
        return value
    parts = [part.strip() for part in value.split(",") if part.strip()]
    return [parse_setting(part, "", "") if part[0] in "+-.0123456789" else part for part in parts]


def read_text(path: Path, what: str) -> str:
    """Read a UTF-8 text file, with or without a byte order mark; line ends are not changed.

    ``what`` names the format in errors.
    """
    article = f"a {what} file"
    content = read_bytes(path, article)
    expected = f"{article} in UTF-8"
    # Some editors save files so.
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in content[:4]:
        raise InputError(path, "", expected, "UTF-16 or UTF-32", "Save it as UTF-8.")
    with reading(path, expected):
        return content.decode("utf-8-sig")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {_REPR.repr(twice)} again")
    return result


def _check_finite(value: Any, source: Source, key: str) -> None:
    """Raise `InputError`, with its dotted key, for a number that is not finite."""
    place = _non_finite(value)
    if place is not None:
        key = f"{key}{place}" if key or place.startswith("[") else place.removeprefix(".")
        raise InputError(source, key, "a finite number", "infinity or NaN")


def _non_finite(value: Any) -> str | None:
    """Place of the first non-finite number in a tree, such as ``.a[1]``; None without one."""
    if isinstance(value, float):
        return None if math.isfinite(value) else ""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, part in pairs:
        if isinstance(part, float | dict | list) and (place := _non_finite(part)) is not None:
            return (f"[{name}]" if isinstance(value, list) else f".{name}") + place
    return None


def _entries(kind: Any, place: Sequence[str | int]) -> list[str]:
    """Field names of the dataclasses and typed dictionaries inside a type."""
    for part in (*place, None):
        if get_origin(kind) in (Union, UnionType):
            kind = next(a for a in get_args(kind) if a is not NoneType)
        if part is None:
            break
        if hasattr(kind, "__annotations__"):
            kind = get_type_hints(kind)[str(part)]
        elif get_args(kind):
            kind = get_args(kind)[0 if isinstance(part, int) else -1]
    return list(getattr(kind, "__annotations__", {}))


_EXPECTED = {
    "missing": "a value",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "text",
    "path_type": "a path",
    "tuple_type": "a list",
    "dict_type": "a group of settings",
    "dataclass_type": "a group of settings",
    "value_error": "valid values",
}
"""Types of pydantic's errors."""


def _refuse(errors: Sequence[Any], kind: Any, source: Source, prefix: str) -> NoReturn:
    """Raise the first error of pydantic, or those of all alternatives of its union, as an `InputError`."""
    error, first = errors[0], errors[0]["loc"]
    if _CHOICE in first:
        before = first[: first.index(_CHOICE)]
        errors = [each for each in errors if each["loc"][: len(before)] == before]
        error = max(errors, key=lambda each: len(each["loc"]))
    else:
        errors = errors[:1]
    place = [entry for entry in error["loc"] if entry not in ("[key]", _CHOICE)]
    key = prefix.rstrip(".")
    for entry in place:
        key += f"[{entry}]" if isinstance(entry, int) else f".{entry}" if key else entry
    if error["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        raise unknown(str(source), key, str(place[-1]), _entries(kind, place[:-1]))
    names = re.findall(r"'([^']*)'", error["ctx"]["expected"]) if error["type"] == "literal_error" else ()
    if names and isinstance(error["input"], str) and len(errors) == 1:
        raise unknown(str(source), key, error["input"], names)
    found = shown(error["input"])
    if error["type"] == "missing":
        found = "nothing"
    elif error["type"] == "value_error":
        found = error["msg"].removeprefix("Value error, ")
    same = [each for each in errors if len(each["loc"]) == len(error["loc"])]
    expected = dict.fromkeys(
        _EXPECTED.get(each["type"], each["msg"].removeprefix("Input should be ")) for each in same
    )
    raise InputError(source, key, " or ".join(expected), found)
