"""The section "Which method for a budget" of a page: choices, their costs, and the answer for each set within limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from ...bench.errors import InputError
from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ..recommend import (
    COST_TITLES,
    UNITS,
    Choices,
    RecommendSettings,
    against_always,
    best_by_cost,
    cost_text,
    held_out,
    outcome_on_left_out,
    read_choices,
    verdict_text,
)
from ..runs import RunData, RunSet
from ..statistics.comparisons import PairwiseTests

MOST_SETS = 4000
"""Maximum number of sets of choices with answers in a page."""


def budget_of(runs: RunSet, read: tuple[RunData, ...], marks: Mapping[str, int]) -> dict[str, Any]:
    """Content of the section for loaded runs (``read``), or the ``reason`` why it is empty; ``answers`` are for the script.

    Task and metric are those of `RecommendSettings`, or the first that the runs have. ``marks`` are numbers of marks by label.
    """
    tasks = [task for task in runs.tasks if all(task in run.tasks for run in read)]
    known = [{spec.name for spec in run.metrics} for run in read]
    metrics = [
        spec.name for spec in runs.metrics if spec.per_frame and all(spec.name in own for own in known)
    ]
    if not tasks or not metrics:
        return {"reason": "The runs have no task and metric of frames in common.", "answers": None}
    task = RecommendSettings.task if RecommendSettings.task in tasks else tasks[0]
    metric = RecommendSettings.metric if RecommendSettings.metric in metrics else metrics[0]
    try:
        found = read_choices(read, task, metric)
    except InputError as error:
        return {"reason": f"It takes {error.expected}; found: {error.found}.", "answers": None}
    subjects, spec = found.subjects, found.metric
    means = {label: fmean(choice.quality.values()) for label, choice in found.by_label.items()}
    # The first in case of ties, as in `best_of`.
    names = sorted(means, key=lambda label: -found.sign * means[label])
    costs = {
        cost: [
            max(own[cost].values()) if cost in own else None
            for own in (found.by_label[n].costs for n in names)
        ]
        for cost in found.measured
    }
    fronts = {
        cost: {label for _, label in best_by_cost(found.by_label, cost, subjects, found.sign)}
        for cost in costs
    }
    return {
        "reason": "",
        "task": TASK_TITLES.get(task, task).lower(),
        "options": f"--task {task} --metric {metric}",
        "metric": spec,
        "titles": COST_TITLES,
        "units": UNITS,
        "unmeasured": [title.lower() for cost, title in COST_TITLES.items() if cost not in costs],
        "rows": [
            {
                "label": label,
                "mark": marks.get(label),
                "quality": means[label],
                "costs": [
                    (values[index], _shown(values[index], label in fronts[cost]))
                    for cost, values in costs.items()
                ],
            }
            for index, label in enumerate(names)
        ],
        "left_out": _left_out(found, names[0]),
        "notes": [*found.notes, *(f"Left out: {each}." for each in found.without)],
        "subjects": counted(len(subjects), "subject"),
        "several": len(subjects) > 1,
        "answers": {
            "names": names,
            "costs": costs,
            "units": UNITS,
            **_answers(found, names, list(costs.values())),
        },
    }


def _shown(cost: float | None, marked: bool) -> str:
    return "–" if cost is None else f"{'◆ ' * marked}{cost_text(cost)}"


def _left_out(read: Choices, best: str) -> list[str]:
    """Accuracy of recommendations on left-out subjects, or the reason why it is unknown."""
    choices, subjects, sign = read.by_label, read.subjects, read.sign
    if len(subjects) < 2:
        unknown = "it is not known whether a recommendation holds for other people"
        return [f"The runs have one subject, so {unknown}: the test of it leaves out one subject at a time."]
    trials = held_out(choices, {}, subjects, sign)
    always = against_always(choices, read.measured, subjects, sign)
    first, *others = outcome_on_left_out(trials, always, best, read.metric)
    return [f"Without limits: {first[0].lower()}{first[1:]}", *others]


def _answers(
    read: Choices, names: Sequence[str], costs: Sequence[Sequence[float | None]]
) -> dict[str, list[str] | dict[str, int]]:
    """Statements on the best of each set of choices: ``sentences``, and the index of the sentence by set.

    A set is a number in hexadecimal digits whose bit i is 1 if it has the choice i. The largest sets come first if there are more
    than `MOST_SETS`.
    """
    qualities = {label: read.by_label[label].quality for label in names}
    tests = PairwiseTests.of(qualities, higher_is_better=read.metric.higher_is_better)
    sentences: dict[str, int] = {}
    sets = {}
    for bits in sorted(sets_within(len(names), costs), key=lambda bits: (-bits.bit_count(), bits))[
        :MOST_SETS
    ]:
        fitting = [label for index, label in enumerate(names) if bits >> index & 1]
        text = verdict_text(tests.best_set(fitting), fitting)
        sets[f"{bits:x}"] = sentences.setdefault(text, len(sentences))
    return {"sentences": list(sentences), "sets": sets}


def sets_within(count: int, costs: Sequence[Sequence[float | None]]) -> set[int]:
    """All non-empty sets of ``count`` choices that limits can produce; choice i is bit i.

    ``costs`` has, for each kind of cost, the cost of each choice; an unknown cost (None) exceeds every limit.
    """
    every = (1 << count) - 1
    found = {every}
    for own in costs:
        within = {every}
        for limit in {cost for cost in own if cost is not None}:
            within.add(sum(1 << i for i, cost in enumerate(own) if cost is not None and cost <= limit))
        found = {one & other for one in found for other in within}
    return found - {0}
