"""Disk usage of a run, and deletion of files that can be recreated."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

from ..errors import InputError
from ..io.files import output_inside, refuse_links
from ..io.lock import LOCK_FILE, is_locked, locked
from .store import Cell, RunFolder

Kind = Literal["avatars", "renders", "checkpoints", "damaged", "logs", "other"]
Deletable = Literal["renders", "checkpoints", "damaged", "logs"]


def usage(run: Path) -> dict[Kind, int]:
    """Bytes of the files of a run by kind, in the order of `Kind`."""
    sizes: dict[Kind, int] = dict.fromkeys(
        ("avatars", "renders", "checkpoints", "damaged", "logs", "other"), 0
    )
    for path, kind in _files(run):
        sizes[kind] += path.lstat().st_size
    return sizes


def clean(run: Path, kinds: Sequence[Deletable]) -> int:
    """Delete the files of some kinds from a run, and empty folders; return the number of bytes freed.

    Raises `InputError` for a folder that is not a run or is in use by another process, and for links that point
    outside of it.
    """
    RunFolder(run).read_manifest()
    freed = 0
    with locked(run), output_inside(run):
        refuse_links(run)
        for lock in sorted(run.rglob(LOCK_FILE)):
            if lock.parent != run and is_locked(lock.parent):
                expected = "a folder that no other process works in"
                raise InputError(lock, "", expected, "a lock", "Wait for it to end.")
        for path, kind in list(_files(run)):
            if kind in kinds:
                freed += path.lstat().st_size
                path.unlink()
        if "damaged" in kinds:
            for folder in list(run.glob("*/*/seed-*/avatar-damaged-*")):
                shutil.rmtree(folder)
        for folder in sorted((p for p in run.rglob("*") if p.is_dir() and not p.is_symlink()), reverse=True):
            if (
                "renders" in kinds
                and "renders" in folder.relative_to(run).parts
                and not any(folder.iterdir())
            ):
                folder.rmdir()
    return freed


def _files(run: Path) -> Iterator[tuple[Path, Kind]]:
    """Files of a run and their kinds; those of runs inside it, such as a sweep, are of the kind "other"."""
    inner = {path.parent for path in run.rglob("run.json")} - {run}
    for path in sorted(run.rglob("*")):
        if path.is_file() and not path.is_symlink():
            yield path, "other" if inner & {*path.parents} else _kind(run, path.relative_to(run))


def _kind(run: Path, place: Path) -> Kind:
    # SUBJECT/METHOD/seed-N/..., see `store`.
    if len(place.parts) > 3 and place.parts[2].startswith("seed-"):
        inside = place.parts[3:]
        if place.suffix == ".log":
            return "logs"
        if inside[0] == "renders":
            return "renders"
        if inside[0].startswith("avatar-damaged-"):
            return "damaged"
        trained = Cell(run.joinpath(*place.parts[:3])).ended("fit")
        if place.name.startswith("checkpoint") and not trained:
            return "checkpoints"
        return "avatars" if inside[0] == "avatar" else "other"
    return "logs" if place.suffix == ".log" or place.parts[0] == "jobs" else "other"


def shown(size: float) -> str:
    """Format a number of bytes."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"
