"""Folder of intermediate results, from which an interrupted ``headbench track`` resumes."""

from __future__ import annotations

from pathlib import Path

from ...bench.errors import InputError
from ...bench.io.files import TEMPORARY, check_output_folder, write_text

WORK = ".track"
"""Its name in the folder of ``--out``."""
TRACKER_VERSION = "2"
"""Part of the key of intermediate results; raise it when code of the tracker or the reader of videos changes them."""
_NOTE = "README.txt"
_TEXT = """headbench track continues from these files after an interruption and deletes them at the end.
Those of a video show the person. This folder can be deleted: the next call begins again then.
"""


def check_work_folder(folder: Path) -> None:
    """Raise `InputError` if the path has something not created by `make_work_folder`, since it will be deleted."""
    if folder.is_symlink():
        found = "a link"
    elif folder.is_dir():
        unfinished = all(path.name.startswith(TEMPORARY) for path in folder.iterdir())  # by a kill at once
        found = "" if (folder / _NOTE).is_file() or unfinished else "files of something else"
    else:
        found = "a file" if folder.exists() else ""
    if found:
        expected = "a folder that headbench track made, or none"
        raise InputError(folder, "", expected, found, "Move it away, or choose another --out.")


def make_work_folder(folder: Path) -> None:
    """Make the folder, with a note that says what it is. Raises `InputError` as `check_work_folder`, and if it cannot be made."""
    check_work_folder(folder)
    check_output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / _NOTE).is_file():
        write_text(folder / _NOTE, _TEXT)
