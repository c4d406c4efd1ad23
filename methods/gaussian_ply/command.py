"""``headbench export ply`` and ``headbench import ga``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.specs import Findings, writes
from ...datasets.options import CaptureOptions


@dataclass(frozen=True)
class ExportPlySettings(CaptureOptions):
    """Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open."""

    avatar: tyro.conf.Positional[str]
    """Folder of an avatar of ours, ga or gbs (RUN/SUBJECT/METHOD/seed-0/avatar)."""

    out: str
    """PLY file to write."""

    capture: str | None = None
    """Capture with the pose to write; without one the pose is neutral."""

    timestep: int | None = None
    """Timestep of the capture; default: the first of its training frames."""

    directions: int = 96
    """Viewing directions, even over the sphere, at which colours that are not spherical harmonics are sampled."""

    def __post_init__(self) -> None:
        if self.timestep is not None and self.capture is None:
            raise ValueError("timestep needs a capture")
        if self.directions < 32:
            raise ValueError(
                f"directions must be at least 32, twice the coefficients, found {self.directions}"
            )


@dataclass(frozen=True)
class ImportGASettings(CaptureOptions):
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on."""

    ply: tyro.conf.Positional[str]
    """The PLY, with a column binding_0 (`point_cloud/iteration_<N>/point_cloud.ply`)."""

    capture: str
    """Capture, in a layout that a reader knows: it brings the head model, the shape and the static offset."""

    out: str
    """Folder to write; `headbench export ply` and the method ga load it."""


def export_ply(settings: ExportPlySettings, progress: Progress = no_progress) -> Findings:
    """Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open.

    The findings state how well harmonics represent its colours.
    """
    from .files import export_avatar

    return export_avatar(settings, progress)


@writes("out")
def import_ga(settings: ImportGASettings, progress: Progress = no_progress) -> Findings:
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on.

    Harmonics of a lower degree are filled up with zeros, and whatever other columns there are is left out. Tracking
    that the training refined is in another file (`flame_param.npz`) and is not read: the avatar follows the capture's.
    """
    from .files import import_avatar

    return import_avatar(settings, progress)
