"""Binary glTF files (Khronos, glTF 2.0, sections 3.6 and 4.4) of numpy arrays."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...bench.contracts import FloatArray
from ...bench.io.files import read_bytes, write_bytes
from ...bench.io.provenance import RENDER, note, tool

COMPONENTS = {"<f4": 5126, "|u1": 5121, "<u2": 5123}
KINDS = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (16,): "MAT4"}
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class GlbWriter:
    """Collects the arrays of a file."""

    def __init__(self) -> None:
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, int]] = []
        self._blocks: list[bytes] = []
        self._size = 0

    def add(
        self,
        values: NDArray[Any],
        target: int | None = ARRAY_BUFFER,
        *,
        bounds: bool = False,
        omit_zeros: bool = False,
    ) -> int:
        """Add (N,), (N, 3), (N, 4) or (N, 16) values; return the number of the accessor.

        ``target``: What the array is used for, see glTF's bufferView.target. ``bounds``: Whether to state its range.
        ``omit_zeros``: Whether an array of zeros takes no bytes.
        """
        values = np.ascontiguousarray(values)
        accessor: dict[str, Any] = {}
        if np.any(values) or not omit_zeros:
            accessor["bufferView"] = len(self._views)
            view = {"buffer": 0, "byteOffset": self._size, "byteLength": values.nbytes}
            self._views.append(view if target is None else view | {"target": target})
            self._blocks.append(values.tobytes() + b"\0" * (-values.nbytes % 4))
            self._size += len(self._blocks[-1])
        kind = KINDS[values.shape[1:]]
        accessor |= {"componentType": COMPONENTS[values.dtype.str], "count": len(values), "type": kind}
        if bounds:
            low, high = (np.atleast_1d(limit).tolist() for limit in (values.min(axis=0), values.max(axis=0)))
            accessor |= {"min": low, "max": high}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def write(self, path: Path, content: Mapping[str, Any]) -> None:
        """Write the file; ``content`` are the properties of its scene."""
        header = {
            "asset": {"version": "2.0", "generator": tool(), "extras": {"note": note(RENDER)}},
            **content,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        whole = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + self._size)
        whole += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", self._size, b"BIN\0")
        write_bytes(path, whole + b"".join(self._blocks))


class Glb(NamedTuple):
    """Content of a file that `GlbWriter` wrote."""

    header: dict[str, Any]
    body: bytes

    @classmethod
    def read(cls, path: Path) -> Glb:
        """Read a file."""
        content = read_bytes(path, "a GLB file")
        (length,) = struct.unpack_from("<I", content, 12)
        return cls(json.loads(content[20 : 20 + length]), content[28 + length :])

    def array(self, number: int) -> FloatArray:
        """(N, ...) values of an accessor."""
        accessor = self.header["accessors"][number]
        columns = next(shape for shape, kind in KINDS.items() if kind == accessor["type"])
        shape = accessor["count"], *columns
        kind = next(kind for kind, code in COMPONENTS.items() if code == accessor["componentType"])
        if "bufferView" not in accessor:
            return np.zeros(shape, kind)
        place = self.header["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(self.body, kind, int(np.prod(shape)), place).reshape(shape)
