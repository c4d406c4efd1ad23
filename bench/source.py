"""Finds the source files of plug-ins and computes their digest.

Results are reused as long as the code is the same. For a method of this package, this is determined by its version. A plug-in
outside of the package may be edited without a new version, so the digest of its files is compared as well.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from .io.files import digest, digest_file
from .registry import resolve

_OWN = __name__.partition(".")[0]
_LEFT_OUT = {_OWN, *sys.stdlib_module_names}
_INSTALLED = {"site-packages", "dist-packages"}
_SUFFIXES = (".py", *(suffix for suffix in EXTENSION_SUFFIXES if suffix.count(".") > 1))
"""Suffixes of modules, without ".so", which may be any large library."""


def is_outside(reference: str) -> bool:
    """Whether ``"package.module:Object"`` names an object outside this package."""
    return bool(reference) and reference.partition(":")[0].partition(".")[0] != _OWN


@cache
def code_digest(reference: str) -> str:
    """First 12 hex digits of the digest of the code of ``"package.module:Object"``; "" if it is not stored in files.

    Inside this package, the code is the Python files in the folder of the named module.

    Outside, it is all modules of the package that contains the named module (the outermost folder with an ``__init__.py``,
    else the outermost folder), or the file of a module without a package. Modules that these files import from the same
    folder on the module path are included, unless it is a folder of installed packages. Modules that are imported
    by a computed name are not found.

    Relative file names are part of the digest, but not their location. The result is cached, see `forget_code`.
    """
    module = reference.partition(":")[0]
    resolve(reference)  # imports the module
    if is_outside(reference):
        files = _with_imports(module)
    else:
        file = _file(module)
        files = {} if file is None else {path.name: path for path in file.parent.glob("*.py")}
    named = [[name, digest_file(path)] for name, path in sorted(files.items()) if path.is_file()]
    return digest(named)[:12] if named else ""


def forget_code() -> None:
    """Clear the cache of `code_digest`, since files may have changed."""
    code_digest.cache_clear()


def _file(module: str) -> Path | None:
    """The file of an imported module; None for a namespace package, and for a module that is not in a file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file else None


def _root(module: str) -> tuple[Path, Path] | None:
    """Folder of the package that contains a module, or its file, and the folder on the module path that holds it."""
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        file = _file(name)
        if file is not None and hasattr(sys.modules[name], "__path__"):
            return file.parent, file.parents[depth]
        if file is not None:
            above = [file, *file.parents]
            return above[depth - 1], above[depth]
    return None


def _with_imports(module: str) -> dict[str, Path]:
    """Files of the package that contains a module, and of neighbouring modules that they import, by relative name."""
    found, own = _root(module), _file(module)
    if found is None:
        return {}
    root, home = found
    installed = not _INSTALLED.isdisjoint(home.parts)
    files: dict[str, Path] = {}
    seen = {root, own or root}  # its file may be a compiled one with any name
    left = list(seen)
    while left:
        new = _below(left.pop(), home)
        files |= new
        for path in new.values():
            names = set() if installed else _imports(_source(path)) - _LEFT_OUT
            beside = {p for name in names for p in (home / f"{name}.py", home / name) if p.exists()}
            left += beside - seen
            seen |= beside
    return files


def _below(root: Path, home: Path) -> dict[str, Path]:
    """Files of all modules below a folder, or the file itself, by name relative to ``home``."""
    return {os.path.relpath(path, home): path for path in _walk(root)}


def _walk(root: Path) -> Iterator[Path]:
    if not root.is_dir():
        yield root
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if name.isidentifier()]  # others cannot be imported
        yield from (Path(folder, name) for name in names if name.endswith(_SUFFIXES))


def _source(path: Path) -> bytes:
    """Source of a module; empty for a compiled one and one that cannot be read."""
    with suppress(OSError):
        return path.read_bytes() if path.suffix == ".py" else b""
    return b""


@lru_cache(maxsize=256)
def _imports(source: bytes) -> frozenset[str]:
    """First parts of the absolute names that a module imports; none if it cannot be parsed."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return frozenset()
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            names.add(node.module.partition(".")[0])
    return frozenset(names)
