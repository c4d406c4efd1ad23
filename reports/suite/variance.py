"""Variation of results between subjects, and between trainings of one subject that differ only in their seed."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from statistics import fmean, stdev, variance

from ...bench.protocol import TASK_TITLES
from ...bench.rows import ALL
from ..aggregate import means_by_seed, whole_images
from ..runs import RunSet
from ..writers import pipe_table

METRIC = "psnr"


def variance_section(runs: RunSet, pair: tuple[str, str]) -> str:
    """A table of standard deviations as Markdown, a row for each method and task and for the difference of ``pair``; "" with one seed.

    Between subjects: of the means over seeds. Within subjects: of seeds about the mean of their subject, pooled over subjects
    (the square root of the mean variance). Subjects without all seeds are left out.
    """
    runs = runs.by_camera
    spec = next((spec for spec in runs.metrics if spec.name == METRIC), None)
    if spec is None or len(runs.rows.seeds(ALL)) < 2:
        return ""
    lines = [
        ["", "task", "subjects", "seeds", f"mean ({spec.unit})", "SD between subjects", "SD within subjects"]
    ]
    lines.append(["---"] * len(lines[0]))
    for task in runs.tasks:
        values = {
            method: means_by_seed(whole_images(runs.rows, method, METRIC, task)) for method in runs.ranked
        }
        if {*pair} <= {*values}:
            values[f"{pair[0]} - {pair[1]}"] = difference_by_seed(values, pair)
        for name, by_seed in values.items():
            if found := components(by_seed):
                subjects, mean, between, within = found
                shown = f"{mean:+.2f}" if name not in runs.ranked else f"{mean:.2f}"
                counts = [str(subjects), str(len(by_seed))]
                title = TASK_TITLES.get(task, task)
                lines.append([name, title, *counts, shown, f"{between:.3f}", f"{within:.3f}"])
    table = pipe_table(lines)
    how = (
        "Standard deviations: between subjects, of the means over seeds; within subjects, over seeds, pooled. "
        "Differences are between trainings with the same seed."
    )
    return f"## Variance between and within subjects (exploratory)\n\n{table}\n\n{how}"


def difference_by_seed(
    values: Mapping[str, Mapping[int, Mapping[str, float]]], pair: tuple[str, str]
) -> dict[int, dict[str, float]]:
    """First minus second of a pair by seed and subject."""
    first, second = (values[name] for name in pair)
    return {
        seed: {s: first[seed][s] - second[seed][s] for s in first[seed].keys() & second[seed].keys()}
        for seed in first.keys() & second.keys()
    }


def components(by_seed: Mapping[int, Mapping[str, float]]) -> tuple[int, float, float, float] | None:
    """Number of subjects with every seed, mean, standard deviations between and within; None with fewer than two of either."""
    subjects = sorted(set.intersection(*(set(means) for means in by_seed.values()))) if by_seed else []
    if len(by_seed) < 2 or len(subjects) < 2:
        return None
    values = {subject: [means[subject] for means in by_seed.values()] for subject in subjects}
    centres = [fmean(own) for own in values.values()]
    within = sqrt(fmean(variance(own) for own in values.values()))
    return len(subjects), fmean(centres), stdev(centres), within
