"""Settings of ``headbench export colmap``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro


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
