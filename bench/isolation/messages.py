"""Messages between a run and the process of an isolated method.

A message is a line of JSON, followed by the bytes of the arrays that it declares. Messages from the method's process are
read as data with limited size and never unpickled.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import HeadbenchError

LARGEST_LINE = 1 << 24
LARGEST_ARRAYS = 1 << 31
"""Maximum bytes of a message's line and of its arrays; an image of 8,192 x 8,192 pixels in float32 has 0.8 GB."""
_TYPES = ("uint8", "bool", "float32", "float64", "int32", "int64")

Message = dict[str, Any]
Arrays = Mapping[str, NDArray[Any]]


def send(connection: Connection, message: Mapping[str, Any], arrays: Arrays | None = None) -> None:
    """Send a message with arrays by name."""
    held = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    listed = {name: [array.dtype.name, list(array.shape)] for name, array in held.items()}
    connection.send_bytes(json.dumps([message, listed]).encode())
    for array in held.values():
        if array.nbytes:
            connection.send_bytes(array.reshape(-1).view(np.uint8).data)


def receive(connection: Connection) -> tuple[Message, dict[str, NDArray[Any]]]:
    """The next message and its read-only arrays.

    Raises `HeadbenchError` for anything but a message, and `EOFError` if the other side has ended.
    """
    line = _bytes(connection, LARGEST_LINE)
    try:
        message, listed = json.loads(line)
        announced = {str(name): _announced(*entry) for name, entry in listed.items()}
        if not isinstance(message, dict) or sum(size for *_, size in announced.values()) > LARGEST_ARRAYS:
            raise ValueError("of another form, or too large")
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise HeadbenchError(f"the process of the method sent no valid message: {error}") from error
    arrays = {}
    for name, (kind, shape, size) in announced.items():
        data = _bytes(connection, size) if size else b""
        if len(data) != size:
            raise HeadbenchError(
                f"the process of the method sent {len(data)} bytes of {name} instead of {size}"
            )
        arrays[name] = np.frombuffer(data, kind).reshape(shape)
    return message, arrays


def _bytes(connection: Connection, largest: int) -> bytes:
    try:
        return connection.recv_bytes(largest)
    except ConnectionError:
        raise
    except OSError as error:  # longer than that
        raise HeadbenchError(f"the process of the method sent no valid message: {error}") from error


def _announced(kind: str, shape: Sequence[int]) -> tuple[str, tuple[int, ...], int]:
    if kind not in _TYPES or len(shape) > 4 or not all(type(n) is int and 0 <= n < 1 << 31 for n in shape):
        raise ValueError(f"an array of {kind}, {shape}")
    return kind, tuple(shape), math.prod(shape) * np.dtype(kind).itemsize
