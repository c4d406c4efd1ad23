"""Which method to take for a budget of training time, file size and frame time, from the rows of finished runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import tyro

from ..bench.contracts import Progress, no_progress
from ..bench.engine.scoring import FULL
from ..bench.errors import InputError
from ..bench.rows import ALL, Rows
from ..bench.specs import CommandResult, MetricSpec
from .aggregate import subject_means
from .runs import RunData, RunSet
from .statistics.comparisons import best_set, sign_flip_p
from .writers import pipe_table

COSTS = {
    "seconds": ("training_time", 60.0),
    "megabytes": ("storage", 1.0),
    "milliseconds": ("latency_p50", 1.0),
}
"""Metric of each cost, and its factor."""


@dataclass(frozen=True)
class RecommendSettings:
    """The best method within a budget, as far as finished runs show it, and how sure that is.

    Every method is a choice, also with other settings, with a part of the training, and coded. A choice fits if no subject
    exceeds a limit. Among those that fit, the one with the best mean over subjects is recommended. The answer is tested on each
    subject with the rows of the others.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs; runs of other subjects are joined."""

    seconds: float | None = None
    """Limit of the training time on the machine of the runs."""

    megabytes: float | None = None
    """Limit of the avatar's files."""

    milliseconds: float | None = None
    """Limit of the median time of a frame on the machine of the runs."""

    task: str = "self_reenactment"
    """Task whose frames give the quality."""

    metric: str = "psnr"
    """Metric of quality."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        for name in COSTS:
            limit = getattr(self, name)
            if limit is not None and not limit > 0:
                raise ValueError(f"{name} must be above 0, found {limit}")

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are given, by name."""
        return {name: limit for name in COSTS if (limit := getattr(self, name)) is not None}


@dataclass(frozen=True)
class Choice:
    """A method under a condition: by subject its quality, and by cost and subject what it takes; a cost may be unknown."""

    quality: Mapping[str, float]
    costs: Mapping[str, Mapping[str, float]]

    def fits(self, limits: Mapping[str, float], subjects: Sequence[str]) -> bool:
        """Whether no subject exceeds a limit; an unknown cost exceeds every limit."""
        return all(
            name in self.costs and all(self.costs[name][subject] <= limit for subject in subjects)
            for name, limit in limits.items()
        )


@dataclass(frozen=True)
class Trial:
    """The recommendation for a subject without its rows: the choice, its loss against the best one for the subject, and whether
    it exceeds a limit there."""

    subject: str
    choice: str
    loss: float
    exceeds: bool


def recommend(settings: RecommendSettings, progress: Progress = no_progress) -> CommandResult:
    """Recommend a method for a budget; see the settings.

    Raises `InputError` for runs that do not belong together, for a task or metric that they lack, and where nothing fits.
    """
    choices, metric, without = read_choices(
        [Path(run) for run in settings.runs], settings.task, settings.metric
    )
    subjects = sorted(next(iter(choices.values())).quality)
    limits, sign = settings.limits, 1.0 if metric.higher_is_better else -1.0
    fitting = {name: choice for name, choice in choices.items() if choice.fits(limits, subjects)}
    if not fitting:
        raise InputError("runs", "limits", f"a method within {_limits(limits)}", _least(choices, limits))
    best = best_of(fitting, subjects, sign)
    means = {name: dict(choice.quality) for name, choice in fitting.items()}
    alike: frozenset[str] | None = frozenset([best])
    needed = 0
    if len(fitting) > 1:
        found = best_set(means, higher_is_better=metric.higher_is_better)
        alike, needed = found.methods, found.needed
    trials = held_out(choices, limits, subjects, sign)
    always = against_always(choices, list(limits) or list(COSTS), subjects, sign)
    data = {
        "recommended": best,
        "metric": metric.name,
        "task": settings.task,
        "limits": limits,
        "quality": fmean(fitting[best].quality.values()),
        "costs": {name: max(values.values()) for name, values in fitting[best].costs.items()},
        "not_told_apart": None if alike is None else sorted(alike - {best}),
        "subjects_needed": needed,
        "fitting": {name: fmean(choice.quality.values()) for name, choice in fitting.items()},
        "held_out": trials,
        "against_always": always,
        "without": without,
    }
    return CommandResult(_text(data, fitting, subjects, metric), data)


def read_choices(
    folders: Sequence[Path], task: str, metric_name: str
) -> tuple[dict[str, Choice], MetricSpec, list[str]]:
    """The choices of runs that all subjects have, the metric of quality, and what was left out with the reason.

    Conditions that change what a method is trained on are no choices. Raises `InputError` as `recommend` does.
    """
    RunSet.read(folders)  # whether they belong together
    quality: dict[str, dict[str, float]] = {}
    costs: dict[str, dict[str, dict[str, float]]] = {}
    without: list[str] = []
    everybody: set[str] = set()
    spec = None
    for folder in folders:
        run = RunData.read(folder)
        spec = next((each for each in run.metrics if each.name == metric_name and each.per_frame), None)
        if spec is None:
            known = ", ".join(each.name for each in run.metrics if each.per_frame)
            raise InputError(folder, "metric", f"a metric of frames: {known}", metric_name)
        if task not in run.tasks:
            raise InputError(folder, "task", ", ".join(run.tasks), task)
        everybody |= set(run.rows.subjects)
        conditions = {condition.name: condition for condition in run.manifest.configuration.conditions}
        for record in run.manifest.methods:
            condition = conditions.get(record.condition)
            changed = condition is not None and (
                condition.clip.name or condition.drive.name or condition.as_tracked
            )
            if record.trivial or changed:
                continue
            label = record.label
            quality.setdefault(label, {}).update(_by_subject(run.rows, label, metric_name, task))
            derived = condition is not None and condition.derive.name
            for cost, (name, factor) in COSTS.items():
                source = record.name if derived and cost == "seconds" else label
                found = _by_subject(run.rows, source, name, "")
                own = costs.setdefault(label, {}).setdefault(cost, {})
                own.update({subject: factor * value for subject, value in found.items()})
    choices = {}
    for label, values in quality.items():
        if set(values) != everybody:
            without.append(f"{label}: no {metric_name} of {len(everybody - set(values))} subjects")
            continue
        known_costs = {name: own for name, own in costs[label].items() if set(own) >= everybody}
        choices[label] = Choice(values, known_costs)
    if spec is None or not choices:
        raise InputError(
            "runs", "methods", "a method with values of every subject", "; ".join(without) or "none"
        )
    return choices, spec, without


def best_of(choices: Mapping[str, Choice], subjects: Sequence[str], sign: float) -> str:
    """The choice with the best mean over some subjects; the first of equal ones."""
    return max(choices, key=lambda name: sign * fmean(choices[name].quality[subject] for subject in subjects))


def held_out(
    choices: Mapping[str, Choice], limits: Mapping[str, float], subjects: Sequence[str], sign: float
) -> list[Trial]:
    """What would be recommended for each subject from the rows of the others; none with a single subject."""
    trials = []
    for subject in subjects:
        others = [each for each in subjects if each != subject]
        fitting = {name: each for name, each in choices.items() if each.fits(limits, others)}
        possible = [each for each in choices.values() if each.fits(limits, [subject])]
        if not others or not fitting or not possible:
            continue
        taken = best_of(fitting, others, sign)
        loss = max(sign * each.quality[subject] for each in possible) - sign * choices[taken].quality[subject]
        trials.append(Trial(subject, taken, loss, not choices[taken].fits(limits, [subject])))
    return trials


def against_always(
    choices: Mapping[str, Choice], costs: Sequence[str], subjects: Sequence[str], sign: float
) -> dict[str, object] | None:
    """Whether following recommendations is better than one choice for all budgets, on subjects that were left out.

    Budgets are the largest costs of each choice. The one choice is the best on average among those that fit the most budgets.
    Quality is compared over the budgets that it fits; None with fewer than two subjects or without costs.
    """
    known = {name: each for name, each in choices.items() if set(costs) <= set(each.costs)}
    if len(subjects) < 2 or not known:
        return None
    budgets = [{cost: max(each.costs[cost].values()) for cost in costs} for each in known.values()]
    gains, names = [], []
    for subject in subjects:
        others = [each for each in subjects if each != subject]
        fits = {name: [b for b in budgets if each.fits(b, others)] for name, each in known.items()}
        most = max(len(own) for own in fits.values())
        always = best_of({n: known[n] for n, own in fits.items() if len(own) == most}, others, sign)
        names.append(always)
        followed = [
            best_of({n: each for n, each in known.items() if each.fits(budget, others)}, others, sign)
            for budget in fits[always]
        ]
        own = [sign * known[name].quality[subject] for name in followed]
        gains.append(fmean(own) - sign * known[always].quality[subject])
    return {
        "always": max(set(names), key=names.count),
        "budgets": len(budgets),
        "gain": fmean(gains),
        "p": sign_flip_p(gains),
    }


def _by_subject(rows: Rows, label: str, metric: str, task: str) -> dict[str, float]:
    """Mean of each subject whose values are all there."""
    found = rows.select(method=label, metric=metric, task=task, region=FULL, seeds=ALL)
    whole = found.groupby("subject")["status"].agg(lambda column: bool((column == "ok").all()))
    kept = found[found["subject"].isin(whole.index[whole])] if len(found) else found
    return subject_means(kept) if len(kept) else {}


UNITS = {"seconds": "s of training", "megabytes": "MB", "milliseconds": "ms a frame"}


def _limits(limits: Mapping[str, float]) -> str:
    return " and ".join(f"{limit:g} {UNITS[name]}" for name, limit in limits.items()) or "no limit"


def _least(choices: Mapping[str, Choice], limits: Mapping[str, float]) -> str:
    """The lowest cost of each limited kind, in words."""
    parts = []
    for name in limits:
        known = {
            label: max(each.costs[name].values()) for label, each in choices.items() if name in each.costs
        }
        if known:
            label = min(known, key=known.__getitem__)
            parts.append(f"at least {known[label]:.3g} {UNITS[name]} ({label})")
        else:
            parts.append(f"no measured {name}")
    return ", ".join(parts)


def _text(
    data: Mapping[str, object], fitting: Mapping[str, Choice], subjects: Sequence[str], metric: MetricSpec
) -> str:
    unit = f" {metric.unit}" if metric.unit else ""
    limits, best = data["limits"], data["recommended"]
    assert isinstance(limits, dict)
    assert isinstance(best, str)
    task = str(data["task"]).replace("_", " ")
    lines = [["method", f"{metric.label}{unit}", *(UNITS[name] for name in COSTS)], [":--", *["--:"] * 4]]
    sign = 1.0 if metric.higher_is_better else -1.0
    for name in sorted(fitting, key=lambda name: -sign * fmean(fitting[name].quality.values())):
        costs = fitting[name].costs
        shown = [f"{max(costs[cost].values()):.3g}" if cost in costs else "–" for cost in COSTS]
        lines.append([name, f"{fmean(fitting[name].quality.values()):.{metric.digits}f}", *shown])
    parts = [
        f"Recommended for {_limits(limits)}: {best}. Mean over {len(subjects)} subjects, {task}; costs are the largest of a subject.",
        pipe_table(lines),
    ]
    alike = data["not_told_apart"]
    if alike is None:
        parts.append(
            f"{len(subjects)} subjects are too few to tell these methods apart: {data['subjects_needed']} are needed."
        )
    elif alike:
        assert isinstance(alike, list)
        parts.append(f"Not told apart from it (sign-flip tests, Holm, 5 %): {', '.join(alike)}.")
    else:
        parts.append("No other method that fits can be the best (sign-flip tests, Holm, 5 %).")
    trials = data["held_out"]
    assert isinstance(trials, list)
    if trials:
        same, exceeding = sum(t.choice == best for t in trials), sum(t.exceeds for t in trials)
        loss = fmean(t.loss for t in trials)
        parts.append(
            f"On each subject from the rows of the others: the same recommendation for {same} of {len(trials)}, on average "
            f"{loss:.{metric.digits}f}{unit} behind the best choice for the subject, beyond a limit for {exceeding}."
        )
    always = data["against_always"]
    if isinstance(always, dict):
        parts.append(
            f"Over {always['budgets']} budgets, those of the choices, recommendations are {always['gain']:+.{metric.digits}f}{unit} "
            f"better than always {always['always']} on subjects that were left out (p = {always['p']:.2g})."
        )
    without = data["without"]
    assert isinstance(without, list)
    return "\n\n".join([*parts, *(f"Left out: {each}." for each in without)])
