"""Formats that count frames by timestep and camera hold no gaps: check for them before long work."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import FrameKey
from ...bench.errors import InputError
from ..clip import CaptureClip


def require_full_grid(clip: CaptureClip, source: str | Path = "") -> None:
    """Check that every camera has a frame at every timestep; excluded frames count as there.

    Parameters
    ----------
    source : the capture the clip was read from, for the message.

    Raises
    ------
    InputError
        Naming the first frame that is missing, and how many are.
    """
    timesteps = sorted({(key.sequence, key.timestep) for key in clip.files})
    wanted = (
        FrameKey(clip.subject, sequence, timestep, camera)
        for sequence, timestep in timesteps
        for camera in clip.cameras
    )
    missing = [key for key in wanted if key not in clip.files]
    if missing:
        where = str(source) or f"clip of {clip.subject}"
        more = f", and {len(missing) - 1} more missing" if len(missing) > 1 else ""
        remedy = (
            "List the frame in a transforms JSON of the capture, or leave its timestep or camera out of all."
        )
        found = f"no such frame{more}"
        raise InputError(
            where, f"frame {missing[0]}", "a frame of every camera at every timestep", found, remedy
        )
