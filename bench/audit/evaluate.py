"""Scores a folder of images as if a method of a run had rendered them, after a check of their background, or against another."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import tyro

from ..condition import PLAIN
from ..contracts import (
    Avatar,
    BoolArray,
    Budget,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadPose,
    Progress,
    TaskName,
    no_progress,
)
from ..engine.captures import capture_configuration, open_clips, open_run_clips
from ..engine.cell import measure, render
from ..engine.config import ResolvedMethod, RunConfig, RunOptions, default_names, resolve_metrics
from ..engine.plan import Job
from ..engine.run import run
from ..engine.store import Cell
from ..engine.stored import avatar_digest, open_avatar
from ..errors import HeadbenchError, InputError
from ..io.files import (
    atomic_path,
    check_name,
    digest,
    digest_file,
)
from ..io.images import probe_image, read_pixels, read_png, write_png
from ..machine import check_device
from ..options import DependentOptions
from ..protocol import Protocol, check_capture, make_protocols, needed
from ..registry import discover, get, resolve
from ..rows import Rows
from ..specs import CommandResult, MethodSpec, MetricSpec, command
from .folders import Resize, score_pairs
from .frames import Render, check_truth, composited, named_renders


@dataclass(frozen=True)
class EvaluateSettings:
    """Score images against others of the same names, or as renders of a capture's frames; or a stored avatar.

    With --truth, images or videos in FOLDER are compared with those in another folder whose relative names without suffix are
    the same, or one video with another; no capture is needed. Otherwise an image is SEQUENCE_TIMESTEP_CAMERA.png (timestep of five digits), as `headbench run` names its renders: 8-bit RGB PNG of
    the ground truth's size, composited on the capture's background. It lies in FOLDER itself, in a folder named after the task,
    or in renders/TASK; with several subjects, in a folder named after the subject. A cell of a run (SUBJECT/METHOD/seed-N) also
    has this layout. Give other names with --names.
    """

    folder: tyro.conf.Positional[str]
    """Folder with the images, or with --avatar that of an avatar as `headbench render` takes it; with --truth also a video."""

    out: str = ""
    """Folder to write: a run with one method, which `table`, `compare`, `verify` and every report can read; with --truth, a
    file to write as CSV with a row for each pair, by default none."""

    truth: str | None = None
    """Folder of images or videos to compare with, or a video."""

    masks: str | None = None
    """With --truth: folder with a mask of the same name for each of its images or videos, white inside. Metrics that can be
    limited to a region are computed in the mask, too; those of the face take it as the visible face."""

    resize: Resize | None = None
    """With --truth: resize renders of another size to that of the ground truth by means of areas or bicubically, antialiased;
    default: they are refused."""

    clip: str | None = None
    """Capture to score against (or folder of several); default: that of the run named by --like."""

    label: str = ""
    """Name of the method in tables; not the name of a registered method. Default: images, with --avatar the method that
    avatar.json names."""

    avatar: bool = False
    """FOLDER holds an avatar: it is rendered, and its storage and speed are measured, too."""

    method: str = ""
    """With --avatar: its method as package.module:SPEC, where that is not registered."""

    device: str = "cpu"
    """Device of metrics that can use a GPU, and of rendering with --avatar."""

    names: str = ""
    """How the images are named, if not by key: a method whose own program numbers its renders, such as an adapter to an
    official repository, or a file MAP.csv with the columns file, sequence, timestep, camera (and subject with several)."""

    any_background: bool = False
    """Score images as they are even where their background is not the capture's, which is refused otherwise."""

    like: str | None = None
    """Run whose protocols to follow: capture, reader and its settings, tasks, frames, metrics are taken from it."""

    tasks: tuple[TaskName, ...] = ("novel_view", "self_reenactment")
    """Tasks to score. Not with --like, whose run decides it."""

    metrics: tuple[str, ...] = ()
    """Metrics of frames to compute; default: those of `headbench run`. Not with --like. With --truth also NAME@PROFILE."""

    protocol: tuple[str, ...] = ()
    """Published protocols, as for `headbench run`. Not with --like. With --truth one, whose metrics are computed unless --metrics
    names others."""

    reader: str = ""
    """Which dataset reader opens the capture; default: the one that finds it. Not with --like."""

    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""

    trust: bool = False
    """With --like, import the modules that the run folder names for metrics and readers which are not registered; they
    can run any code."""

    frames_per_task: int | None = None
    """Largest number of frames scored per subject and task, evenly spaced; default: all. Not with --like."""

    dependent = (
        DependentOptions(("tasks", "metrics", "protocol", "reader", "frames_per_task"), "like", False),
        DependentOptions(("trust",), "like"),
        DependentOptions(("method",), "avatar"),
        DependentOptions(("names", "any_background"), "avatar", False),
        DependentOptions(("masks", "resize"), "truth"),
        DependentOptions(
            ("clip", "label", "avatar", "names", "any_background", "like", "tasks", "reader", "head")
            + ("frames_per_task",),
            "truth",
            False,
        ),
    )

    def __post_init__(self) -> None:
        """Refuse settings without a reference for the evaluation."""
        if self.truth is None and self.clip is None and self.like is None:
            raise ValueError("state the reference: --clip CAPTURE, --like RUN or --truth FOLDER")
        if self.truth is None and not self.out:
            raise ValueError("state the folder to write: --out OUT")


SAMPLE = 8
"""Number of frames checked per subject and task, evenly spaced."""
TOLERANCE = 24.0
"""Maximum difference of the background's colour, in 8-bit levels of a channel.

In the demo it is 0 in each frame of the five methods and two trivial baselines, since less than half of the pixels differ
(at most 18 %, for `mean-image`); black instead of white differs by 255.
"""
EXACT = 2
"""Maximum difference, in 8-bit levels, of ground-truth pixels that count as background."""
CORNER = 8
"""A corner is a square of the image's shorter side divided by this."""
LEAST = 0.005
"""Minimum share of background pixels; frames with fewer are not checked."""


def check_background(clip: Clip, renders: Mapping[FrameKey, Render]) -> None:
    """Compare the background of renders of one task with the clip's, on a sample of frames.

    The background colour of a frame is the median over the pixels of `certain_background`. Since a poor method may
    fail in some frames, `InputError` is raised only if more than half of the sample differs by more than
    `TOLERANCE`.
    """
    declared = 255 * np.asarray(clip.background, dtype=np.float64)
    keys = sorted(renders)
    judged: list[tuple[FrameKey, FloatArray]] = []
    for key in keys[:: max(1, len(keys) // SAMPLE)]:
        colour = background_colour(clip, key, _pixels(renders[key], clip))
        if colour is not None:
            judged.append((key, colour))
    wrong = [(key, colour) for key, colour in judged if np.abs(colour - declared).max() > TOLERANCE]
    if 2 * len(wrong) <= len(judged):
        return
    colours = np.median([colour for _, colour in wrong], axis=0)
    expected = f"the background of the capture, {_rgb(declared)}, where the ground truth shows it"
    raise InputError(
        renders[wrong[0][0]].image,
        "background",
        expected,
        f"{_rgb(colours)} (in {len(wrong)} of {len(judged)} frames checked)",
        f"Composite the renders on {_rgb(declared)}, or score them as they are with --any-background.",
    )


def background_colour(clip: Clip, key: FrameKey, image: ByteArray) -> FloatArray | None:
    """(3,) median background colour of an image, 0 to 255; None with too few pixels that are certainly background."""
    ground = certain_background(clip, key)
    return np.median(image[ground], axis=0) if ground.mean() >= LEAST else None


def certain_background(clip: Clip, key: FrameKey) -> BoolArray:
    """(H, W) mask of the pixels in which the ground truth shows only the clip's background.

    These pixels have its colour and are outside of the mask or, without a mask, in a corner of the image.
    """
    truth, mask = clip.image(key), clip.mask(key)
    plain = np.asarray((np.abs(truth - 255 * np.asarray(clip.background)) <= EXACT).all(axis=-1))
    if mask is not None:
        return np.asarray(plain & (mask == 0))
    height, width = plain.shape
    side = max(1, min(height, width) // CORNER)
    rows, columns = (np.minimum(np.arange(n), np.arange(n)[::-1]) < side for n in (height, width))
    return plain & rows[:, None] & columns


def _pixels(render: Render, clip: Clip) -> ByteArray:
    if render.alpha is not None:
        return composited(render, clip.background.tolist())
    return read_png(render.image)


def _rgb(colour: FloatArray | Sequence[float]) -> str:
    return "RGB {:.0f}, {:.0f}, {:.0f}".format(*colour)


class NoAvatar:
    """Placeholder for the avatar, which a folder of images lacks; metrics of avatars are not computed."""

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Not available."""
        raise HeadbenchError("images of a folder have no avatar")

    def files(self) -> Sequence[Path]:
        """No files."""
        return []


def images_method(label: str, version: str) -> ResolvedMethod:
    """A method that consists of stored images; ``version`` is their digest."""
    return ResolvedMethod(MethodSpec(label, "images of a folder", "", version=version), None, Budget())


@command("evaluate", group="compare")
def evaluate_folder(settings: EvaluateSettings, progress: Progress = no_progress) -> CommandResult:
    """Score images against others or a capture, or a stored avatar, without a plug-in.

    The text is the table, together with the run named by ``like``.
    """
    check_device(settings.device)
    source = Path(settings.folder)
    if settings.truth is not None:
        masks = None if settings.masks is None else Path(settings.masks)
        out = Path(settings.out) if settings.out else None
        how = settings.metrics, settings.protocol, settings.resize, out, settings.device
        return score_pairs(source, Path(settings.truth), masks, *how, progress)
    stored = open_avatar(source, settings.method) if settings.avatar else None
    label = settings.label or ("images" if stored is None else stored.record["method"])
    config, clips = _open(settings, label, {} if stored is None else stored.heads)
    metrics = [
        m for m in resolve_metrics(config) if m.per_frame or (settings.avatar and m.kind != "training")
    ]
    if not metrics:
        raise InputError("metrics", "", "at least one metric of frames", ", ".join(config.metrics))
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    images: dict[tuple[str, FrameKey], Render] = {}
    avatar: Avatar = NoAvatar()
    if stored is not None:
        if len(clips) > 1:
            raise InputError(
                str(config.data), "", "the capture of the avatar's subject", f"{len(clips)} captures"
            )
        stored.check_subject(clips[0])
        avatar, of = stored.load(config.device), stored.method
        method = images_method(config.methods[0], avatar_digest(source)[:12])
        needs = {
            name: getattr(of.spec, name) for name in ("head_models", "monocular", "resolution", "mechanism")
        }
        method = replace(method, spec=replace(method.spec, **needs))
    else:
        images = find_images(source, clips, protocols, settings.names, config)
        if not settings.any_background:
            for task, clip in product(protocols, clips):
                of_task = {key: render for (t, key), render in images.items() if t == task}
                check_background(clip, {k: r for k, r in of_task.items() if k.subject == clip.subject})
        digests = [
            [
                task,
                str(key),
                *(digest_file(path) for path in (render.image, render.alpha) if path is not None),
            ]
            for (task, key), render in sorted(images.items())
        ]
        method = images_method(config.methods[0], digest(digests)[:12])

    def score(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
        if settings.avatar:
            render(job, avatar)
        else:
            _copy(images, job)
        return measure(job, avatar, metrics)

    cells = [(method, PLAIN)]
    finished = run(config, cells=cells, metrics=metrics, clips=clips, each=score, unchecked=True)
    together = [*([Path(settings.like)] if settings.like else []), finished]
    text = resolve(get("reports", "table-text").implementation)(together, fit=True)
    data = {
        "out": finished.folder.root,
        "method": method.spec.name,
        "version": method.spec.version,
        "rows": len(finished.rows),
    }
    return CommandResult(f"{text}\n{finished.folder.root}", data, not finished.rows.failed)


def _open(settings: EvaluateSettings, label: str, heads: Mapping[str, str]) -> tuple[RunConfig, list[Clip]]:
    """The settings, with the name of the method and the head models of an avatar, and the captures to score against."""
    check_name(label, "command line", "--label")
    if settings.label in discover("methods"):
        expected = "a name that no registered method has"
        raise InputError("command line", "--label", expected, repr(label), f"For example {label}-official.")
    if settings.like is not None:
        options = RunOptions(data=settings.clip, head=settings.head, trust=settings.trust)
        config, clips = open_run_clips(
            Path(settings.like),
            options,
            out=Path(settings.out),
            altered=settings.clip is not None,
            used=("metrics",),
        )
    else:
        asked = needed(settings.protocol, {}) if settings.protocol else {}
        config = capture_configuration(
            str(settings.clip),
            settings.out,
            settings.reader,
            settings.head,
            **{"tasks": settings.tasks, **asked},
            metrics=settings.metrics
            or tuple(n for n in default_names("metrics") if settings.avatar or get("metrics", n).per_frame),
            frames_per_task=settings.frames_per_task,
        )
        clips = open_clips(config)
        for clip in clips:
            check_capture(settings.protocol, clip)
    config = replace(
        config,
        out=settings.out,
        methods=(label,),
        seeds=(0,),
        settings={},
        heads={**heads, **config.heads} if settings.avatar else {},
        device=settings.device,
    )
    return config, clips


def _copy(images: Mapping[tuple[str, FrameKey], Render], job: Job) -> None:
    """Copy the images of a subject to the run's folders of renders."""
    for (task, key), source in images.items():
        target = job.cell.render(task, key)
        if key.subject != job.clip.subject or (target.exists() and target.samefile(source.image)):
            continue
        if source.alpha is not None:
            write_png(target, composited(source, job.clip.background.tolist()))
            continue
        with atomic_path(target) as temporary:
            shutil.copyfile(source.image, temporary)


SHOWN = 3


def find_images(
    folder: Path,
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
    names: str = "",
    config: RunConfig | None = None,
) -> dict[tuple[str, FrameKey], Render]:
    """Find the image of every frame of every protocol, by task and key; all checks except those of pixels are made.

    Parameters
    ----------
    names : str
        Naming scheme of the images, see `named_renders`; "" names them by frame key.
    config : RunConfig | None
        Configuration that opened the captures; required with ``names``.
    """
    if not folder.is_dir():
        raise InputError(folder, "", "a folder of images", "no such folder")
    named = named_renders(names, folder, config, clips) if names and config is not None else None
    images: dict[tuple[str, FrameKey], Render] = {}
    missing: list[tuple[str, FrameKey]] = []
    for task, protocol in protocols.items():
        for key in protocol.keys:
            if named is not None:
                render = named.get(key)
            else:
                paths = _places(folder, task, key, len(clips))
                render = next((Render(path) for path in paths if path.is_file()), None)
            if render is None or not render.image.is_file():
                missing.append((task, key))
            else:
                images[task, key] = render
    if missing:
        expected = f"an image for each of {len(images) + len(missing)} frames"
        first = "; ".join(f"{task} {key}" for task, key in missing[:SHOWN])
        if named is None:
            looked = ", ".join(str(p.relative_to(folder)) for p in _places(folder, *missing[0], len(clips)))
            remedy = f"The first one was expected as {looked}; give other names with --names."
        elif missing[0][1] in named:
            remedy = f"The first one was expected as {named[missing[0][1]].image}."
        else:
            remedy = (
                f"{names} names none for the first. Leave a task out with --tasks, or render all its frames."
            )
        raise InputError(folder, "", expected, f"{len(missing)} without, such as {first}", remedy)
    for clip in clips:
        frames = {key: render for (_, key), render in images.items() if key.subject == clip.subject}
        for key, render in frames.items():
            camera = clip.cameras[key.camera]
            _check(render.image, (camera.width, camera.height))
            if render.alpha is not None:
                _check(render.alpha, (camera.width, camera.height))
        check_truth(clip, frames, frames)
    return images


def _places(folder: Path, task: str, key: FrameKey, subjects: int) -> list[Path]:
    """Possible paths of a frame's image, in order of precedence."""
    name = Cell(folder).render(task, key).name
    roots = [folder / key.subject] + ([folder] if subjects == 1 else [])
    return [place / name for root in roots for place in (root / "renders" / task, root / task, root)]


def _check(path: Path, size: tuple[int, int]) -> None:
    info = probe_image(path)
    if (info.width, info.height) != size:
        expected, found = ("{} x {} pixels".format(*pair) for pair in (size, (info.width, info.height)))
        remedy = "Render at the capture's size; a resized image would be scored for its resizing, too."
        raise InputError(path, "size", f"{expected}, as the ground truth", found, remedy)
    if info.format != "PNG":
        raise InputError(path, "format", "PNG, which is lossless", info.format)
    if info.table or info.channels not in (3, 4):
        raise InputError(path, "mode", "8-bit RGB", "a table of colours" if info.table else "grey")
    if info.has_alpha and read_pixels(path)[..., 3].min() < 255:
        remedy = "Composite it on the background of the capture."
        raise InputError(path, "alpha", "an opaque image", "transparent pixels", remedy)
