"""``headbench export colmap``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.io.files import write_json
from ...bench.io.lock import LOCK_FILE
from ...bench.options import DependentOptions
from ...bench.specs import CommandResult, command
from ..options import CaptureOptions


@dataclass(frozen=True)
class ExportColmapSettings(CaptureOptions):
    """Write frames of a capture as a COLMAP dataset: images, masks and a sparse model."""

    capture: tyro.conf.Positional[str]
    """Capture, in a layout that a reader knows."""

    out: str
    """Folder to write: images/, masks/ and sparse/0/."""

    tracking: bool = False
    """Also write the tracked parameters and the head model, so that the reader colmap can read the dataset."""

    timesteps: tuple[int, ...] = ()
    """Timesteps to write; default: the first of training, since COLMAP's scenes are static."""

    all_timesteps: bool = False
    """Write every timestep. The points are the mesh of the first one."""

    format: Literal["bin", "txt"] = "bin"
    """Format of the sparse model."""

    names: Literal["nested", "flat"] = "nested"
    """Names of images: SUBJECT/SEQUENCE/TIMESTEP/CAMERA.png, or SEQUENCE_TIMESTEP_CAMERA.png in one folder, as readers
    of 3D Gaussian splatting, GaussianAvatars, OpenSplat and nerfbaselines need it; masks are then NAME.png and
    NAME.png.png."""

    dependent = (DependentOptions(("timesteps",), "all_timesteps", False),)


MARKER = "headbench-export.json"
"""File that identifies a folder written by `export_colmap`; others may have the user's own model and images."""


@command("export colmap", group="export", writes="out", kinds=("a COLMAP dataset",))
def export_colmap(settings: ExportColmapSettings, progress: Progress) -> CommandResult:
    """Write frames of a capture as a COLMAP dataset: images, masks, sparse model.

    See `export_model`.
    """
    from ..clip import check_apart
    from .reader import export_model, export_tracking

    clip = settings.open(settings.capture, progress)
    out = Path(settings.out)
    check_apart(clip, out)
    present = {path.name for path in out.glob("[!.]*")} - {LOCK_FILE}
    if present and MARKER not in present:
        expected = "a new folder, or one that this command wrote"
        found = "one with other files"
        raise InputError(out, "--out", expected, found, "Nothing was written. Choose another folder.")
    chosen = set(settings.timesteps) or {clip.timesteps("train")[0]}
    if settings.all_timesteps:
        chosen = set(clip.poses)
    unknown = sorted(chosen - set(clip.poses))
    if unknown:
        expected = f"timesteps of the capture, {min(clip.poses)} to {max(clip.poses)}"
        raise InputError("--timesteps", "", expected, ", ".join(map(str, unknown)))
    keys = [key for key in clip.files if key.timestep in chosen]
    write_json(out / MARKER, {"capture": clip.subject, "fingerprint": clip.fingerprint})
    written = export_model(
        clip, keys, out, model_format=settings.format, naming=settings.names, progress=progress
    )
    if settings.tracking:
        export_tracking(clip, chosen, out)
    text = (
        f"{out}: {written.cameras} cameras, {written.images} images, {written.points} points "
        f"with {written.observations} observations"
    )
    return CommandResult(text, {"out": out, **written._asdict()})
