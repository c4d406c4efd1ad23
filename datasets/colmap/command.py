"""``headbench export colmap``."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.specs import Findings
from ..ga.reader import read_capture
from .settings import ExportColmapSettings
from .writer import export_model


def run(settings: ExportColmapSettings, progress: Progress) -> Findings:
    """Export a capture; see `export_model`. Raises `InputError` for timesteps that the capture lacks."""
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
