"""Settings of the commands on submissions to the NeRSemble benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from ....bench.engine.config import AvatarFolder


@dataclass(frozen=True)
class SubmissionRenderSettings:
    """Render the test frames of a participant of the NeRSemble benchmark's monocular track from a stored avatar, which was
    trained on the participant's training sequences."""

    avatar: AvatarFolder

    data: str
    """The benchmark's folder, as nersemble-benchmark-download leaves it: it holds mono_flame_avatar/."""

    participant: str
    """Participant of the avatar: 393, 404, 461, 477 or 486."""

    out: str
    """Folder to write: OUT/PARTICIPANT/SEQUENCE_TIMESTEP_SERIAL.png."""

    head: str | None = None
    """FLAME 2023 (flame2023.pkl); default: the head model beside the avatar."""

    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""

    device: str = "cpu"
    """Where to render."""


@dataclass(frozen=True)
class SubmissionWriteSettings:
    """Encode rendered frames and write the zip for the NeRSemble benchmark."""

    frames: tyro.conf.Positional[str]
    """Folder with PARTICIPANT/SEQUENCE_TIMESTEP_SERIAL.png, or a run whose subjects are the participants."""

    zip: tyro.conf.Positional[str]
    """File to write."""

    track: Literal["nvs", "mono_flame_avatar"]
    """Task of the benchmark."""

    method: str = ""
    """Method of a run with several."""

    data: str | None = None
    """The benchmark's folder, whose tracking has the number of frames of each sequence. Without it, the published totals are checked."""


@dataclass(frozen=True)
class SubmissionCheckSettings:
    """Report what the NeRSemble benchmark's server would refuse in a submission.

    Exit code 0: no fault; 1: a fault; 2: not a readable zip.
    """

    zip: tyro.conf.Positional[str]
    """The submission."""

    track: Literal["", "nvs", "mono_flame_avatar"] = ""
    """Task of the benchmark; default: the one that the zip has most files of."""

    data: str | None = None
    """The benchmark's folder, whose tracking has the number of frames of each sequence. Without it, the published totals are checked."""
