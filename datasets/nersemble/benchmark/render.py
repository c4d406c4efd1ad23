"""Renders the test frames of the benchmark's monocular track from a stored avatar."""

from __future__ import annotations

import logging
from pathlib import Path

from ....bench.contracts import Progress, no_progress
from ....bench.engine.stored import AVATAR_FILE, HEAD_FILE, open_avatar
from ....bench.errors import InputError
from ....bench.io.images import quantise, write_png
from ....bench.specs import CommandResult
from ...head.arrays import HeadArrays, read_head
from ...head.loaders import load_head
from ...head.teeth import with_teeth_where_possible
from .data import read_sequence
from .settings import SubmissionRenderSettings
from .tracks import MONO

log = logging.getLogger(__name__)

WHITE = (1.0, 1.0, 1.0)


def render_participant(settings: SubmissionRenderSettings, progress: Progress = no_progress) -> CommandResult:
    """Render every frame of a participant's test sequences from all cameras of the track.

    Raises `InputError` for an unknown participant, an avatar that cannot be read, and tracking or cameras that are missing or
    damaged, all before the first frame.
    """
    if settings.participant not in MONO.sequences:
        expected = f"one of {', '.join(MONO.sequences)}"
        raise InputError("command line", "--participant", expected, repr(settings.participant))
    stored = open_avatar(Path(settings.avatar), settings.method)
    folder, method = stored.folder, stored.method
    head = _head(folder, settings.head)
    sequences = {
        name: read_sequence(Path(settings.data), MONO, settings.participant, name, head)
        for name in MONO.sequences[settings.participant]
    }
    if not method.spec.resolution.native:
        expected = "one that works at the size of the benchmark's images, 512x512"
        found = f"{method.spec.name}, which works at another"
        raise InputError(folder / AVATAR_FILE, "resolution", expected, found, "Train it with another preset.")
    for name, sequence in sequences.items():
        shown = stored.shows_another(settings.participant, sequence.shape, head.version)
        if shown:
            log.warning(
                "%s shows %s, with another shape than %s has in %s", folder, shown, settings.participant, name
            )
    avatar = stored.load(settings.device)
    home = Path(settings.out) / settings.participant
    total = sum(len(sequence.poses) * len(sequence.cameras) for sequence in sequences.values())
    done = 0
    for name, sequence in sequences.items():
        for timestep, pose in enumerate(sequence.poses):
            for serial, camera in sequence.cameras.items():
                image = quantise(avatar.render(camera, pose, WHITE).rgb)
                write_png(home / f"{name}_{timestep:05d}_{serial}.png", image)
                done += 1
                progress(done, total, name)
    return CommandResult(
        f"{home}: {total} frames of {len(sequences)} sequences", {"out": home, "frames": total}
    )


def _head(folder: Path, given: str | None) -> HeadArrays:
    if given is not None:
        return with_teeth_where_possible(load_head(Path(given)))
    path = folder / HEAD_FILE
    if not path.is_file():
        remedy = "Name it with --head: flame2023.pkl."
        raise InputError(path, "", "the head model beside the avatar", "no such file", remedy)
    return read_head(path)
