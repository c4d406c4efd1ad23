"""Opens the captures of a run through the reader asked for, and holds what it gives to the contract."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path

from .adaptation import MethodNeeds, carry_out, plan
from .configuration import build_arguments
from .contracts import Clip
from .errors import InputError
from .files import check_name
from .progress import progress
from .registry import get, resolve
from .run_config import RunConfig
from .specs import DatasetSpec, ResolutionRule


def open_clips(config: RunConfig) -> list[Clip]:
    """Open every capture under ``config.data``, each validated whole by its reader, at the size to be measured at.

    Raises `InputError` for a folder without captures, a setting the reader does not know or of the wrong type,
    subjects that are not distinct, and whatever the reader finds wrong.
    """
    spec: DatasetSpec = get("datasets", config.reader)
    if not spec.reads:
        raise InputError("reader", spec.name, "a dataset that is read", "one that makes captures")
    read = resolve(spec.implementation)
    settings = build_arguments(read, config.reader_settings, "reader_settings", harness=("progress",))
    root = Path(config.data)
    if not root.exists():
        raise InputError(root, "--data", "a capture folder", "no such folder")
    paths: Sequence[Path] = resolve(spec.find)(root) if spec.find else [root]
    if not paths:
        raise InputError(root, "--data", f"captures that reader {spec.name!r} knows", "none")
    clips: list[Clip] = []
    for path in paths:
        with progress(f"reading {path.name}") as report:
            reported = {"progress": report} if "progress" in inspect.signature(read).parameters else {}
            clips.append(_reduced(_checked(read(path, **settings, **reported)), spec, config))
    subjects = [clip.subject for clip in clips]
    if len(set(subjects)) != len(subjects):
        raise InputError(root, "subject", "a different subject in each capture", ", ".join(subjects))
    return clips


def _reduced(clip: Clip, reader: DatasetSpec, config: RunConfig) -> Clip:
    """The clip at the size that metrics are taken at."""
    needs = MethodNeeds(resolution=ResolutionRule(divide=config.divide))
    planned = plan(clip, needs, reader, {})
    if planned is None:
        return clip
    return carry_out(planned, needs, Path(config.out), f"reducing {clip.subject}").clip


def _checked(clip: Clip) -> Clip:
    """Make sure that files and folders can be named after what the clip holds."""
    source = f"clip {clip.subject}"
    check_name(clip.subject, source, "subject")
    for camera in clip.cameras:
        check_name(camera, source, "camera")
    for sequence in {key.sequence for keys in clip.splits.values() for key in keys}:
        check_name(sequence, source, "sequence")
    return clip
