"""Lists the frames of protocols as CSV, for renders that are made outside of headbench."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import tyro

from ..contracts import ByteArray, Clip, FrameKey, Progress, TaskName, no_progress
from ..engine.captures import capture_configuration, found_captures, open_clips, open_run_clips
from ..engine.config import RunConfig, RunOptions
from ..engine.store import Cell, RunFolder
from ..errors import InputError
from ..io.documents import read_text
from ..io.files import check_output_folder, reading, with_slashes, write_text
from ..io.images import read_pixels, read_png, write_png
from ..protocol import make_protocols
from ..registry import discover, get, resolve, unknown
from ..specs import CommandResult, DatasetSpec, command

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
        inside = folder / clip.subject if (folder / clip.subject).is_dir() else folder
        if inside == folder and len(clips) > 1:
            raise InputError(folder, clip.subject, "a folder with its images for each subject", "none")
        listing: Listing = resolve(spec.listing)(path) if spec.listing else {}
        found |= renders(inside, clip, listing)
    return found


def image_name(task: str, key: FrameKey) -> PurePosixPath:
    """Default path of the image of a frame in a folder of images, for any number of subjects."""
    return PurePosixPath(key.subject, task, Cell(Path()).render(task, key).name)


def check_truth(clip: Clip, renders: Renders, keys: Iterable[FrameKey], count: int = 8) -> None:
    """Compare the ground truth stored with renders with the clip's in some frames, on black if the renders are on black."""
    chosen = [key for key in sorted(keys) if key in renders and renders[key].truth is not None]
    for key in chosen[:: max(1, len(chosen) // count)]:
        path = renders[key].truth
        assert path is not None
        if not path.is_file():
            continue
        truth, image = read_png(path), clip.image(key).astype(np.float32)
        if renders[key].alpha is not None:
            mask = clip.mask(key)
            if mask is None:
                continue  # the background of the image is unknown
            ground = 255 * np.asarray(clip.background, np.float32)
            image -= (1 - mask[..., None].astype(np.float32) / 255) * ground
        if truth.shape != image.shape:
            found = f"one of {truth.shape[1]} x {truth.shape[0]}"
            expected = f"the ground truth of {key}, {image.shape[1]} x {image.shape[0]} pixels"
            raise InputError(path, "size", expected, found, "Train and render at the capture's size.")
        error = float(np.sqrt(np.mean((truth.astype(np.float32) - image) ** 2)))
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
    keys = {key for clip in clips for key in every_frame(clip)}
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
        if key not in keys:
            expected = "a frame of the capture"
            example = f"Its frames are named like {min(keys)} (subject/sequence/timestep/camera)."
            raise InputError(path, where, expected, str(key), example)
        if key in found:
            raise InputError(path, where, "each frame once", f"{key} again")
        found[key] = Render(folder / place)
    return found


@dataclass(frozen=True)
class FramesSettings(RunOptions):
    """List the frames that `headbench evaluate` scores, for renders that are made outside of headbench.

    Writes OUT/frames.csv, one row for each frame: task, key (subject, sequence, timestep, camera), the file name that
    `headbench evaluate` expects in a folder of images, size, background, intrinsics in pixels (the centre of the top left pixel
    is at 0.5, 0.5), the first three rows of the 4 x 4 world-to-camera matrix (OpenCV axes, metres), and the file with the
    tracking parameters of the timestep, where the capture has one. OUT/MAP.csv has the same frames in the format of `headbench
    evaluate --names`: replace the names in its column file by those of your renders.
    """

    source: tyro.conf.Positional[str]
    """Folder of a run, whose protocols are followed, or a capture (or folder of several)."""

    out: str
    """Folder to write."""

    tasks: tuple[TaskName, ...] = ()
    """Tasks to list for a capture; default: those of `headbench run`."""

    frames_per_task: int | None = None
    """For a capture: maximum number of frames per subject and task, evenly spaced, as in `headbench run`."""

    reader: str = ""
    """Which dataset reader opens the capture; default: the one that finds it."""

    images: bool = False
    """Also write the true images as PNG under their file names, for `headbench evaluate --truth`."""


FRAMES_FILE, MAP_FILE = "frames.csv", "MAP.csv"
POSE_COLUMNS = (
    *("task", "subject", "sequence", "timestep", "camera", "file", "width", "height", "background"),
    *("fx", "fy", "cx", "cy"),
    *(f"world_to_camera_{row}{column}" for row in range(3) for column in range(4)),
    "pose_file",
)


@command("frames", group="compare", writes="out")
def write_frames(settings: FramesSettings, progress: Progress = no_progress) -> CommandResult:
    """List the frames that `evaluate` scores: file names, cameras, pose files."""
    config, clips = _open(settings)
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    by_subject = {clip.subject: clip for clip in clips}
    pose_files = _pose_files(config, clips)
    frames: list[Sequence[object]] = [POSE_COLUMNS]
    named: list[tuple[str, FrameKey]] = []
    for task, protocol in protocols.items():
        for key in protocol.keys:
            name = image_name(task, key).as_posix()
            pose_file = pose_files.get((key.subject, key.timestep), "")
            frames.append((task, *key, name, *_camera(by_subject[key.subject], key), pose_file))
            named.append((name, key))
    out = Path(settings.out)
    listing = csv_text([MAP_COLUMNS, *((name, *key) for name, key in named)])
    check_output_folder(out)
    if (out / MAP_FILE).exists() and (out / MAP_FILE).read_text(encoding="utf-8") != listing:
        expected = "no such file, or the template of the same frames"
        raise InputError(out / MAP_FILE, "", expected, "another list", "Move it, or choose another --out.")
    write_text(out / FRAMES_FILE, csv_text(frames))
    write_text(out / MAP_FILE, listing)
    for done, (name, key) in enumerate(named if settings.images else (), 1):
        write_png(out / name, by_subject[key.subject].image(key))
        progress(done, len(named), "images")
    counts = {task: len(protocol.keys) for task, protocol in protocols.items()}
    hashes = {task: protocol.hash for task, protocol in protocols.items()}
    shown = ", ".join(f"{count} of {task} (protocol {hashes[task]})" for task, count in counts.items())
    text = f"{out}: {FRAMES_FILE} and {MAP_FILE} with {sum(counts.values())} frames: {shown}."
    return CommandResult(text, {"out": out, "frames": counts, "protocols": hashes})


def _open(settings: FramesSettings) -> tuple[RunConfig, list[Clip]]:
    source = Path(settings.source)
    if RunFolder(source).manifest.is_file():
        for name in ("tasks", "frames_per_task", "reader"):
            if getattr(settings, name):
                expected = f"none: {source} is a run, whose protocols decide it"
                raise InputError(
                    "command line", f"--{name.replace('_', '-')}", expected, str(getattr(settings, name))
                )
        return open_run_clips(source, settings, out=Path(settings.out), used=())
    for name in ("data", "trust"):
        if getattr(settings, name):
            raise InputError("command line", f"--{name}", f"a run, with run.json, at {source}", "none")
    options = {"tasks": settings.tasks} if settings.tasks else {}
    config = capture_configuration(
        settings.source,
        settings.out,
        settings.reader,
        settings.head,
        frames_per_task=settings.frames_per_task,
        **options,
    )
    return config, open_clips(config)


def _camera(clip: Clip, key: FrameKey) -> Iterable[object]:
    """Size, background and camera of a frame, in the order of `POSE_COLUMNS`, with exact numbers."""
    camera = clip.cameras[key.camera]
    colour = "#{:02x}{:02x}{:02x}".format(*(round(255 * float(value)) for value in clip.background))
    K = camera.K
    numbers = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.world_to_camera[:3].ravel())
    return camera.width, camera.height, colour, *(float(number) for number in numbers)


def _pose_files(config: RunConfig, clips: Sequence[Clip]) -> dict[tuple[str, int], Path]:
    """File with the tracking parameters of each subject and timestep, if the reader provides one."""
    spec: DatasetSpec = get("datasets", config.reader)
    if not spec.pose_files:
        return {}
    captures = found_captures(spec, Path(config.data), config.reader_settings)
    return {
        (clip.subject, timestep): Path(file).absolute()
        for clip, (path, _) in zip(clips, captures)
        for timestep, file in resolve(spec.pose_files)(path).items()
    }


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Write lines as CSV."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()
