"""``headbench export colmap``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.specs import Findings, writes


@dataclass(frozen=True)
class ExportColmapSettings:
    """Write frames of a capture as a COLMAP dataset: images, masks and a sparse model."""

    capture: tyro.conf.Positional[str]
    """Capture in the GaussianAvatars/VHAP layout."""

    out: str
    """Folder to write: images/, masks/ and sparse/0/."""

    timesteps: tuple[int, ...] = ()
    """Timesteps to write; default: the first of training, as COLMAP's scenes do not move."""

    all_timesteps: bool = False
    """Write every timestep. The points are still the mesh of the first."""

    format: Literal["bin", "txt"] = "bin"
    """Of the sparse model."""

    head: str | None = None
    """Head model for a capture that brings none: FLAME pickle or npz."""


@writes("out")
def export_colmap(settings: ExportColmapSettings, progress: Progress) -> Findings:
    """Write frames of a capture as a COLMAP dataset: images, masks and a sparse model.

    Export a capture; see `export_model`. Raises `InputError` for timesteps that the capture lacks."""
    from ..ga.reader import read_capture
    from .writer import export_model

    clip = read_capture(settings.capture, head=settings.head, progress=progress)
    chosen = set(settings.timesteps) or {clip.timesteps("train")[0]}
    if settings.all_timesteps:
        chosen = set(clip.poses)
    unknown = sorted(chosen - set(clip.poses))
    if unknown:
        expected = f"timesteps of the capture, {min(clip.poses)} to {max(clip.poses)}"
        raise InputError("--timesteps", "", expected, ", ".join(map(str, unknown)))
    keys = [key for key in clip.files if key.timestep in chosen]
    out = Path(settings.out)
    written = export_model(clip, keys, out, model_format=settings.format, progress=progress)
    text = (
        f"{out}: {written.cameras} cameras, {written.images} images, {written.points} points "
        f"with {written.observations} observations"
    )
    return Findings(text, {"out": out, **written._asdict()})
