"""Results of a suite's avatars in new poses and views, from the records of ``headbench run extremes`` in its runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from ...bench.experiments.specs import RECORD_FILE
from ...bench.io.documents import read_json
from ..writers import pipe_table

FOLDER = "extremes"
KEPT = ("subject", "method", "seed", "frames", "frames_broken", "measures", "missing", "no_truth")
"""Parts of an avatar's record used in the table."""


def read_extremes(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """Records of all avatars of some runs; none for a run without that test."""
    places = [run / FOLDER / RECORD_FILE for run in runs]
    found = [avatar for place in places if place.is_file() for avatar in read_json(place)["avatars"]]
    return [{name: avatar[name] for name in KEPT if name in avatar} for avatar in found]


def extremes_section(avatars: Sequence[Mapping[str, Any]]) -> str:
    """A table as Markdown: mean, worst value and failed frames of every measure by method; "" without avatars.

    A mean is over the frames of a subject, then over subjects; the worst value is that of any frame.
    """
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for avatar in avatars:
        by_method.setdefault(avatar["method"], []).append(avatar)
    rows: list[list[str]] = []
    notes: dict[str, None] = {}
    for method, own in by_method.items():
        for note in (avatar.get("missing") or avatar.get("no_truth") for avatar in own):
            if note:
                notes[f"`{method}`: {note}"] = None
        shown = [avatar for avatar in own if "missing" not in avatar]
        measures = dict.fromkeys(name for avatar in shown for name in avatar["measures"])
        for name in measures:
            found = [avatar["measures"][name] for avatar in shown if name in avatar["measures"]]
            means = [each["mean"] for each in found if each["mean"] is not None]
            worst = [(each["mean"] or 0.0, each["worst"]) for each in found if each["worst"] is not None]
            if not means or not worst:
                continue
            # If the worst value is the lowest, higher is better.
            lowest = sum(low <= mean for mean, low in worst) * 2 > len(worst)
            extreme = (min if lowest else max)(value for _, value in worst)
            counts = f"{sum(each['failed'] for each in found)} of {sum(each['frames'] for each in found)}"
            rows.append(
                [
                    method,
                    name.replace("_", " "),
                    str(len(means)),
                    f"{fmean(means):.3f}",
                    f"{extreme:.3f}",
                    counts,
                ]
            )
    if not rows:
        return ""
    lines = [["method", "measure", "subjects", "mean", "worst", "frames that exceed the limit"], ["---"] * 6]
    text = pipe_table([*lines, *rows])
    how = (
        "Joint samples of expression and jaw along the principal components of training, in views between and beyond the training "
        "cameras, against the path-traced person in the same pose and view (`headbench run extremes`)."
    )
    return "\n\n".join(
        ["## New poses and views (exploratory)", how, text, *(f"Missing: {note}" for note in notes)]
    )
