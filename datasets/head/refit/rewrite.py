"""Write a clip with other tracking as a new capture; PNG files that no step changes are linked."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TypeGuard

from ....bench.contracts import FrameKey, Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import atomic_path
from ....bench.manifest import cut_of
from ...clip import CaptureClip
from ...ga.validate import require_full_grid
from ...ga.writer import CapturePlan, CaptureWriter, SequencePlan


def write_capture(clip: CaptureClip, out: Path, progress: Progress = no_progress) -> Path:
    """Write the clip under ``out`` in the GaussianAvatars/VHAP layout; return the union folder.

    Frames keep their sequence and camera; splits, exclusions and background are unchanged. The timesteps of a sequence
    are renumbered from 0 without a gap, as the layout requires.
    """
    plan, index = capture_plan(clip)
    writer = CaptureWriter(out, plan)
    for done, (key, files) in enumerate(sorted(clip.files.items())):
        progress(done, len(clip.files), "writing images")
        place = (key.sequence, index[key.timestep], key.camera)
        if clip.pixel_steps or not _is_png(files.image) or not (files.mask is None or _is_png(files.mask)):
            writer.write_frame(*place, clip.image(key), clip.mask(key))
            continue
        if files.mask is not None:
            link_or_copy(files.mask, writer.mask_path(*place))
        link_or_copy(files.image, writer.image_path(*place))
    return writer.write_metadata()


def capture_plan(clip: CaptureClip, source: str | Path = "") -> tuple[CapturePlan, dict[int, int]]:
    """Plan of the capture for a clip, and each timestep's number in its sequence."""
    where = str(source) or f"clip of {clip.subject}"
    require_full_grid(clip, where)
    _check_excluded(clip, where)
    timesteps: dict[str, list[int]] = {}  # of each sequence, in order; sequences by their first
    for timestep, name in sorted({(key.timestep, key.sequence) for key in clip.files}):
        timesteps.setdefault(name, []).append(timestep)
    index = {timestep: number for found in timesteps.values() for number, timestep in enumerate(found)}
    novel = {key.camera for key in clip.splits["novel_view"]}
    held: dict[str, set[int]] = {}  # timesteps of each sequence in the capture written
    for key in clip.splits["self_reenactment"]:
        held.setdefault(key.sequence, set()).add(index[key.timestep])
    for split, keys in clip.splits.items():
        for key in keys:
            placed = "novel_view" if key.camera in novel else "train"
            if split != ("self_reenactment" if index[key.timestep] in held.get(key.sequence, ()) else placed):
                expected = "splits by held-out timesteps and cameras, which the layout can represent"
                raise InputError(where, "splits", expected, f"{key} in {split}")
    shared = {key.sequence for name in ("train", "novel_view") for key in clip.splits[name]}
    background = tuple(float(value) for value in clip.background)
    sequences = [
        SequencePlan(
            name,
            [clip.poses[timestep] for timestep in found],
            {index[k.timestep]: why for k, why in clip.excluded.items() if k.sequence == name},
            frozenset(held.get(name, ())) if name in shared else frozenset(),
        )
        for name, found in timesteps.items()
    ]
    plan = CapturePlan(
        subject=clip.subject,
        head=clip.head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=[*clip.cameras.values()],
        sequences=sequences,
        test_sequences=sorted(held.keys() - shared),
        novel_view_cameras=sorted(novel),
        background=(background[0], background[1], background[2]),
        synthetic=clip.steps[0].parameters.get("synthetic", {}) if clip.steps else {},
        cut=cut_of(map(asdict, clip.steps)),
    )
    return plan, index


def link_or_copy(source: Path, target: Path) -> None:
    """Link ``target`` to ``source``, or copy it if the file system does not support links; atomically."""
    if target.exists() and os.path.samefile(source, target):
        return
    with atomic_path(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def _is_png(path: Path | None) -> TypeGuard[Path]:
    return path is not None and path.suffix.lower() == ".png"


def _check_excluded(clip: CaptureClip, where: str) -> None:
    """Check exclusions: the layout can exclude only whole timesteps, each for one reason."""
    of_timestep: dict[int, FrameKey] = {}
    for key in sorted(clip.files):
        first = of_timestep.setdefault(key.timestep, key)
        found, other = clip.excluded.get(key), clip.excluded.get(first)
        if found != other:
            expected = f"timestep {key.timestep} excluded with all its cameras for one reason, or not at all"
            said = {first: other, key: found}
            parts = [f"{one} {'kept' if why is None else f'excluded: {why}'}" for one, why in said.items()]
            raise InputError(where, "excluded", expected, " and ".join(parts))
