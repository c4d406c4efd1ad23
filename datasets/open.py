"""Opens captures of any layout; the reader is found in the registry by name or by the folder's content."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from ..bench.contracts import Progress, no_progress
from ..bench.errors import InputError
from ..bench.registry import finds, get, readers, resolve
from ..bench.specs import DatasetSpec
from .clip import CaptureClip, as_capture
from .foreign import describe


def find_reader(path: str | PathLike[str], name: str = "") -> DatasetSpec:
    """The reader ``name``, see `registry.get`; without a name, the one that finds captures under ``path``."""
    if name:
        spec: DatasetSpec = get("datasets", name)
        return spec
    root = Path(path)
    known = readers()
    expected = f"a capture that a reader knows ({', '.join(known)})"
    if not root.exists():
        raise InputError(root, "", expected, "no such file or folder")
    fitting = [spec for spec in known.values() if finds(spec, root)]
    if not fitting:
        raise InputError(root, "", expected, *describe(root))
    if len(fitting) > 1:
        names = ", ".join(spec.name for spec in fitting)
        found = f"one for {names}"
        raise InputError(root, "", "a capture that one reader knows", found, "Choose with --reader.")
    return fitting[0]


def open_clips(
    path: str | PathLike[str],
    reader: str = "",
    *,
    wishes: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress = no_progress,
) -> Iterator[CaptureClip]:
    """Read every capture under a folder, one after the other.

    Parameters
    ----------
    reader : str
        See `find_reader`.
    wishes : Mapping[str, Any] | None
        Settings such as ``leaks`` that are passed to readers that have them and ignored otherwise.
    settings : Mapping[str, Any] | None
        Settings of the reader.
    """
    from ..bench.engine.captures import found_captures  # slow to import

    spec = find_reader(path, reader)
    known = inspect.signature(resolve(spec.implementation)).parameters
    given = {key: value for key, value in (wishes or {}).items() if key in known}
    given |= settings or {}
    for _, read in found_captures(spec, Path(path), given):
        yield as_capture(read(progress))


def open_clip(path: str | PathLike[str], reader: str = "", **options: Any) -> CaptureClip:
    """Read the one capture at ``path``; parameters and errors as of `open_clips`."""
    spec = find_reader(path, reader)
    found = resolve(spec.find)(Path(path)) if spec.find else [Path(path)]
    if len(found) > 1:
        names = ", ".join(Path(one).name for one in found)
        raise InputError(path, "", "one capture", names, "Name one capture.")
    return next(open_clips(path, reader, **options))
