"""Folders of one call of the authors' program: its input, and checks that it gets no held-out frames."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, Frame, FrameKey, HeadPose
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, check_output_folder, write_json
from ...bench.io.images import probe_image, read_png
from ...datasets.images import write_image
from .checkout import Checkout

Patch = tuple[str, str, str]
"""A source file of theirs, a text in it, and its replacement when the file is run."""


@dataclass(frozen=True)
class Workplace:
    """Folders of one call of the authors' program.

    - ``input``: the capture in the repository's own format.
    - ``program``: the program's working directory, with the files that it expects.
    """

    root: Path

    checkout: Checkout
    """The authors' code, which is not modified."""

    @classmethod
    def at(cls, root: Path, checkout: Checkout) -> Workplace:
        """The folder as an absolute path, since the program has another working directory."""
        return cls(root.absolute(), checkout)

    @property
    def input(self) -> Path:
        return self.root / "input"

    @property
    def program(self) -> Path:
        return self.root / "program"

    @property
    def model(self) -> Path:
        return self.root / "model"

    def make(self) -> None:
        """Make the folders."""
        for folder in (self.input, self.program, self.model):
            folder.mkdir(parents=True, exist_ok=True)


@dataclass(frozen=True)
class Listed:
    """A frame of a list: its number in the program's order, its key, camera and pose."""

    number: int
    key: FrameKey
    camera: Camera
    pose: HeadPose


def check_export(work: Workplace, images: Mapping[str, FrameKey], clip: Clip) -> None:
    """Verify that the program gets only training frames.

    Every image in the program's folders must be exported for a training key, each equally often, or be a placeholder of a
    single pixel, which shows no frame. `clip` gives no pixels of other frames
    (`headbench.bench.engine.guard.TrainingView`), so that none can have such a name.
    """
    allowed = frozenset(clip.splits["train"])
    for path, key in images.items():
        if key not in allowed:
            raise InputError(work.root / path, str(key), "a training frame", "a held-out one")
    if len(set(Counter(images.values()).values())) > 1:
        expected, found = "as many images of each training frame", "different numbers"
        raise InputError(work.root, "images", expected, found)
    files = (path for folder in (work.input, work.program) for path in folder.rglob("*"))
    there = {path.relative_to(work.root).as_posix() for path in files if path.suffix.lower() in _IMAGES}
    there -= {path for path in there - images.keys() if _is_placeholder(work.root / path)}
    for what, names in (
        ("an exported image", images.keys() - there),
        ("exported images alone", there - images.keys()),
    ):
        if names:
            raise InputError(
                work.root / min(names), "", what, "none" if what.startswith("an ") else "another image"
            )


def write_placeholder(path: Path) -> None:
    """Write a placeholder for an image that a loader requires: one pixel, black and transparent."""
    write_image(path, np.zeros((1, 1, 4), np.uint8))


def _is_placeholder(path: Path) -> bool:
    info = probe_image(path)
    return (info.width, info.height) == (1, 1)


_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".exr", ".mp4", ".avi", ".mkv")
LOCK = "program.lock"


@contextmanager
def alone(folder: Path) -> Iterator[IO[str]]:
    """Make a folder and hold its lock; a program that inherits the lock keeps it if this process is killed."""
    check_output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a+") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            started = stream.read(200).strip()
            remedy = "Wait until it ends, or terminate it."
            found = f"one of an earlier call ({started})"
            raise InputError(folder, "", "no running program", found, remedy) from None
        stream.truncate(0)
        stream.write(f"started by process {os.getpid()}")
        stream.flush()
        yield stream


def remove(folder: Path, but: str = "") -> None:
    """Remove a folder, or everything in it except one name."""
    if not but:
        shutil.rmtree(folder, ignore_errors=True)
        return
    for path in folder.iterdir():
        if path.name != but:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def copy_file(source: Path, target: Path) -> None:
    """Copy a file atomically. Raises `InputError` if it is missing."""
    if not source.is_file() or not source.stat().st_size:
        raise InputError(source, "", "a file that the program writes", "none")
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)


def write_launcher(launcher: Path, plan: Mapping[str, Any], work: Workplace) -> list[str]:
    """Copy a launcher and write its plan (JSON) beside it; return both paths, as words of a command."""
    copy, file = work.root / launcher.name, work.root / f"{launcher.stem}.json"
    shutil.copyfile(launcher, copy)
    write_json(file, plan)
    return [str(copy), str(file)]


# ------------------------------------------------------------------ renders


def read_sized(path: Path, frame: Listed, width: int, height: int) -> ByteArray:
    """A render (H, W, 3). Raises `InputError` for a file of another size."""
    image = read_png(path)
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(path, str(frame.key), f"{width}x{height} pixels", found)
    return image


def is_white(
    background: Sequence[float] | FloatArray, where: str, other: Sequence[float], known: str
) -> bool:
    """Whether a background is white. Raises `InputError` unless it is white or ``other``; ``known`` names both."""
    levels = tuple(float(value) for value in background)
    if levels not in ((1.0, 1.0, 1.0), other):
        raise InputError(where, "background", f"{known}, which the code supports", str(levels))
    return levels[0] == 1.0


def opaque(rgb: np.ndarray) -> Frame:
    """A frame of an 8-bit image (H, W, 3) with unknown coverage."""
    return opaque_colours(rgb.astype(np.float32) / 255)


def opaque_colours(rgb: FloatArray) -> Frame:
    """A frame of colours (H, W, 3) in [0, 1] with unknown coverage."""
    return Frame(rgb, np.ones(rgb.shape[:2], np.float32))
