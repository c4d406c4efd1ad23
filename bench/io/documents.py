"""Reads untrusted text, JSON and YAML: limited in size and nesting, without duplicate keys, checked against dataclasses.

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
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from ..errors import InputError
from ..registry import unknown
from .files import read_bytes, reading

if TYPE_CHECKING:
    from pydantic_core import SchemaValidator

T = TypeVar("T")
Source = str | PathLike[str]

MAX_JSON_BYTES = 64 * 2**20
"""The JSON of the largest known capture, with 50,000 frames, has 35 MB. Objects take up to 25 times their
text."""
MAX_RECORD_BYTES = 8 * 2**20
"""Maximum size of a run's records, which may be untrusted; the record of the largest known run has 78 KB."""
MAX_YAML_BYTES = 4 * 2**20
"""YAML files are written by users, or list excluded frames; the parser is slower than JSON's."""
MAX_DEPTH = 64

_TAG = "tag:yaml.org,2002:"
_DECIMAL = re.compile(r"-?(0|[1-9][0-9]*)")
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_json(path: Path, limit: int | None = None) -> dict[str, Any]:
    """Read a JSON file whose top level is an object.

    Raises `InputError` for a file that is missing, cannot be read, is larger than ``limit`` bytes (default: `MAX_JSON_BYTES`),
    is invalid, nests deeper than `MAX_DEPTH`, has duplicate keys or non-finite numbers, or is not an object.
    """
    return parse_json(read_text(path, "JSON", MAX_JSON_BYTES if limit is None else limit), path)


def parse_json(text: str | bytes, source: Source, key: str = "") -> dict[str, Any]:
    """Parse JSON from ``key`` of some file; errors as for `read_json`."""
    try:
        value = json.loads(text, object_pairs_hook=_object, parse_constant=float)
        if isinstance(value, (dict, list)):
            _check_tree(value)
    except _Refused as error:
        raise InputError(source, _joined(key, error.key), error.expected, error.found) from None
    except RecursionError as error:
        raise InputError(source, key, f"JSON of at most {MAX_DEPTH} levels", "deeper nesting") from error
    except ValueError as error:
        raise InputError(source, key, "valid JSON", f"content that does not parse ({error})") from error
    if not isinstance(value, dict):
        raise InputError(source, key, "a JSON object", f"a {type(value).__name__}")
    return value


def read_yaml(path: Path) -> dict[Any, Any]:
    """Read a YAML mapping; an empty file is an empty mapping. It is read as data, never as code.

    Supported types are text, numbers, true and false, null, lists and mappings. Raises `InputError` as
    `read_json` does, and for anchors that are used, tags, dates, and whole numbers that YAML 1.1 reads in an
    unexpected way (057 is 47, 1:30 is 90).
    """
    value = _parse_yaml(read_text(path, "YAML", MAX_YAML_BYTES), path, "", literal=False)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(path, "", "a mapping", type(value).__name__)
    return value


def parse_setting(text: str, source: Source, key: str) -> Any:
    """Read the YAML value of a setting on the command line; dates and numbers like 057 are text there."""
    return _parse_yaml(text, source, key, literal=True)


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

    Raises
    ------
    InputError
        An entry is missing, unknown, or of the wrong type or range.
    """
    from pydantic import ValidationError

    try:
        # JSON has no tuples and only text keys, so only this mode accepts lists as tuples without accepting text
        # as numbers.
        text = json.dumps(value, allow_nan=False)
        extra = "ignore" if foreign else "forbid"
        return _validator(kind).validate_json(text, strict=True, extra=extra)  # type: ignore[arg-type]
    except ValidationError as error:
        _refuse(error.errors(include_url=False)[0], kind, source, prefix)
    except (TypeError, ValueError) as error:
        raise InputError(source, prefix, "plain values", str(error)) from error


def shown(value: Any) -> str:
    """A value for an error message, shortened, with its type."""
    return f"{_REPR.repr(value)} ({type(value).__name__})"


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60
_REPR.maxlevel = 2


@functools.cache
def _validator(kind: Any) -> SchemaValidator:
    """A validator that stops at the first bad item of a collection. Errors of all items of 1 MB of JSON take up to 3 GB."""
    from pydantic import TypeAdapter  # takes a third of the start-up time of the command line
    from pydantic_core import SchemaValidator

    return SchemaValidator(_fail_fast(TypeAdapter(kind).core_schema))


def _fail_fast(schema: Any) -> Any:
    if isinstance(schema, list | tuple):
        return type(schema)(map(_fail_fast, schema))
    if not isinstance(schema, dict):
        return schema
    changed = {name: _fail_fast(part) for name, part in schema.items()}
    if schema.get("type") in ("list", "tuple", "set", "frozenset", "dict"):
        changed["fail_fast"] = True
    return changed


class _Refused(ValueError):
    """A document violates a rule of this module."""

    def __init__(self, expected: str, found: str, key: str = ""):
        self.expected, self.found, self.key = expected, found, key
        super().__init__(f"expected {expected}, found {found}")


def read_text(path: Path, what: str, limit: int) -> str:
    """Read a UTF-8 text file, with or without a byte order mark; line ends are not changed.

    ``what`` names the format in errors. Raises `InputError` for a file that is missing, cannot be read, is larger than
    ``limit`` bytes, or has another encoding.
    """
    article = f"a {what} file"
    content = read_bytes(path, article, limit)
    refuse_utf16(content, path, f"{article} in UTF-8")
    with reading(path, f"{article} in UTF-8"):
        return content.decode("utf-8-sig")


def refuse_utf16(content: bytes, source: Source, expected: str) -> None:
    """Raise `InputError` for text that starts as UTF-16 or UTF-32, in which some editors save files."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in content[:4]:
        raise InputError(source, "", expected, "UTF-16 or UTF-32", "Save it as UTF-8.")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise _Refused("each key once", f"{_REPR.repr(twice)} again")
    return result


def _check_tree(value: Any) -> None:
    """Limit the nesting and refuse non-finite numbers."""
    level = [value]
    for _ in range(MAX_DEPTH + 1):
        below: list[Any] = []
        for container in level:
            for item in container.values() if isinstance(container, dict) else container:
                kind = type(item)
                if kind is dict or kind is list:
                    below.append(item)
                elif kind is float and not math.isfinite(item):
                    raise _Refused("a finite number", str(item), _key_of(item, value) or "")
        if not below:
            return
        level = below
    raise _Refused(f"at most {MAX_DEPTH} levels", "deeper nesting")


def _key_of(item: Any, value: Any) -> str | None:
    """Dotted key of an object in a tree; None if it is absent."""
    if value is item:
        return ""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, part in pairs:
        below = _key_of(item, part)
        if below is not None:
            return _joined(f"[{name}]" if isinstance(value, list) else str(name), below)
    return None


def _joined(key: str, below: str) -> str:
    return f"{key}.{below}" if key and below and not below.startswith("[") else key + below


def _parse_yaml(text: str, source: Source, key: str, *, literal: bool) -> Any:
    try:
        depth = 0
        for event in yaml.parse(text, Loader=_LOADER):
            if isinstance(event, yaml.AliasEvent):
                raise InputError(source, key, "values written out", f"the alias *{event.anchor}")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise InputError(source, key, f"YAML of at most {MAX_DEPTH} levels", "deeper nesting")
        node = yaml.compose(text, Loader=_LOADER)
    except yaml.YAMLError as error:
        raise InputError(source, key, "valid YAML", " ".join(str(error).split())) from error
    return None if node is None else _value(node, source, key, literal)


def _value(node: yaml.Node, source: Source, key: str, literal: bool) -> Any:
    """The value of a node at a dotted key."""
    tag = node.tag.removeprefix(_TAG)
    if isinstance(node, yaml.SequenceNode) and tag == "seq":
        return [_value(item, source, f"{key}[{i}]", literal) for i, item in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode) and tag == "map":
        result: dict[Any, Any] = {}
        seen: set[str] = set()
        for name_node, value_node in node.value:
            name = _value(name_node, source, key, literal)
            if not isinstance(name, (str, int)) or isinstance(name, bool):
                raise InputError(source, key, "names, in quotes where YAML takes them otherwise", shown(name))
            if str(name) in seen:  # 5 and "5" are the same key in JSON
                raise InputError(source, key, "each key once", f"{_REPR.repr(name)} again{_line(name_node)}")
            seen.add(str(name))
            result[name] = _value(value_node, source, f"{key}.{name}" if key else str(name), literal)
        return result
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node, tag, source, key, literal)
    raise InputError(source, key, "plain values, without tags", f"{_REPR.repr(node.tag)}{_line(node)}")


def _scalar(node: yaml.ScalarNode, tag: str, source: Source, key: str, literal: bool) -> Any:
    text = str(node.value)
    number = tag in ("int", "float") and (":" in text or (tag == "int" and not _DECIMAL.fullmatch(text)))
    if tag == "str" or (literal and (number or tag in ("timestamp", "merge", "value"))):
        return text
    found = f"{_REPR.repr(text)}{_line(node)}"
    if number:
        raise InputError(source, key, "numbers without leading zeros, other words in quotes", found)
    if tag not in ("null", "bool", "int", "float"):
        what = {"timestamp": "a date: "}.get(tag, f"{_REPR.repr(node.tag)}: ")
        raise InputError(source, key, "text in quotes, or a number", what + found)
    try:
        value = getattr(yaml.constructor.SafeConstructor(), f"construct_yaml_{tag}")(node)
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(source, key, f"a value of the type {tag}", found) from error
    if isinstance(value, float) and not math.isfinite(value) and not literal:
        raise InputError(source, key, "a finite number", found)
    return value


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


def _line(node: yaml.Node) -> str:
    return f" in line {node.start_mark.line + 1}"


def _refuse(error: Any, kind: Any, source: Source, prefix: str) -> NoReturn:
    """Raise the first error of pydantic as an `InputError`."""
    place = [part for part in error["loc"] if part != "[key]"]
    key = prefix.rstrip(".")
    for part in place:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else part
    if error["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        raise unknown(str(source), key, str(place[-1]), _entries(kind, place[:-1]))
    if error["type"] == "missing":
        raise InputError(source, key, "a value", "nothing")
    if error["type"] == "value_error":
        raise InputError(source, key, "valid values", error["msg"].removeprefix("Value error, "))
    raise InputError(source, key, error["msg"].removeprefix("Input should be "), shown(error["input"]))
