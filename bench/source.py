"""Digest of a method's or metric's source files, so that results of edited code are noticed.

Results of this package are reused by version. A plug-in outside of the package may be edited without a new version, so the
digest of its files is part of the fingerprint of its results.
"""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path

from .registry import is_outside, resolve


@cache
def code_digest(reference: str) -> str:
    """First 12 hex digits of a SHA-256 over the Python files in the folder of ``"package.module:Object"``; "" without files.

    For a module of a package outside this one, all files below the package are included. The result is cached,
    see `forget_code`.
    """
    resolve(reference)  # imports the module
    source = getattr(sys.modules[reference.partition(":")[0]], "__file__", None)
    if source is None:
        return ""
    folder, files = Path(source).parent, Path(source).parent.glob("*.py")
    while is_outside(reference) and (folder / "__init__.py").is_file():
        files, folder = folder.rglob("*.py"), folder.parent
    digest = hashlib.sha256()
    for path in sorted(files):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:12]


def forget_code() -> None:
    """Clear the cache of `code_digest`, since files may have changed."""
    code_digest.cache_clear()
