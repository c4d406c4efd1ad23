"""Tracking refitted to another head model, kept on disk: it takes minutes, and a resumed run must not repeat it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import HeadPose, Progress
from ...bench.errors import InputError
from ...bench.files import atomic_path, digest, plain
from ...bench.registry import resolve
from ..clip import CaptureClip
from ..head.arrays import HeadArrays, read_npz

REFIT = "headbench.datasets.refit:refit_clip"
"""Imported when it is used: it needs an optimiser that nothing else does."""

FORMAT = 1
_VALUES = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")


def refitted(clip: CaptureClip, target: HeadArrays, folder: Path, progress: Progress) -> CaptureClip:
    """The clip with tracking of ``target``; read from ``folder`` if it was refitted before, else put there."""
    path = folder / f"refit-{digest(FORMAT, clip.fingerprint, target.fingerprint())[:16]}.npz"
    if path.exists():
        return _read(path, clip, target)
    made: CaptureClip = resolve(REFIT)(clip, target, progress=progress)
    _write(path, made, len(clip.steps))
    # Read back even now, so that a resumed run sees the same numbers to the bit.
    return _read(path, clip, target)


def _write(path: Path, clip: CaptureClip, known: int) -> None:
    """Write what a refit changed: identity, static offset, poses, and the steps after the ``known`` first ones."""
    timesteps = sorted(clip.poses)
    arrays: dict[str, np.ndarray] = {
        "timesteps": np.array(timesteps, dtype=np.int64),
        "shape": np.asarray(clip.shape),
        "static_offset": np.asarray(clip.static_offset),
        "steps": np.array(
            json.dumps([[step.name, step.parameters] for step in clip.steps[known:]], default=plain)
        ),
    }
    for name in _VALUES:
        rows = [getattr(clip.poses[timestep], name) for timestep in timesteps]
        if all(row is not None for row in rows):
            arrays[name] = np.stack(rows)
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _read(path: Path, clip: CaptureClip, target: HeadArrays) -> CaptureClip:
    """The clip with what `_write` wrote. Raises `InputError` for a file that is damaged or of something else."""
    content = read_npz(path)
    timesteps = [int(timestep) for timestep in _array(path, content, "timesteps", (len(clip.poses),))]
    if timesteps != sorted(clip.poses):
        raise InputError(path, "timesteps", "those of the clip", "others", "Delete the file.")
    sizes = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3, "eyelids": 2}
    sizes["expression"] = target.expression_basis.shape[2]
    columns = {
        name: _array(path, content, name, (len(timesteps), sizes[name]))
        for name in _VALUES
        if name != "eyelids" or name in content
    }
    poses = {}
    for row, timestep in enumerate(timesteps):
        values: dict[str, Any] = {name: column[row] for name, column in columns.items()}
        poses[timestep] = HeadPose(target.version, **values, subject=clip.subject, timestep=timestep)
    changes: dict[str, Any] = {
        "head": target,
        "shape": _array(path, content, "shape", target.shape_basis.shape[2:]),
        "static_offset": _array(path, content, "static_offset", target.template.shape),
        "poses": poses,
    }
    for name, parameters in _steps(path, content):
        clip = clip.derive(name, parameters, **changes)
    return clip


def _array(path: Path, content: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    values = content.get(name)
    if values is None or values.shape != shape or not np.isfinite(values).all():
        found = "none" if values is None else f"shape {values.shape}, or numbers that are not finite"
        raise InputError(path, name, f"finite numbers of shape {shape}", found, "Delete the file.")
    return values


def _steps(path: Path, content: dict[str, np.ndarray]) -> list[tuple[str, dict[str, Any]]]:
    try:
        steps = [(str(name), dict(parameters)) for name, parameters in json.loads(str(content["steps"]))]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(path, "steps", "the steps of a refit", str(error), "Delete the file.") from error
    if not steps:
        raise InputError(path, "steps", "at least one step", "none", "Delete the file.")
    return steps
