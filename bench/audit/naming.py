"""Maps images that are not named by frame key to frames: by a method's program or a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from ..contracts import ByteArray, Clip, FrameKey
from ..engine.captures import found_captures
from ..engine.config import RunConfig
from ..engine.store import Cell
from ..errors import InputError
from ..io.documents import read_text
from ..io.files import reading, with_slashes
from ..io.images import read_pixels, read_png
from ..registry import discover, get, resolve, unknown
from ..specs import DatasetSpec

MAP = "a list of names, MAP.csv"
COLUMNS = ("file", "sequence", "timestep", "camera")
MAP_COLUMNS = ("file", *FrameKey._fields)
MAP_REMEDY = "Name the images one by one with --names MAP.csv (columns file, sequence, timestep, camera)."


class Render(NamedTuple):
    """An image of a frame, on black if it has ``alpha``, otherwise on the background.

    Coverage is the fourth channel of ``alpha`` if this is the image itself, otherwise its red channel.
    """

    image: Path
    alpha: Path | None = None
    truth: Path | None = None  # ground truth of this frame as written by the repository


Renders = dict[FrameKey, Render]
Listing = Mapping[str, Sequence[tuple[int, str]]]


def named_renders(names: str, folder: Path, config: RunConfig, clips: Sequence[Clip]) -> Renders:
    """Image of each frame by ``names``: a method whose program numbers its renders, or the path of a CSV file.

    The images of a subject are in a folder named after it or, with a single subject, in ``folder``. See `MethodSpec.renders`.

    Raises
    ------
    InputError
        The name is unknown, the list does not fit the captures, the number of images differs from
        that of the frames, or the ground truth stored with the images differs from that of their
        frames.
    """
    if names.endswith(".csv"):
        return _listed(Path(names), folder, clips)
    specs = [plugin.spec for plugin in discover("methods").values() if plugin.spec is not None]
    numbered = {method.name: method.renders for method in specs if method.renders}
    if names not in numbered:
        raise unknown("command line", "--names", names, numbered, f"Or {MAP}.")
    renders = resolve(numbered[names])
    spec: DatasetSpec = get("datasets", config.reader)
    found: Renders = {}
    for clip, (path, _) in zip(clips, found_captures(spec, Path(config.data), config.reader_settings)):
        own = folder / clip.subject if (folder / clip.subject).is_dir() else folder
        if own == folder and len(clips) > 1:
            raise InputError(folder, clip.subject, "a folder with its images for each subject", "none")
        listing: Listing = resolve(spec.listing)(path) if spec.listing else {}
        found |= renders(own, clip, listing)
    return found


def image_name(task: str, key: FrameKey) -> PurePosixPath:
    """Default path of the image of a frame in a folder of images, for any number of subjects."""
    return PurePosixPath(key.subject, task, Cell(Path()).render(task, key).name)


def check_truth(clip: Clip, renders: Renders, keys: Iterable[FrameKey], count: int = 8) -> None:
    """Compare the ground truth stored with renders with the clip's in some frames, on black if the renders are on black.

    Raises `InputError` if they differ by more than `TRUTH_RMS`, as for renders of other frames or on another
    background.
    """
    chosen = [key for key in sorted(keys) if key in renders and renders[key].truth is not None]
    for key in chosen[:: max(1, len(chosen) // count)]:
        path = renders[key].truth
        assert path is not None
        if not path.is_file():
            continue
        truth, own = read_png(path), clip.image(key).astype(np.float32)
        if renders[key].alpha is not None:
            mask = clip.mask(key)
            if mask is None:
                continue  # the background of the image is unknown
            ground = 255 * np.asarray(clip.background, np.float32)
            own -= (1 - mask[..., None].astype(np.float32) / 255) * ground
        if truth.shape != own.shape:
            found = f"one of {truth.shape[1]} x {truth.shape[0]}"
            expected = f"the ground truth of {key}, {own.shape[1]} x {own.shape[0]} pixels"
            raise InputError(path, "size", expected, found, "Train and render at the capture's size.")
        error = float(np.sqrt(np.mean((truth.astype(np.float32) - own) ** 2)))
        if error > TRUTH_RMS:
            expected = f"the ground truth of {key}"
            found = f"an image that differs by {error:.1f} of 255 (root mean square)"
            remedy = (
                "These are renders of another capture, another background or another order. " + MAP_REMEDY
            )
            raise InputError(path, "", expected, found, remedy)


TRUTH_RMS = 1.5
"""In 8-bit levels; above rounding errors."""


def composited(render: Render, background: Sequence[float]) -> ByteArray:
    """Composite the (H, W, 3) pixels of a render on black over ``background``, by its coverage."""
    assert render.alpha is not None
    image = read_png(render.image).astype(np.float32)
    if render.alpha == render.image:
        pixels = read_pixels(render.image)
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise InputError(render.image, "", "colours and coverage (RGBA)", "no coverage")
        coverage = pixels[..., 3:].astype(np.float32) / 255
    else:
        coverage = read_png(render.alpha)[..., :1].astype(np.float32) / 255
    ground = 255 * np.asarray(background, np.float32)
    return np.rint(image + (1 - coverage) * ground).clip(0, 255).astype(np.uint8)


def every_frame(clip: Clip) -> set[FrameKey]:
    """Frames of all splits, and excluded ones."""
    return {key for keys in clip.splits.values() for key in keys} | set(clip.excluded)


def _listed(path: Path, folder: Path, clips: Sequence[Clip]) -> Renders:
    """Images listed in a CSV file, relative to ``folder``; with several captures it needs a column ``subject``."""
    text = read_text(path, "CSV")
    needed = {*COLUMNS, *(["subject"] if len(clips) > 1 else [])}
    with reading(path, "a CSV file"):
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        header = next(reader, [])
        rows = [(reader.line_num, row) for row in reader if row]
    allowed = needed | {"subject"}
    if len(set(header)) != len(header) or not needed <= set(header) <= allowed:
        raise InputError(path, "line 1", f"the columns {', '.join(sorted(needed))}", ", ".join(header))
    by_subject = {clip.subject: clip for clip in clips}
    known = {key for clip in clips for key in every_frame(clip)}
    found: Renders = {}
    for line, row in rows:
        where = f"line {line}"
        if len(row) != len(header):
            raise InputError(path, where, f"{len(header)} entries", f"{len(row)}")
        entry = dict(zip(header, row))
        place = PurePosixPath(with_slashes(entry["file"]))
        if not entry["file"] or place.is_absolute() or ".." in place.parts:
            expected = f"a path inside {folder}"
            raise InputError(path, f"{where}, file", expected, repr(entry["file"]))
        if not (entry["timestep"].isascii() and entry["timestep"].isdigit() and len(entry["timestep"]) < 10):
            raise InputError(path, f"{where}, timestep", "a whole number", repr(entry["timestep"]))
        subject = entry.get("subject", "") or next(iter(by_subject))
        key = FrameKey(subject, entry["sequence"], int(entry["timestep"]), entry["camera"])
        if key not in known:
            expected = "a frame of the capture"
            example = f"Its frames are named like {min(known)} (subject/sequence/timestep/camera)."
            raise InputError(path, where, expected, str(key), example)
        if key in found:
            raise InputError(path, where, "each frame once", f"{key} again")
        found[key] = Render(folder / place)
    return found
