"""Read pickles from outside without running anything they ask for, in memory and time bounded by their size.

A pickle is a program that may call whatever it can import. Here every name in it is looked up in a closed table of
stand-ins, which only keep what they are given; the caller makes data of them afterwards, within its own bounds.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

MAX_OPERATIONS = 500_000
"""Genuine files have a few thousand; a single byte can ask for an object of two hundred."""


class Refused(Exception):
    """The stream named a global that is not in the table."""


class Malformed(Exception):
    """The stream used a stand-in in a way no genuine pickle does, or asks for too much."""


class Function:
    """A callable the stream may use, which it cannot alter: the state of a function is never restored."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise Malformed("an attempt to alter a function")


class _Bounded:
    """The rest of a stream; a length that the stream declares never asks for more memory than is left of it."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._size = stream, size

    def read(self, size: int) -> bytes:
        return self._stream.read(min(size, self._size - self._stream.tell()))

    def readline(self) -> bytes:
        return self._stream.readline()

    def readinto(self, buffer: Any) -> int:
        raise Malformed("a buffer")


class _Operations:
    """What each operation of a stream does; counts them."""

    def __init__(self, table: Mapping[int, Callable[..., None]]) -> None:
        self._by_code, self._left = table, MAX_OPERATIONS

    def __getitem__(self, code: int) -> Callable[..., None]:
        self._left -= 1
        if self._left < 0:
            raise Malformed(f"more than {MAX_OPERATIONS} operations")
        return self._by_code[code]


# The unpickler written in Python: the one in C allocates whatever memo size the stream names, so that nine
# bytes can ask for gigabytes. Arrays are single operations, hence nothing is lost in speed.
_PythonUnpickler: Any = vars(pickle)["_Unpickler"]


class ClosedUnpickler(_PythonUnpickler):
    """Resolves names in a closed table and nowhere else; sets become lists.

    Parameters
    ----------
    stream : read from where it stands, to the end of one pickle.
    size : of the whole stream, bytes.
    table : stand-ins by module and name.
    external : makes a stand-in of what the pickle only names (its persistent ids).
    """

    def __init__(
        self,
        stream: BinaryIO,
        size: int,
        table: Mapping[tuple[str, str], Any],
        external: Callable[[Any], Any] | None = None,
    ) -> None:
        super().__init__(_Bounded(stream, size), encoding="latin1")
        self._table_of_names, self._external = table, external
        self.dispatch = _Operations(_OPERATIONS)

    def find_class(self, module: str, name: str) -> Any:
        try:
            return self._table_of_names[module, name]
        except KeyError:
            raise Refused(f"{module}.{name}"[:200]) from None

    def persistent_load(self, pid: Any) -> Any:
        if self._external is None:
            raise Malformed("something that is kept elsewhere")
        return self._external(pid)


def _load_bytes(unpickler: Any) -> None:
    (size,) = struct.unpack("<Q", unpickler.read(8))
    unpickler.append(unpickler.read(size))


def _load_list(unpickler: Any) -> None:
    unpickler.append([])


def _load_items(unpickler: Any) -> None:
    items = unpickler.pop_mark()
    unpickler.stack[-1].extend(items)


def _load_whole_list(unpickler: Any) -> None:
    unpickler.append(unpickler.pop_mark())


def _with_plain_keys(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """Entries of dictionaries with text and numbers as keys: the hash of nested tuples, or of a long number again
    and again, can take for ever."""

    def checked(unpickler: Any) -> None:
        # One entry lies on the stack itself; several lie behind the last mark.
        keys = unpickler.stack[-2:-1] if load is _SET_ITEM else unpickler.stack[::2]
        if not all(map(_is_plain_key, keys)):
            raise Malformed("a key that is neither text nor a number")
        load(unpickler)

    return checked


def _is_plain_key(key: Any) -> bool:
    return key is None or isinstance(key, (str, bytes, float)) or (isinstance(key, int) and abs(key) < 2**63)


def _refuse(unpickler: Any) -> None:
    raise Malformed("an extension, which only a registry of its writer knows")


_OPERATIONS: dict[int, Callable[[Any], None]] = dict(_PythonUnpickler.dispatch)
_SET_ITEM = _OPERATIONS[pickle.SETITEM[0]]
for _code in (pickle.SETITEM, pickle.SETITEMS, pickle.DICT):
    _OPERATIONS[_code[0]] = _with_plain_keys(_OPERATIONS[_code[0]])
for _code in (pickle.EXT1, pickle.EXT2, pickle.EXT4):
    _OPERATIONS[_code[0]] = _refuse
_OPERATIONS[pickle.BYTEARRAY8[0]] = _load_bytes
_OPERATIONS[pickle.EMPTY_SET[0]] = _load_list
_OPERATIONS[pickle.ADDITEMS[0]] = _load_items
_OPERATIONS[pickle.FROZENSET[0]] = _load_whole_list
