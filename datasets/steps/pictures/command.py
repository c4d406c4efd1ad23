"""``headbench inspect steps``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from ....bench.contracts import Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.specs import CommandResult, command
from ...options import CaptureOptions


@dataclass(frozen=True)
class StepsSettings(CaptureOptions):
    """Plot the jaw bases and expression clusters of a capture's training frames."""

    capture: tyro.conf.Positional[str]
    """Capture, in a layout that a reader knows."""

    out: str
    """Folder for jaw_bases.png, expression_clusters.png and steps.json."""

    bases: int = 16
    """Maximum number of jaw bases."""

    clusters: int = 16
    """Maximum number of expression clusters."""

    seed: int = 0
    """Seed of the choice of landmarks in long captures."""

    variant: Literal["paper", "official"] = "paper"
    """"official" shows the result of the published code: jaw bases from held-out poses (a leak, which is stated)."""


JAW_PICTURE, CLUSTER_PICTURE, NUMBERS = "jaw_bases.png", "expression_clusters.png", "steps.json"


@command("inspect steps", group="inspect", writes="out")
def steps(settings: StepsSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot the jaw bases and expression clusters of a capture's training frames.

    Raises `InputError` for a capture that the reader refuses, for counts below 1, and for a head without a face
    region.
    """
    from ...images import write_image
    from ..clusters import cluster_expressions
    from ..figures import draw_clusters, draw_jaw_bases, find_jaw_bases

    for name in ("bases", "clusters"):
        if getattr(settings, name) < 1:
            raise InputError(f"--{name}", "", "at least 1", str(getattr(settings, name)))
    clip = settings.open(settings.capture, progress)
    jaws = find_jaw_bases(clip, settings.bases, variant=settings.variant)
    clusters = cluster_expressions(
        clip, settings.clusters, seed=settings.seed, variant=settings.variant, progress=progress
    )
    out = Path(settings.out)
    write_image(out / JAW_PICTURE, draw_jaw_bases(clip, jaws))
    write_image(out / CLUSTER_PICTURE, draw_clusters(clip, clusters, progress))
    data = {
        "subject": clip.subject,
        "clip": clip.fingerprint,
        "jaw_bases": jaws.record(),
        "expression_clusters": clusters.record(),
    }
    write_json(out / NUMBERS, data)
    sizes = np.sort(np.bincount(clusters.labels))[::-1]
    lines = [
        f"subject {clip.subject}, {len(clusters.timesteps)} training timesteps",
        (
            f"{len(jaws.bases)} jaw bases, opening up to {jaws.angles[:, 0].max():.1f}°; "
            f"every training pose has one within {jaws.largest_gap:.1f}°"
        ),
        f"{len(sizes)} expression clusters of {', '.join(map(str, sizes))} timesteps",
        *(f"Leak: {note}" for note in jaws.record()["leaks"]),
        f"Pictures: {out / JAW_PICTURE}, {out / CLUSTER_PICTURE}",
    ]
    return CommandResult("\n".join(lines), data)
