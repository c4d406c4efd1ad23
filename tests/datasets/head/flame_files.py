"""FLAME-layout pickles for tests: as Python 3 writes them, and as the genuine files were written.

The genuine files were written by Python 2: byte strings are text, modules have their old names, and arrays
may hide in chumpy objects. `legacy_pickle` writes such a stream from today's objects.
"""

import pickle
import struct
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.head.loaders import OPEN, OPEN_KEY


class _Ch:
    """What a plain chumpy array is to pickle: an instance with an array x and some bookkeeping."""

    def __init__(self, values: np.ndarray) -> None:
        self.x = values
        self._dirty_vars = {"x"}
        self._itr = None


@contextmanager
def chumpy_stand_in() -> Iterator[type]:
    """A module that pickles under the name chumpy.ch for as long as the block lasts."""
    package, module = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    kind = type("Ch", (_Ch,), {"__module__": "chumpy.ch", "__qualname__": "Ch"})
    module.Ch = kind  # type: ignore[attr-defined]
    package.ch = module  # type: ignore[attr-defined]
    saved = {name: sys.modules.get(name) for name in ("chumpy", "chumpy.ch")}
    sys.modules.update({"chumpy": package, "chumpy.ch": module})
    try:
        yield kind
    finally:
        for name, previous in saved.items():
            if previous is None:
                del sys.modules[name]
            else:
                sys.modules[name] = previous


_PythonPickler: Any = vars(pickle)["_Pickler"]
"""The pickler in Python, whose opcodes can be chosen; the one in C has no such seam."""


class _LegacyPickler(_PythonPickler):
    """Protocol 2 with Python-2 byte strings and the module names of numpy 1 and scipy before 1.8."""

    dispatch: ClassVar[dict[type, Any]] = dict(_PythonPickler.dispatch)

    def save_text(self, value: str | bytes) -> None:
        raw = value.encode("latin1") if isinstance(value, str) else value
        self.write(pickle.BINSTRING + struct.pack("<i", len(raw)) + raw)
        self.memoize(value)

    dispatch[str] = save_text
    dispatch[bytes] = save_text

    def save_global(self, obj: Any, name: str | None = None) -> None:
        module, name = obj.__module__, name or obj.__qualname__
        module = module.replace("numpy._core", "numpy.core").replace("scipy.sparse._", "scipy.sparse.")
        module = {"builtins": "__builtin__", "copyreg": "copy_reg"}.get(module, module)
        self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())
        self.memoize(obj)

    dispatch[type] = save_global
    dispatch[types.FunctionType] = save_global
    dispatch[types.BuiltinFunctionType] = save_global


def legacy_pickle(value: Any) -> bytes:
    """The value as Python 2 would have pickled it."""
    stream = BytesIO()
    _LegacyPickler(stream, protocol=2).dump(value)
    return stream.getvalue()


def flame_content(head: HeadArrays) -> dict[str, Any]:
    """Keys, shapes and types of FLAME's pickle for a toy head; joint regressor sparse, root's parent 2^32 - 1."""
    parents = head.parents.astype(np.uint32)
    return {
        "v_template": head.template,
        "f": head.faces.astype(np.uint32),
        "shapedirs": np.concatenate([head.shape_basis, head.expression_basis], axis=2),
        "posedirs": head.pose_basis,
        "J_regressor": scipy.sparse.csc_matrix(head.joint_regressor),
        "kintree_table": np.stack([parents, np.arange(len(parents), dtype=np.uint32)]),
        "weights": head.skinning_weights,
        "J": np.zeros((len(parents), 3)),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def write_flame(path: Path, head: HeadArrays, *, legacy: bool = True) -> Path:
    """Write a FLAME pickle; the legacy one holds chumpy objects, the other plain arrays."""
    content = flame_content(head)
    if head.version == OPEN:  # arrays of Python 3, and one key more
        names = {
            "expr_source": "SUPR_head",
            "supr_gender": "male",
            "expr_components": "last_100",
            "n_expr": 100,
        }
        content |= {"J_regressor": head.joint_regressor, OPEN_KEY: names}
        legacy = False
    if not legacy:
        path.write_bytes(pickle.dumps(content, protocol=4))
        return path
    with chumpy_stand_in() as ch:
        for name in ("v_template", "shapedirs", "posedirs", "weights"):
            content[name] = ch(content[name])
        path.write_bytes(legacy_pickle(content))
    return path
