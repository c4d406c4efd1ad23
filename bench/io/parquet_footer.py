"""How the columns of a Parquet file are compressed, read from its footer.

pyarrow names the codec of a column, too, but ends the process where a damaged file gives one that it does not know.
The footer is a struct in Thrift's compact protocol, laid out in ``parquet.thrift`` of the format's definition.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

UNCOMPRESSED, SNAPPY = 0, 1
"""Numbers of codecs in ``parquet.thrift``."""

_ROW_GROUPS, _COLUMNS, _COLUMN_DATA, _CODEC = 4, 1, 3, 4  # ids of the fields that lead to a codec


def column_codecs(path: Path) -> set[int]:
    """Numbers of the codecs that the columns of a file name.

    Raises `ValueError` for a footer that is not laid out as the format says. Give it what pyarrow took the metadata of.
    """
    content = path.read_bytes()
    length = int.from_bytes(content[-8:-4], "little")
    try:
        footer, _ = _struct(content[-8 - length : -8], 0)
        groups = [group[_COLUMNS] for group in footer[_ROW_GROUPS]]
        return {int(column[_COLUMN_DATA][_CODEC]) for columns in groups for column in columns}
    except (IndexError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"a footer that does not parse ({error!r})") from error


def _struct(data: bytes, at: int) -> tuple[dict[int, Any], int]:
    """Fields by id, and where the struct ends."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        number += head >> 4
        if not head >> 4:
            number, at = _integer(data, at)
        kind = head & 15
        fields[number], at = (kind == 1, at) if kind in (1, 2) else _value(data, at, kind)
    return fields, at + 1


def _value(data: bytes, at: int, kind: int) -> tuple[Any, int]:
    """A value of one of Thrift's types, and where it ends; all have at least one byte."""
    if kind in (1, 2, 3):
        return data[at], at + 1
    if kind in (4, 5, 6):
        return _integer(data, at)
    if kind == 7:
        return None, at + 8  # a double
    if kind == 8:
        size, at = _unsigned(data, at)
        return data[at : at + size], at + size
    if kind in (9, 10):
        size, inner = data[at] >> 4, data[at] & 15
        at += 1
        if size == 15:
            size, at = _unsigned(data, at)
        values = []
        for _ in range(size):
            value, at = _value(data, at, inner)
            values.append(value)
        return values, at
    if kind == 12:
        return _struct(data, at)
    raise KeyError(f"type {kind}")


def _unsigned(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, at


def _integer(data: bytes, at: int) -> tuple[int, int]:
    value, at = _unsigned(data, at)
    return (value >> 1) ^ -(value & 1), at
