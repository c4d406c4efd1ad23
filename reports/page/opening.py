"""The first images of a page: the best methods, in the frame in which they differ most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...bench.specs import MetricSpec
from ..runs import RunSet
from .frames import Pictures, ShownFrame

TILES = 3
"""Number of methods next to the ground truth, so that four images fill a window."""


@dataclass(frozen=True)
class Opening:
    """Labels of the methods shown, best first, and the frame."""

    methods: tuple[str, ...]
    frame: ShownFrame | None


def opening(
    runs: RunSet,
    best: Sequence[str],
    metrics: Sequence[MetricSpec],
    values: Mapping[tuple[str, str, ShownFrame], float],
    pictures: Pictures,
) -> Opening:
    """Choose from the images of a page.

    ``best`` are the ranked methods, best first. The frame is that of the first task, with images of all displayed methods, in
    which values of the first metric differ most; if there is none, the first frame with any image.
    """
    place = {label: index + 1 for index, label in enumerate(runs.methods)}
    drawn = {
        label for label in place for images in pictures.shown.values() if images[place[label]] is not None
    }
    offered = [label for label in (*best, *runs.ranked, *runs.methods) if label in drawn]
    chosen = tuple(dict.fromkeys(offered))[:TILES] or (*best, *runs.methods)[:TILES]
    spreads: dict[ShownFrame, float] = {}
    for frame, images in sorted(pictures.shown.items()):
        own = [values.get((metrics[0].name, label, frame)) for label in chosen] if metrics else []
        known = [value for value in own if value is not None]
        complete = all(images[index] is not None for index in (0, *(place[label] for label in chosen)))
        if complete and known and len(known) == len(chosen) and frame.task == runs.tasks[0]:
            spreads[frame] = max(known) - min(known)
    if spreads:
        return Opening(chosen, max(spreads, key=lambda frame: spreads[frame]))
    first = (f for f in sorted(pictures.shown) if any(image is not None for image in pictures.shown[f]))
    return Opening(chosen, next(first, None))
