"""Functions for scripts: open a capture, train a method on it, score an avatar, or `run` a whole comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast, get_args

import pandas as pd

from .condition import PLAIN
from .contracts import Avatar, ByteArray, Clip, FrameKey, TaskName
from .engine import run as runner
from .engine.adaptation import AdaptedClip, MethodNeeds, adapt
from .engine.captures import capture_configuration, open_clips, reader_of
from .engine.cell import train as train_cell
from .engine.config import build_run_config, default_names, resolve_methods
from .engine.plan import Job, check_settings
from .engine.scoring import ScoredFrames, check_regions, score_frames
from .engine.store import RunFolder
from .engine.stored import open_avatar
from .errors import InputError
from .io.files import check_output_folder
from .io.images import quantise
from .io.lock import locked
from .machine import check_device
from .protocol import Protocol, make_protocols
from .registry import discover, get, unknown
from .specs import MethodSpec, MetricSpec

TASKS: tuple[TaskName, ...] = get_args(TaskName)
COLUMNS = ("task", "sequence", "timestep", "camera", "region", "metric", "value", "status", "reason")


def list_methods() -> dict[str, MethodSpec]:
    """The registered methods by name, in the order of tables; plug-ins that cannot be loaded are left out."""
    specs = {name: plugin.spec for name, plugin in discover("methods").items()}
    return {name: spec for name, spec in specs.items() if spec is not None}


def open_clip(
    folder: Path | str, *, reader: str = "", head: Path | str | None = None, **settings: Any
) -> Clip:
    """Open a capture of one subject.

    Parameters
    ----------
    folder : Path | str
        Folder of a capture in a layout that a registered reader knows.
    reader : str
        Name of the reader; "" selects the reader that recognises the capture.
    head : Path | str | None
        Head model file, for captures that contain none.

    Raises
    ------
    InputError
        The folder has no capture or several, or the reader finds an error in it.
    """
    config = capture_configuration(str(folder), "", reader, None if head is None else str(head))
    clips = open_clips(replace(config, reader_settings={**config.reader_settings, **settings}))
    if len(clips) > 1:
        found = f"{len(clips)}: {', '.join(clip.subject for clip in clips)}"
        raise InputError(folder, "", "the capture of one subject", found, "Name the folder of one of them.")
    return clips[0]


def train(
    method: str,
    clip: Clip | Path | str,
    out: Path | str,
    *,
    preset: str = "fast",
    seed: int = 0,
    device: str = "cpu",
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Train a method on the training frames of a clip, or continue a training that was interrupted.

    The clip is first adapted to the method, as in `run`: image size, a single video, head model.

    Parameters
    ----------
    method : str
        Name of a registered method, or "package.module:SPEC".
    clip : Clip | Path | str
        Clip returned by `open_clip`, or the folder of a capture.
    out : Path | str
        Folder for avatars. An avatar trained with the same settings, data and seed is reused.
    preset : str
        One of the method's presets.
    settings : Mapping[str, Any] | None
        Settings of the method, applied over the preset; the key "budget" holds iterations and
        seconds.

    Returns
    -------
    Path
        The folder of the avatar, ``out``/SUBJECT/METHOD/seed-N/avatar, for `evaluate` and
        `load_avatar`.

    Raises
    ------
    InputError
        Unknown method, preset or setting; a device that is missing or not supported by the method; a
        clip that the method cannot be trained on; or ``out`` holds a different avatar of the same
        subject, method and seed.
    """
    if not isinstance(method, str):
        raise InputError("train", "method", "a name, or 'module:SPEC'", type(method).__name__)
    check_device(device)
    clip = open_clip(clip) if isinstance(clip, (str, Path)) else clip
    values = {
        "data": "",
        "out": str(out),
        "methods": [method],
        "preset": preset,
        "seeds": [seed],
        "device": device,
    }
    chosen = {get("methods", method).name: dict(settings or {})}
    (resolved,) = resolve_methods(build_run_config({**values, "settings": chosen}, "train"))
    folder = RunFolder(Path(out))
    check_output_folder(folder.root)
    check_settings([(resolved, PLAIN)])
    with locked(folder.root):
        form = adapt(clip, MethodNeeds.of(resolved.spec), {}, folder.adapted / clip.subject)
        cell = folder.cell(clip.subject, resolved.spec.name, seed)
        job = Job(clip, resolved, seed, device, cell, {}, form)
        job.check()
        train_cell(job)
    return cell.avatar


def evaluate(
    avatar: Path | str | Avatar,
    clip: Clip | Path | str,
    *,
    tasks: str | Sequence[str] = TASKS,
    metrics: str | Sequence[str] = (),
    regions: str | Sequence[str] | None = None,
    frames_per_task: int | None = None,
    device: str = "cpu",
) -> pd.DataFrame:
    """Render the test frames of a clip and score them, as a run does.

    Parameters
    ----------
    avatar : Path | str | Avatar
        Folder of a stored avatar, for which the clip is adapted to its method; or an
        `Avatar`, which is given the clip's own cameras and poses.
    clip : Clip | Path | str
        Clip returned by `open_clip`, or the folder of a capture.
    metrics : str | Sequence[str]
        Names of frame metrics; empty selects the default metrics of a run.
    regions : str | Sequence[str] | None
        Image regions to score in addition to the whole frame; None selects the face if the clip has
        that region.
    frames_per_task : int | None
        Maximum number of frames of each task, evenly spaced; None means all.

    Returns
    -------
    pd.DataFrame
        One row for each frame, region and metric: task, sequence, timestep, camera, region, metric,
        value, status ("ok", or "missing" with a reason), reason.

    Raises
    ------
    InputError
        The stored avatar shows another subject, or a task, metric or region is unknown.
    """
    check_device(device)
    clip = open_clip(clip) if isinstance(clip, (str, Path)) else clip
    for task in _names(tasks):
        if task not in TASKS:
            raise unknown("evaluate", "tasks", task, TASKS)
    default = [name for name in default_names("metrics") if get("metrics", name).per_frame]
    specs: list[MetricSpec] = [get("metrics", name) for name in _names(metrics) or default]
    for spec in specs:
        if not spec.per_frame:
            raise InputError("evaluate", "metrics", "metrics of frames", spec.name)
    protocols = make_protocols(cast(Sequence[TaskName], _names(tasks)), [clip], frames_per_task)
    scored_regions = check_regions(clip, None if regions is None else _names(regions))
    rows: list[tuple[Any, ...]] = []
    with TemporaryDirectory() as scratch:
        form, loaded = AdaptedClip(clip), avatar
        if isinstance(avatar, (str, Path)):
            form, loaded = _stored(Path(avatar), clip, device, Path(scratch))
        for protocol in protocols.values():
            images = {key: _drawn(loaded, form, protocol, key) for key in protocol.keys}
            frames = ScoredFrames(images.__getitem__, clip)
            for scores in score_frames(protocol.keys, frames, specs, scored_regions, device=device).values():
                rows += [
                    (protocol.task, s.key.sequence, s.key.timestep, s.key.camera)
                    + (s.region, s.metric, s.value, s.status, s.reason)
                    for s in scores
                ]
    return pd.DataFrame(rows, columns=COLUMNS)


def run(data: Path | str, out: Path | str, *, unchecked: bool = False, **settings: Any) -> Path:
    """Run a comparison, or continue one: train, render, measure, write tables and images.

    Parameters
    ----------
    data, out : Path | str
        Capture, and output folder of the run.
    unchecked : bool
        Do not search the captures for errors of `headbench lint`, which stop a run.
    settings : Any
        Further fields of `RunConfig`, such as ``methods=("ga", "ours"), preset="smoke", seeds=(0,
        1)``.

    Returns
    -------
    Path
        The folder of the run, for `read_runs`.

    Raises
    ------
    InputError
        An error found by the checks before the first training.
    """
    values = {"data": str(data), "out": str(out), **settings}
    if "reader" not in values:
        values["reader"] = reader_of(str(data))
    runner.run(build_run_config(values, "run"), unchecked=unchecked)
    return Path(out)


def _names(given: str | Sequence[str]) -> tuple[str, ...]:
    """Names without duplicates, from one name or several."""
    return (given,) if isinstance(given, str) else tuple(dict.fromkeys(given))


def _stored(folder: Path, clip: Clip, device: str, scratch: Path) -> tuple[AdaptedClip, Avatar]:
    """A stored avatar, and the clip adapted to its method."""
    stored = open_avatar(folder)
    stored.check_subject(clip)
    form = adapt(clip, MethodNeeds.of(stored.method.spec), stored.heads, scratch)
    return form, stored.load(device)


def _drawn(avatar: Any, form: AdaptedClip, protocol: Protocol, key: FrameKey) -> ByteArray:
    """Render the frame of a protocol's key, 8-bit, at the protocol's size."""
    seen = form.key(key)
    frame = avatar.render(form.clip.cameras[seen.camera], form.clip.poses[seen.timestep], protocol.background)
    return quantise(form.restore(key, frame.rgb))
