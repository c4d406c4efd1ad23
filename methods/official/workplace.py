"""Folders of one call of the authors' program, checks that it gets no held-out frames, and numbering of its renders.

Formats read:

- Renders of GaussianAvatars. Written by ShenhanQian/GaussianAvatars 30cc4bde (`render.py`). Not checked on a file of the
  program.
- Renders of GaussianBlendshapes. Written by zjumsj/GaussianBlendshapes a0ab7c01 (`test.py`). Not checked on a file of the
  program.
- Renders of INSTA. Written by Zielon/INSTA 0c06b701 (`src/rta/recorder.cu`). Not checked on a file of the program.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ...bench.audit.frames import MAP_REMEDY, Listing, Render, Renders, every_frame
from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, Frame, FrameKey, HeadPose
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, check_output_folder, write_json
from ...bench.io.images import probe_image, read_png
from ...datasets.images import write_image
from .checkout import Checkout


def _numbered(folder: Path, prefix: str, count: Sequence[int], of: str) -> list[Path]:
    """Images ``<prefix>00000.png`` and following in a folder; their number must be one of ``count``."""
    pattern = re.compile(re.escape(prefix) + r"(\d{5,})\.png")
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := pattern.fullmatch(path.name)))
    if len(numbers) not in count or numbers != [*range(len(numbers))]:
        wanted = " or ".join(map(str, sorted(set(count))))
        last = f", {prefix}{numbers[0]:05d}.png to {prefix}{numbers[-1]:05d}.png" if numbers else ""
        expected = f"{wanted} images, {prefix}00000.png and on, one for each frame of {of}"
        remedy = f"Render the whole split again with all cameras. {MAP_REMEDY}"
        raise InputError(folder, "", expected, f"{len(numbers)}{last}", remedy)
    return [folder / f"{prefix}{number:05d}.png" for number in numbers]


def _latest(folder: Path, stem: str) -> Path | None:
    """The folder ``<stem>_<iterations>`` with the most iterations, the default of the repositories."""
    folders = {
        int(match[1]): path
        for path in (folder.iterdir() if folder.is_dir() else ())
        if (match := re.fullmatch(rf"{stem}_(\d{{1,9}})", path.name)) and path.is_dir()
    }
    return folders[max(folders)] if folders else None


def gaussian_avatars(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``{train,val,test}/ours_<iterations>/renders/<index>.png``, in the order of ``transforms_<split>.json``."""
    if not listing:
        expected = "a capture in the GaussianAvatars/VHAP layout, whose files give the order"
        raise InputError("command line", "--names", expected, f"another for {clip.subject}", MAP_REMEDY)
    keys = {(key.timestep, key.camera): key for key in every_frame(clip)}
    renders: Renders = {}
    for split, frames in listing.items():
        output = _latest(folder / split, "ours")
        if output is None or not (output / "renders").is_dir():
            continue
        images = _numbered(output / "renders", "", [len(frames)], f"transforms_{split}.json")
        for frame, image in zip(frames, images):
            if frame in keys:
                renders[keys[frame]] = Render(image, truth=output / "gt" / image.name)
    if not renders:
        expected = "test/ours_N/renders or val/ours_N/renders, as render.py leaves them in the model's folder"
        raise InputError(folder, "", expected, "neither")
    return renders


GBS_TEST_FRAMES = 350


def gaussian_blendshapes(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``test/split_<iterations>/pred_<index>.png``: the last 350 frames; ``seq/...``: all of them. On black."""
    frames = _of_one_camera(clip, every_frame(clip))
    renders: Renders = {}
    for name, numbered in (("seq", frames), ("test", frames[-GBS_TEST_FRAMES:])):
        output = _latest(folder / name, "split")
        if output is None:
            continue
        of = "the capture" if name == "seq" else f"its last {GBS_TEST_FRAMES}"
        images = _numbered(output, "pred_", [len(numbered)], of)
        for key, image in zip(numbered, images):
            mask, truth = (output / image.name.replace("pred_", other) for other in ("pred_mask_", "gt_"))
            renders[key] = Render(image, mask, truth)
    if not renders:
        raise InputError(folder, "", "test/split_N, as test.py leaves it in the model's folder", "none")
    return renders


def insta(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``overlay/<index>.png`` in its output folder: the test split, in the order of mesh names, on black."""
    held_out = {key.sequence for key in clip.splits["self_reenactment"]}
    frames = _of_one_camera(clip, [key for key in every_frame(clip) if key.sequence in held_out])
    output = folder / "overlay"
    if not output.is_dir():
        expected = "overlay, as the program leaves it in experiments/CONFIG/debug of the video's folder"
        raise InputError(folder, "", expected, "none")
    images = _numbered(output, "", [len(frames)], "transforms_test.json")
    return {key: Render(image, image) for key, image in zip(frames, images)}


def _of_one_camera(clip: Clip, keys: Iterable[FrameKey]) -> list[FrameKey]:
    """Frames in order."""
    frames = sorted(keys, key=lambda key: (key.timestep, key.camera))
    repeated = [t for t, n in Counter(key.timestep for key in frames).items() if n > 1]
    if repeated:
        expected = "a capture of one camera, whose timesteps give the order"
        found = f"several frames at timestep {repeated[0]}"
        raise InputError(f"clip {clip.subject}", "cameras", expected, found, MAP_REMEDY)
    return frames


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
    (`headbench.bench.engine.scoring.TrainingView`), so that none can have such a name.
    """
    allowed = frozenset(clip.splits["train"])
    for path, key in images.items():
        if key not in allowed:
            raise InputError(work.root / path, str(key), "a training frame", "a held-out one")
    if len(set(Counter(images.values()).values())) > 1:
        expected, found = "as many images of each training frame", "different numbers"
        raise InputError(work.root, "images", expected, found)
    files = (path for folder in (work.input, work.program) for path in folder.rglob("*"))
    images_there = {
        path.relative_to(work.root).as_posix() for path in files if path.suffix.lower() in _IMAGES
    }
    images_there -= {path for path in images_there - images.keys() if _is_placeholder(work.root / path)}
    for what, names in (
        ("an exported image", images.keys() - images_there),
        ("exported images alone", images_there - images.keys()),
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
    """Copy a file atomically."""
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
    """A render (H, W, 3)."""
    image = read_png(path)
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(path, str(frame.key), f"{width}x{height} pixels", found)
    return image


def is_white(
    background: Sequence[float] | FloatArray, where: str, other: Sequence[float], known: str
) -> bool:
    """Whether a background is white."""
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
