"""``headbench steps``: what the steps before training make of a capture, as pictures and numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ....bench.contracts import Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.specs import Findings
from ...ga.reader import read_capture
from ...ga.writer import write_png
from ..expression_clusters import cluster_expressions
from .class_figure import draw_classes
from .jaw_figure import draw_jaw_bases, find_jaw_bases
from .settings import StepsSettings

JAW_PICTURE, CLASS_PICTURE, NUMBERS = "jaw_bases.png", "expression_classes.png", "steps.json"


def run(settings: StepsSettings, progress: Progress = no_progress) -> Findings:
    """Find jaw bases and expression classes of a capture, draw them, write pictures and numbers.

    Raises `InputError` for a capture that the reader refuses, for counts below 1, and for a head without a face
    region.
    """
    for name in ("bases", "classes"):
        if getattr(settings, name) < 1:
            raise InputError(f"--{name}", "", "at least 1", str(getattr(settings, name)))
    clip = read_capture(settings.capture, head=settings.head, leaks="record", progress=progress)
    jaws = find_jaw_bases(clip, settings.bases, variant=settings.variant)
    clusters = cluster_expressions(
        clip, settings.classes, seed=settings.seed, variant=settings.variant, progress=progress
    )
    out = Path(settings.out)
    write_png(out / JAW_PICTURE, draw_jaw_bases(clip, jaws))
    write_png(out / CLASS_PICTURE, draw_classes(clip, clusters, progress))
    data = {
        "subject": clip.subject,
        "clip": clip.fingerprint,
        "jaw_bases": jaws.record(),
        "expression_classes": clusters.record(),
    }
    write_json(out / NUMBERS, data)
    sizes = np.sort(np.bincount(clusters.labels))[::-1]
    lines = [
        f"subject {clip.subject}, {len(clusters.timesteps)} training timesteps",
        (
            f"{len(jaws.bases)} jaw bases, opening up to {jaws.angles[:, 0].max():.1f}°; "
            f"every training pose has one within {jaws.largest_gap:.1f}°"
        ),
        f"{len(sizes)} expression classes of {', '.join(map(str, sizes))} timesteps",
        *(f"Leak: {note}" for note in jaws.record()["leaks"]),
        f"Pictures: {out / JAW_PICTURE}, {out / CLASS_PICTURE}",
    ]
    return Findings("\n".join(lines), data)
