"""Training losses recorded with avatars, as curves."""

from __future__ import annotations

from typing import Any

from ...bench.engine.stored import training_losses
from ...bench.errors import InputError
from ..runs import RunSet

Curve = list[tuple[int, float]]


def loss_curves(runs: RunSet) -> list[dict[str, Any]]:
    """For each method that recorded positive losses: its index among the methods, and iterations with losses.

    Losses are divided by the first recorded one, and averaged over the subjects that recorded the same iterations as the
    first; seeds are those of the pictures. Damaged records are ignored.
    """
    found = []
    for index, label in enumerate(runs.methods):
        run, name = runs.shown[label]
        curves = []
        for clip in run.manifest.clips:
            try:
                losses = training_losses(run.folder.cell(clip.subject, name, run.seed).avatar)
            except (InputError, OSError):
                losses = []
            if len(losses) > 1 and all(value > 0 for _, value in losses):
                curves.append([(at, value / losses[0][1]) for at, value in losses])
        if curves:
            found.append({"method": index, "points": _mean(curves)})
    return found


def _mean(curves: list[Curve]) -> Curve:
    iterations = [at for at, _ in curves[0]]
    alike = [curve for curve in curves if [at for at, _ in curve] == iterations]
    return [
        (at, float(f"{sum(curve[i][1] for curve in alike) / len(alike):.4g}"))
        for i, at in enumerate(iterations)
    ]
