"""Lists the frames of protocols as CSV, for renders that are made outside of headbench."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from ..contracts import Clip, FrameKey, Progress, TaskName, no_progress
from ..engine.captures import capture_configuration, found_captures, open_clips, open_run_clips
from ..engine.config import RunConfig, RunOptions
from ..engine.store import RunFolder
from ..errors import InputError
from ..io.files import check_output_folder, write_text
from ..protocol import make_protocols
from ..registry import get, resolve
from ..specs import CommandResult, DatasetSpec, command
from .naming import MAP_COLUMNS, image_name


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


FRAMES_FILE, MAP_FILE = "frames.csv", "MAP.csv"
COLUMNS = (
    *("task", "subject", "sequence", "timestep", "camera", "file", "width", "height", "background"),
    *("fx", "fy", "cx", "cy"),
    *(f"world_to_camera_{row}{column}" for row in range(3) for column in range(4)),
    "pose_file",
)


@command("frames", group="compare", writes="out")
def write_frames(settings: FramesSettings, progress: Progress = no_progress) -> CommandResult:
    """List the frames that `evaluate` scores: file names, cameras, pose files.

    Raises `InputError` if the path is neither a run nor a capture, for options that require a capture, and
    for an edited `MAP_FILE`.
    """
    config, clips = _open(settings)
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    by_subject = {clip.subject: clip for clip in clips}
    pose_files = _pose_files(config, clips)
    frames: list[Sequence[object]] = [COLUMNS]
    names: list[Sequence[object]] = [MAP_COLUMNS]
    for task, protocol in protocols.items():
        for key in protocol.keys:
            name = image_name(task, key).as_posix()
            pose_file = pose_files.get((key.subject, key.timestep), "")
            frames.append((task, *key, name, *_camera(by_subject[key.subject], key), pose_file))
            names.append((name, *key))
    out, listing = Path(settings.out), _csv(names)
    check_output_folder(out)
    if (out / MAP_FILE).exists() and (out / MAP_FILE).read_text(encoding="utf-8") != listing:
        expected = "no such file, or the template of the same frames"
        raise InputError(out / MAP_FILE, "", expected, "another list", "Move it, or choose another --out.")
    write_text(out / FRAMES_FILE, _csv(frames))
    write_text(out / MAP_FILE, listing)
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
    """Size, background and camera of a frame, in the order of `COLUMNS`, with exact numbers."""
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
    found = found_captures(spec, Path(config.data), config.reader_settings)
    return {
        (clip.subject, timestep): Path(file).absolute()
        for clip, (path, _) in zip(clips, found)
        for timestep, file in resolve(spec.pose_files)(path).items()
    }


def _csv(lines: Iterable[Sequence[object]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()
