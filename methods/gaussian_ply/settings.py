"""Settings of ``headbench export ply`` and ``headbench import ga``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class ExportPlySettings:
    """Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open."""

    avatar: tyro.conf.Positional[str]
    """Folder of an avatar of ours, ga or gbs (RUN/avatars/...)."""

    out: str
    """PLY file to write."""

    capture: str | None = None
    """Capture with the pose to write; without one the pose is neutral."""

    timestep: int | None = None
    """Timestep of the capture; default: the first of its training frames."""

    head: str | None = None
    """Head model for a capture that brings none: FLAME pickle or npz."""

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
class ImportGASettings:
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on."""

    ply: tyro.conf.Positional[str]
    """The PLY, with a column binding_0 (`point_cloud/iteration_<N>/point_cloud.ply`)."""

    capture: str
    """Capture in the GaussianAvatars/VHAP layout: it brings the head model, the shape and the static offset."""

    out: str
    """Folder to write; `headbench export ply` and the method ga load it."""

    head: str | None = None
    """Head model for a capture that brings none: FLAME pickle or npz."""
