"""The images of a page in separate files, each loaded when one of its images is viewed.

A page opened from a file cannot read the pixels of image files, but it can run scripts, so the files are
scripts that pass their images to the page. They are named by their content, so that a page never loads
those of another.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...bench.errors import InputError
from ...bench.io.files import check_inside, entries, write_text

INDEX, FOLDER = "index.html", "pictures"
FILE_BYTES = 2 * 10**6
"""Target size of a file, small enough to load quickly from a slow disk or network."""
ENTRY_BYTES = 100
"""Maximum overhead of a file: its name on the page and the call in it."""


@dataclass(frozen=True)
class PictureFile:
    """A file of consecutive images: path in the page's folder, text, number of images."""

    name: str
    text: str
    count: int


def split(images: Sequence[str]) -> list[PictureFile]:
    """Distribute base64 images over files of at most `FILE_BYTES`, or with a single image."""
    groups: list[list[str]] = []
    used = 0
    for image in images:
        if not groups or used + len(image) > FILE_BYTES:
            groups.append([])
            used = 0
        groups[-1].append(image)
        used += len(image)
    return [_file(index, group) for index, group in enumerate(groups)]


def _file(index: int, images: list[str]) -> PictureFile:
    text = f"addPictures({index}, {json.dumps(images, separators=(',', ':'))});\n"
    return PictureFile(f"{FOLDER}/{hashlib.sha256(text.encode()).hexdigest()[:20]}.js", text, len(images))


def check_folder(folder: Path) -> None:
    """Raise `InputError` for a folder that holds anything but an earlier report."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--out", "a folder", "a file")
    names = [path.name for path in entries(folder)]
    others = sorted({*names} - {INDEX, FOLDER})
    if others:
        expected = "a new folder, or one with an earlier report alone"
        raise InputError(folder, "--out", expected, f"{others[0]} in it")


def write_pictures(folder: Path, files: Sequence[PictureFile]) -> None:
    """Write the missing files; those of an earlier page are kept until `remove_others`."""
    check_inside(folder / FOLDER)
    for file in files:
        write_text(folder / file.name, file.text)


def remove_others(folder: Path, files: Sequence[PictureFile]) -> None:
    """Remove the images of earlier pages."""
    names = {file.name for file in files}
    for path in (folder / FOLDER).glob("*.js"):
        if f"{FOLDER}/{path.name}" not in names:
            path.unlink()
