"""Recommends a method for a budget of training time, file size and frame time, from the rows of finished runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import tyro

from ..bench.contracts import Progress, no_progress
from ..bench.engine.scoring import FULL
from ..bench.errors import InputError
from ..bench.progress import counted
from ..bench.rows import ALL, Rows
from ..bench.specs import CommandResult, MetricSpec
from .aggregate import subject_means, whole_images
from .conditions import conditions, titled_note
from .pareto.points import pareto_front
from .runs import RunData, RunSet, training_labels
from .statistics.comparisons import BestSet, best_set
from .writers import pipe_table

COSTS = {
    "seconds": ("training_time", 60.0),
    "megabytes": ("storage", 1.0),
    "milliseconds": ("latency_p50", 1.0),
}
"""Metric of each cost, and its factor."""
COST_TITLES = {"seconds": "Training time", "megabytes": "Size", "milliseconds": "Frame time"}
OVERRUN = 1.05
"""A training with a limit of seconds counts as that limit if it took at most this many times as long, since the last
iteration and writing the avatar come after the limit."""
UNITS = {"seconds": "s of training", "megabytes": "MB", "milliseconds": "ms a frame"}


@dataclass(frozen=True)
class RecommendSettings:
    """The best method within a budget by the rows of finished runs, and methods that are not significantly worse.

    The choices are all methods, including those with other settings, with shorter trainings and with coded avatars. A choice
    fits if no subject and no seed exceeds a limit. Among those that fit, the one with the best mean over subjects is
    recommended. The recommendation is cross-validated over subjects.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs; runs of other subjects are joined."""

    seconds: float | None = None
    """Limit of the training time on the machine of the runs."""

    megabytes: float | None = None
    """Limit of the size of the avatar's files."""

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
    """A method under a condition: quality by subject, and costs by name and subject; a cost may be unknown."""

    quality: Mapping[str, float]
    costs: Mapping[str, Mapping[str, float]]

    def fits(self, limits: Mapping[str, float], subjects: Sequence[str]) -> bool:
        """Whether no subject exceeds a limit; an unknown cost exceeds every limit."""
        return all(
            name in self.costs and all(self.costs[name][subject] <= limit for subject in subjects)
            for name, limit in limits.items()
        )


@dataclass(frozen=True)
class Choices:
    """The choices of runs by label, the quality metric, omitted methods with reasons, and notes on times that are not
    comparable."""

    by_label: Mapping[str, Choice]
    metric: MetricSpec
    without: Sequence[str]
    notes: Sequence[str]

    @property
    def subjects(self) -> list[str]:
        """The subjects that all choices have."""
        return sorted(next(iter(self.by_label.values())).quality)

    @property
    def sign(self) -> float:
        """1 where a higher quality is better, else -1."""
        return 1.0 if self.metric.higher_is_better else -1.0

    @property
    def measured(self) -> list[str]:
        """The costs that at least one choice has."""
        return [cost for cost in COSTS if any(cost in each.costs for each in self.by_label.values())]


@dataclass(frozen=True)
class Trial:
    """The recommendation for a subject made without its rows: the choice, and its loss compared with the best one for the
    subject; None if the choice exceeds a limit there."""

    subject: str
    choice: str
    loss: float | None


def recommend(settings: RecommendSettings, progress: Progress = no_progress) -> CommandResult:
    """Recommend a method for a budget; see the settings.

    Raises `InputError` for runs that cannot be combined, for a task or metric that they lack, and if nothing fits.
    """
    limits = settings.limits
    runs = tuple(RunData.read(Path(run)) for run in settings.runs)
    read = read_choices(runs, settings.task, settings.metric, limits)
    choices, metric, subjects, sign = read.by_label, read.metric, read.subjects, read.sign
    fitting = {name: choice for name, choice in choices.items() if choice.fits(limits, subjects)}
    if not fitting:
        raise InputError("runs", "limits", f"a method within {_limits(limits)}", _nearest(choices, limits))
    best = best_of(fitting, subjects, sign)
    means = {name: choice.quality for name, choice in fitting.items()}
    found = best_set(means, higher_is_better=metric.higher_is_better)
    trials = held_out(choices, limits, subjects, sign)
    always = against_always(choices, list(limits) or read.measured, subjects, sign)
    data = {
        "recommended": best,
        "metric": metric.name,
        "task": settings.task,
        "limits": limits,
        "quality": fmean(fitting[best].quality.values()),
        "costs": {name: max(values.values()) for name, values in fitting[best].costs.items()},
        "not_told_apart": None if found.methods is None else sorted(found.methods - {best}),
        "subjects_needed": found.needed,
        "fitting": {name: fmean(choice.quality.values()) for name, choice in fitting.items()},
        "by_cost": {cost: best_by_cost(choices, cost, subjects, sign) for cost in COSTS},
        "held_out": trials,
        "against_always": always,
        "without": read.without,
        "conclusions": [
            verdict_text(found, [best, *(name for name in fitting if name != best)]),
            *outcome_on_left_out(trials, always, best, metric),
        ],
        "notes": read.notes,
    }
    return CommandResult(_text(data, fitting, found.subjects, metric), data)


def read_choices(
    runs: tuple[RunData, ...], task: str, metric_name: str, limits: Collection[str] = ()
) -> Choices:
    """The choices of runs that all subjects have; ``limits`` are the names of the costs that every choice must have.

    Conditions that change the training data are not choices. Raises `InputError` as `recommend` does.
    """
    together = RunSet.joined(runs)
    labels_of_runs = training_labels(runs)
    rows = Rows.joined([run.rows.renamed(own) for run, own in zip(runs, labels_of_runs)])
    quality: dict[str, dict[str, float]] = {}
    costs: dict[str, dict[str, dict[str, float]]] = {}
    everybody = rows.subjects
    spec = None
    for run, labels in zip(runs, labels_of_runs):
        folder = run.folder.root
        spec = next((each for each in run.metrics if each.name == metric_name and each.per_frame), None)
        if spec is None:
            known = ", ".join(each.name for each in run.metrics if each.per_frame)
            raise InputError(folder, "metric", f"a metric of frames: {known}", metric_name)
        if task not in run.tasks:
            raise InputError(folder, "task", ", ".join(run.tasks), task)
        conditions = {condition.name: condition for condition in run.manifest.configuration.conditions}
        for record in run.manifest.methods:
            condition = conditions.get(record.condition)
            changed = condition is not None and (
                condition.clip.name or condition.drive.name or condition.as_tracked
            )
            label = labels[record.label]
            if record.trivial or changed or label in quality:
                continue
            quality[label] = _quality(rows, label, metric_name, task)
            derived = condition is not None and condition.derive.name
            costs[label] = {}
            for cost, (name, factor) in COSTS.items():
                source = labels.get(record.name, "") if derived and cost == "seconds" else label
                found = {subject: factor * value for subject, value in _costs(rows, source, name).items()}
                if cost == "seconds":
                    limit = None if record.budget.get("iterations") else record.budget.get("seconds")
                    found = _within(found, limit)
                costs[label][cost] = found
    choices, without = {}, []
    for label, values in quality.items():
        if set(values) != everybody:
            without.append(f"{label}: no {metric_name} of {counted(len(everybody - set(values)), 'subject')}")
            continue
        unknown = {name: len(everybody - set(costs[label][name])) for name in limits}
        without += [
            f"{label}: no measured {name} of {counted(n, 'subject')}" for name, n in unknown.items() if n
        ]
        choices[label] = Choice(
            values, {name: own for name, own in costs[label].items() if set(own) >= everybody}
        )
    if spec is None or not choices:
        found_instead = "; ".join(without) or "none"
        raise InputError("runs", "methods", "a method with values of every subject", found_instead)
    return Choices(choices, spec, without, _time_notes(rows, together.metrics, list(choices)))


def best_of(choices: Mapping[str, Choice], subjects: Sequence[str], sign: float) -> str:
    """The choice with the best mean over some subjects; the first in case of ties."""
    return max(choices, key=lambda name: sign * fmean(choices[name].quality[subject] for subject in subjects))


def best_by_cost(
    choices: Mapping[str, Choice], cost: str, subjects: Sequence[str], sign: float
) -> list[tuple[float, str]]:
    """The Pareto front of quality and cost (the largest over subjects), by increasing cost; unknown costs are left out."""
    known = [name for name, each in choices.items() if cost in each.costs]
    at = [max(choices[name].costs[cost][subject] for subject in subjects) for name in known]
    means = [sign * fmean(choices[name].quality[subject] for subject in subjects) for name in known]
    return [(at[index], known[index]) for index in pareto_front(at, means)]


def held_out(
    choices: Mapping[str, Choice], limits: Mapping[str, float], subjects: Sequence[str], sign: float
) -> list[Trial]:
    """The recommendation for each subject from the rows of the others; empty for a single subject."""
    trials = []
    for subject in subjects:
        others = [each for each in subjects if each != subject]
        fitting = {name: each for name, each in choices.items() if each.fits(limits, others)}
        if not others or not fitting:
            continue
        taken = best_of(fitting, others, sign)
        loss = None
        if choices[taken].fits(limits, [subject]):
            possible = [each.quality[subject] for each in choices.values() if each.fits(limits, [subject])]
            loss = max(sign * value for value in possible) - sign * choices[taken].quality[subject]
        trials.append(Trial(subject, taken, loss))
    return trials


def against_always(
    choices: Mapping[str, Choice], costs: Sequence[str], subjects: Sequence[str], sign: float
) -> dict[str, Any] | None:
    """Gain of recommendations over one fixed choice for all budgets, on left-out subjects.

    Budgets are the largest costs of each choice over the other subjects. The fixed choice is the best on average; if it does
    not fit, the choice that fits most budgets replaces it. Budgets that either choice exceeds on the subject are left out.
    None with fewer than two subjects or without costs.
    """
    known = {name: each for name, each in choices.items() if set(costs) <= set(each.costs)}
    if len(subjects) < 2 or not costs or not known:
        return None
    gains: dict[str, float] = {}
    exceeded = 0
    for subject in subjects:
        others = [each for each in subjects if each != subject]
        budgets = [
            {c: max(each.costs[c][other] for other in others) for c in costs} for each in known.values()
        ]
        fits = {name: [each.fits(budget, others) for budget in budgets] for name, each in known.items()}
        always = best_of(known, others, sign)
        spare = max(fits, key=lambda name: sum(fits[name]))
        own = []
        for index, budget in enumerate(budgets):
            taken = best_of({n: each for n, each in known.items() if fits[n][index]}, others, sign)
            usual = always if fits[always][index] else spare
            if not fits[usual][index]:
                continue
            if known[taken].fits(budget, [subject]) and known[usual].fits(budget, [subject]):
                own.append(sign * (known[taken].quality[subject] - known[usual].quality[subject]))
            else:
                exceeded += 1
        if own:
            gains[subject] = fmean(own)
    return {
        "always": best_of(known, subjects, sign),
        "budgets": len(known),
        "gains": gains,
        "exceeded": exceeded,
    }


def _quality(rows: Rows, label: str, metric: str, task: str) -> dict[str, float]:
    """Mean of each subject whose frames all have a value, except frames that the metric left out for every method."""
    found = whole_images(rows, label, metric, task)
    if found.empty:
        return {}
    frames = Counter(subject for subject, *_ in rows.frames(task, FULL))
    given = Counter(rows.select(method=label, metric=metric, task=task, region=FULL, seeds=ALL)["subject"])
    whole = {
        subject
        for subject, own in found.groupby("subject")
        if (own["status"] == "ok").all()
        and given[str(subject)] == frames[str(subject)] * own["seed"].nunique()
    }
    kept = found[found["subject"].isin(whole)]
    return subject_means(kept) if len(kept) else {}


def _costs(rows: Rows, label: str, metric: str) -> dict[str, float]:
    """Largest value over the seeds, for each subject with values for all seeds."""
    found = rows.select(method=label, metric=metric, task="", region=FULL, seeds=ALL)
    return {
        str(subject): float(own["value"].max())
        for subject, own in found.groupby("subject")
        if (own["status"] == "ok").all()
    }


def _within(seconds: Mapping[str, float], limit: float | None) -> dict[str, float]:
    """Training times by subject; replaced by the training's limit if they exceed it by at most `OVERRUN`."""
    most = 0.0 if limit is None else OVERRUN * limit
    return {s: min(value, limit) if limit and value <= most else value for s, value in seconds.items()}


def _time_notes(rows: Rows, metrics: Sequence[MetricSpec], labels: Sequence[str]) -> list[str]:
    """A note for each cost whose values are not comparable, see `titled_note`."""
    found = conditions(rows, metrics, labels)
    notes = (titled_note(COST_TITLES[cost], found.get(name, {})) for cost, (name, _) in COSTS.items())
    return [note for note in notes if note]


def cost_text(value: float) -> str:
    """Format a cost with three digits."""
    return f"{float(f'{value:.3g}'):g}"


def _limits(limits: Mapping[str, float]) -> str:
    return " and ".join(f"{limit:g} {UNITS[name]}" for name, limit in limits.items()) or "no limit"


def _nearest(choices: Mapping[str, Choice], limits: Mapping[str, float]) -> str:
    """The choice that exceeds the limits by the smallest factor, in words."""
    known = {
        label: {name: max(each.costs[name].values()) for name in limits}
        for label, each in choices.items()
        if set(limits) <= set(each.costs)
    }
    if not known:
        return f"none with measured {' and '.join(limits)}"
    label = min(known, key=lambda label: max(known[label][name] / limit for name, limit in limits.items()))
    needs = " and ".join(f"{cost_text(value)} {UNITS[name]}" for name, value in known[label].items())
    return f"{label} nearest, with {needs}"


def _text(data: Mapping[str, Any], fitting: Mapping[str, Choice], subjects: int, metric: MetricSpec) -> str:
    unit = f" {metric.unit}" if metric.unit else ""
    limits, best = data["limits"], data["recommended"]
    task = str(data["task"]).replace("_", " ")
    lines = [["method", f"{metric.label}{unit}", *(UNITS[name] for name in COSTS)], [":--", *["--:"] * 4]]
    sign = 1.0 if metric.higher_is_better else -1.0
    for name in sorted(fitting, key=lambda name: -sign * fmean(fitting[name].quality.values())):
        costs = fitting[name].costs
        shown = [cost_text(max(costs[cost].values())) if cost in costs else "–" for cost in COSTS]
        lines.append([name, f"{fmean(fitting[name].quality.values()):.{metric.digits}f}", *shown])
    parts = [
        f"Recommended for {_limits(limits)}: {best}. Mean over {counted(subjects, 'subject')}, {task}; costs are maxima over subjects.",
        pipe_table(lines),
    ]
    by_cost = data["by_cost"]
    parts += [
        f"By {UNITS[cost]} alone, all choices: {', '.join(f'{name} from {cost_text(at)}' for at, name in steps)}."
        for cost, steps in by_cost.items()
        if steps
    ]
    parts += [*data["conclusions"], *data["notes"]]
    without = data["without"]
    return "\n\n".join([*parts, *(f"Left out: {each}." for each in without)])


def verdict_text(found: BestSet, fitting: Collection[str]) -> str:
    """A sentence on the choices that fit, the one with the best mean first."""
    if len(fitting) == 1:
        return "It is the only choice within the limits."
    if found.methods is None:
        there = f"there {'is' if found.subjects == 1 else 'are'} {found.subjects}"
        return f"A test of these methods needs {found.needed} subjects; {there}."
    if alike := sorted(found.methods - {next(iter(fitting))}):
        return f"Not significantly worse (sign-flip tests, Holm, 5 %): {', '.join(alike)}."
    return "All other choices within the limits are significantly worse (sign-flip tests, Holm, 5 %)."


def outcome_on_left_out(
    trials: Sequence[Trial], always: Mapping[str, Any] | None, best: str, metric: MetricSpec
) -> list[str]:
    """The results of `held_out` and `against_always` in sentences; ``best`` is the recommendation from all subjects."""
    unit = f" {metric.unit}" if metric.unit else ""
    parts = []
    if trials:
        same = sum(trial.choice == best for trial in trials)
        losses = [trial.loss for trial in trials if trial.loss is not None]
        behind = (
            f"on average {fmean(losses):.{metric.digits}f}{unit} behind"
            if losses
            else "never within the limits, and therefore not compared with"
        )
        parts.append(
            f"Cross-validation over subjects: the same recommendation for {same} of {len(trials)}, {behind} "
            f"the best choice for the subject; a limit was exceeded for {len(trials) - len(losses)}."
        )
    if always is not None and always["gains"]:
        sign = 1.0 if metric.higher_is_better else -1.0
        gains = [sign * gain for gain in always["gains"].values()]
        spread = f"from {min(gains):+.{metric.digits}f} to {max(gains):+.{metric.digits}f} by subject"
        parts.append(
            f"Over the budgets of the {always['budgets']} choices, recommendations change {metric.label} by "
            f"{fmean(gains):+.{metric.digits}f}{unit} on left-out subjects ({spread}), compared with always using the method that is "
            f"best on average ({always['always']}), or the cheapest choice where that exceeds the budget."
        )
    return parts
