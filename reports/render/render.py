"""Renders stored avatars: frames of a capture's splits, orbits, videos of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, HeadPose, Progress, no_progress
from ...bench.engine.adaptation import AdaptedClip, MethodNeeds, adapt
from ...bench.engine.captures import open_clips, reader_of
from ...bench.engine.config import AvatarFolder, RunConfig
from ...bench.engine.store import Cell
from ...bench.engine.stored import open_avatar
from ...bench.errors import InputError
from ...bench.experiments.viewpoints import head_center, turntable
from ...bench.io.images import browser_encoder, quantise, read_png, write_browser_video, write_png
from ...bench.io.provenance import COMPOSITE, RENDER
from ...bench.options import DependentOptions
from ...bench.progress import counted
from ...bench.specs import CommandResult, command


@dataclass(frozen=True)
class RenderSettings:
    """Render a stored avatar: frames of a task, or an orbit; as images, and as video."""

    avatar: AvatarFolder

    capture: str
    """Capture with the cameras and poses; of another subject, too, if its head model is that of the avatar."""
    out: str
    """Folder to write: FRAMES/SEQUENCE_TIMESTEP_CAMERA.png, as `headbench evaluate` reads them, or orbit/00000.png."""
    frames: Literal["self_reenactment", "novel_view", "train", "orbit"] = "self_reenactment"
    """Which frames of the capture, by split; or an orbit between and beyond its training cameras."""
    cameras: tuple[str, ...] = ()
    """Only these cameras; for an orbit, those that it passes."""
    timesteps: tuple[int, ...] = ()
    """Only these timesteps; for an orbit, its sequence of poses (default: the first of training)."""
    views: int = 60
    """Number of views of the orbit, with --frames orbit."""
    beyond: float = 30.0
    """With --frames orbit: angle beyond the outermost cameras, degrees."""
    video: bool = False
    """Also write videos, one for each sequence and camera. Needs PyAV (extra `video`)."""
    beside: bool = False
    """With --video of captured frames: show the captured image next to each."""
    fps: float = 25.0
    """With --video: frames per second."""
    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""
    reader: str = ""
    """Reader of the capture; default: the one that finds it."""
    head: str | None = None
    """Head model for captures without one: FLAME pickle or npz."""
    device: str = "cpu"
    """Rendering device."""

    dependent = (
        DependentOptions(("views", "beyond"), "frames", ("orbit",)),
        DependentOptions(("fps", "beside"), "video"),
        DependentOptions(("beside",), "frames", ("self_reenactment", "novel_view", "train")),
    )

    def __post_init__(self) -> None:
        if self.views < 1 or not 0.0 <= self.beyond < 180.0:
            raise ValueError("views is at least 1, beyond from 0 to less than 180 degrees")
        if not 0.0 < self.fps <= 1000.0:
            raise ValueError(f"fps is {self.fps}; above 0, at most 1000")


ORBIT = "orbit"


class Shot(NamedTuple):
    """A frame to render: its file, key, resizing and captured image, if any."""

    path: Path
    video: Path
    camera: Camera
    pose: HeadPose
    finish: Callable[[FloatArray], FloatArray]
    captured: Callable[[], ByteArray] | None = None


@command("render", group="inspect", writes="out")
def render_avatar(settings: RenderSettings, progress: Progress = no_progress) -> CommandResult:
    """Render a stored avatar: frames of a task, or an orbit; as images and video."""
    if settings.video:
        browser_encoder()
    stored = open_avatar(Path(settings.avatar), settings.method)
    clip = _clip(settings)
    out = Path(settings.out)
    form = adapt(clip, MethodNeeds.of(stored.method.spec), stored.heads, out / "adapted" / clip.subject)
    avatar = stored.load(settings.device)
    orbit = settings.frames == ORBIT
    shots = [*(_orbit(settings, form, out) if orbit else _frames(settings, clip, form, out))]
    background = clip.background.tolist()
    for index, shot in enumerate(shots):
        rgb = avatar.render(shot.camera, shot.pose, background).rgb
        write_png(shot.path, quantise(shot.finish(rgb)), RENDER)
        progress(index + 1, len(shots), shot.path.name)
    videos = _videos(shots, settings) if settings.video else []
    first = f"{out}: {counted(len(shots), 'frame')} in {shots[0].path.parent.name}/"
    data = {"out": out, "frames": [shot.path for shot in shots], "videos": videos}
    return CommandResult("\n".join([first, *map(str, videos)]), data)


def _clip(settings: RenderSettings) -> Clip:
    config = RunConfig(
        data=settings.capture,
        out=settings.out,
        reader=settings.reader or reader_of(settings.capture),
        reader_settings={} if settings.head is None else {"head": settings.head},
        device=settings.device,
    )
    clips = open_clips(config)
    if len(clips) > 1:
        names = ", ".join(clip.subject for clip in clips)
        raise InputError(settings.capture, "", "one capture", names, "Name one capture.")
    return clips[0]


def _frames(settings: RenderSettings, clip: Clip, form: AdaptedClip, out: Path) -> Iterator[Shot]:
    keys = sorted(clip.splits[settings.frames])
    _known("--cameras", settings.cameras, {key.camera for key in keys}, settings.frames)
    _known("--timesteps", settings.timesteps, {key.timestep for key in keys}, settings.frames)
    keys = [
        key
        for key in keys
        if (not settings.cameras or key.camera in settings.cameras)
        and (not settings.timesteps or key.timestep in settings.timesteps)
    ]
    if not keys:
        raise InputError(settings.capture, settings.frames, "at least one frame", "none")
    for key in keys:
        seen = form.key(key)
        camera, pose = form.clip.cameras[seen.camera], form.clip.poses[seen.timestep]
        name = Cell(out).render(settings.frames, key).name
        video = out / f"{settings.frames}_{key.sequence}_{key.camera}.webm"
        finish, captured = partial(form.restore, key), partial(clip.image, key)
        yield Shot(out / settings.frames / name, video, camera, pose, finish, captured)


def _orbit(settings: RenderSettings, form: AdaptedClip, out: Path) -> Iterator[Shot]:
    clip = form.clip
    trained = sorted({key.camera for key in clip.splits["train"]})
    _known("--cameras", settings.cameras, set(clip.cameras), "the capture")
    _known("--timesteps", settings.timesteps, set(clip.poses), "the capture")
    first = min(key.timestep for key in clip.splits["train"])
    poses = [clip.poses[timestep] for timestep in settings.timesteps or (first,)]
    cameras = [clip.cameras[name] for name in settings.cameras or trained]
    views = turntable(cameras, head_center(clip), settings.views, settings.beyond)
    for number, view in enumerate(views):
        path, pose = out / ORBIT / f"{number:05d}.png", poses[number % len(poses)]
        yield Shot(path, out / f"{ORBIT}.webm", view.camera, pose, lambda rgb: rgb)


def _known(option: str, asked: Sequence[int | str], known: Iterable[int | str], of: str) -> None:
    unknown = sorted(set(asked) - set(known))
    if unknown:
        names = sorted(known)
        offered = ", ".join(map(str, names if len(names) < 20 else [names[0], "...", names[-1]]))
        raise InputError("command line", option, f"those of {of}: {offered}", ", ".join(map(str, unknown)))


def _videos(shots: Sequence[Shot], settings: RenderSettings) -> list[Path]:
    """Write the frames of each video in the order of their names, which is chronological."""
    parts: dict[Path, list[Shot]] = {}
    for shot in shots:
        parts.setdefault(shot.video, []).append(shot)
    for video, members in parts.items():
        images = (read_png(shot.path) for shot in members)
        if settings.beside:  # the captured image on the left
            images = (np.hstack([s.captured(), i]) if s.captured else i for s, i in zip(members, images))
        write_browser_video(video, images, settings.fps, COMPOSITE if settings.beside else RENDER)
    return list(parts)
