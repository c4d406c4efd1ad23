"""Settings of the exports and imports of avatars."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.engine.config import AvatarFolder
from ...bench.options import DependentOptions
from ...datasets.options import CaptureOptions


@dataclass(frozen=True)
class AvatarOptions(CaptureOptions):
    """Avatar to export and output file."""

    avatar: AvatarFolder

    out: str
    """File to write."""

    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""


@dataclass(frozen=True)
class ExportOptions(AvatarOptions):
    """Avatar and pose to export."""

    capture: str | None = None
    """Capture with the pose to write; without one the pose is neutral."""

    timestep: int | None = None
    """Timestep of the capture; default: the first of its training frames."""

    directions: int = 96
    """Number of viewing directions, evenly spread over the sphere, in which colours other than spherical harmonics are sampled."""

    dependent = (DependentOptions(("timestep", "reader", "head", "cy", "set"), "capture"),)

    def __post_init__(self) -> None:
        if self.directions < 32:
            raise ValueError(
                f"directions must be at least 32, twice the coefficients, found {self.directions}"
            )


@dataclass(frozen=True)
class ExportPlySettings(ExportOptions):
    """Write an avatar in one pose as a 3D Gaussian splatting PLY, in full precision, for common viewers."""


@dataclass(frozen=True)
class ExportGlbSettings(ExportOptions):
    """Write an avatar in one pose as binary glTF with KHR_gaussian_splatting, in full precision."""


@dataclass(frozen=True)
class ExportSogSettings(ExportOptions):
    """Write an avatar in one pose as SOG, for web viewers, in about a sixth of the size of a PLY. Needs gaussforge (extra
    `formats`)."""


@dataclass(frozen=True)
class ImportGASettings(CaptureOptions):
    """Import a GaussianAvatars PLY with the flame_param.npz beside it or the capture it was trained on."""

    ply: tyro.conf.Positional[str]
    """The PLY, with a column binding_0 (`point_cloud/iteration_<N>/point_cloud.ply`)."""

    out: str
    """Folder to write; `headbench export ply`, `headbench render` and the method ga load it."""

    capture: str | None = None
    """Capture it was trained on, in a layout that a reader knows; not needed with a flame_param.npz and --head."""

    flame_param: str | None = None
    """The parameters that the official repository stored with the splats, of one timestep or of all; default: the file
    flame_param.npz beside the PLY, if there is one. "none" ignores it."""

    subject: str = ""
    """Name of the subject, if there is no --capture."""

    dependent = (
        DependentOptions(("reader", "cy"), "capture"),
        DependentOptions(("subject",), "capture", False),
    )
