"""The head of a page: title, one sentence for each task and for costs, what they do not show, and what was compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from markupsafe import Markup

from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ...bench.specs import MetricSpec
from ..aggregate import summarise
from ..pareto.points import SIZE, SPEED
from ..runs import RunSet
from ..statistics.comparisons import subjects_needed
from ..statistics.paired import LEVEL

NAMED = 3
"""Maximum number of methods named in a title."""


@dataclass
class Conclusions:
    """Texts of the head of a page; ``sentences`` are HTML."""

    title: str
    sentences: list[Markup] = field(default_factory=list)
    limit: str = ""
    facts: list[tuple[str, str]] = field(default_factory=list)


def verdict(
    runs: RunSet, metrics: Sequence[MetricSpec], comparisons: Sequence[Mapping[str, Any]]
) -> Conclusions:
    """Describe the results of the ranked methods.

    Parameters
    ----------
    metrics : Sequence[MetricSpec]
        Metrics of frames; sentences are on the first.
    comparisons : Sequence[Mapping[str, Any]]
        Those of `compare_methods`.
    """
    found = Conclusions(_title(runs), facts=_facts(runs))
    methods = runs.ranked
    for task in runs.by_camera.tasks if metrics else ():
        if scores := _scores(runs.by_camera, methods, metrics[0], task):
            found.sentences.append(_sentence(scores, metrics[0], task, comparisons))
    found.sentences += _costs(runs, methods)
    if len(methods) > 1:
        pairs, subjects = len(methods) * (len(methods) - 1) // 2, len(runs.rows.subjects)
        needed = subjects_needed(LEVEL, pairs)
        found.limit = (
            f"{counted(subjects, 'subject')} cannot show which method is better: a test of {counted(pairs, 'pair')} needs {needed}."
            if subjects < needed
            else f"Exact sign-flip test over {subjects} subjects, Holm’s correction, level {LEVEL:.0%}. It applies to subjects of "
            "captures like these, not to other captures, resolutions or training budgets. “Not significant” does not mean equal."
        )
    return found


def _title(runs: RunSet) -> str:
    """The methods, or their number, and the subjects."""
    names, subjects = runs.ranked or runs.methods, sorted(runs.rows.subjects)
    methods = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    if len(names) > NAMED:
        methods = f"{len(names)} {'avatar methods' if runs.ranked else 'baselines'}"
    where = f"subject {subjects[0]}" if len(subjects) == 1 else f"{len(subjects)} subjects"
    return f"{methods} on {where}"


def _scores(runs: RunSet, names: Sequence[str], spec: MetricSpec, task: str) -> list[tuple[str, float]]:
    """Methods with their means, best first."""
    means = [(name, summarise(runs.rows, name, spec.name, task).value) for name in names]
    known = [(name, value) for name, value in means if value is not None]
    return sorted(known, key=lambda pair: -pair[1] if spec.higher_is_better else pair[1])


def _task(task: str) -> str:
    return TASK_TITLES.get(task, task).lower()


def _amount(value: float, spec: MetricSpec) -> str:
    return f"{value:.{spec.digits}f}\u00a0{spec.unit}".rstrip("\u00a0")


def _sentence(
    scores: Sequence[tuple[str, float]],
    spec: MetricSpec,
    task: str,
    comparisons: Sequence[Mapping[str, Any]],
) -> Markup:
    """The best method of a task and its lead over the next, with interval and outcome of the test where there is one."""
    leader, best = scores[0]
    text = Markup("<b>{}</b> has the best {} in {}, {}").format(
        leader, spec.label, _task(task), _amount(best, spec)
    )
    if len(scores) == 1:
        return text + "."
    second, next_best = scores[1]
    text += Markup(", {} ahead of {}").format(_amount(abs(best - next_best), spec), second)
    pair = {leader, second}
    tested = [c for c in comparisons if (c["task"], c["metric"]) == (task, spec.name)]
    for one in (c for c in tested if {c["first"], c["second"]} == pair and None not in (c["low"], c["high"])):
        sign = 1 if one["difference"] > 0 else -1
        low, high = sorted(sign * one[end] for end in ("low", "high"))
        outcome = {f"{leader} is better": ", significant", "no significant difference": ", not significant"}
        ends = f"{low:+.{spec.digits}f} to {high:+.{spec.digits}f}".replace("-", "−")
        text += f" (95\u00a0% interval {ends}{outcome.get(one['verdict'], '')})"
    return text + "."


def _costs(runs: RunSet, names: Sequence[str]) -> list[Markup]:
    """The smallest and the fastest method, each with the next one."""
    known, found = {spec.name: spec for spec in runs.metrics}, []
    for metric, what in ((SIZE, "smallest"), (SPEED, "fastest")):
        scores = _scores(runs, names, known[metric], "") if metric in known else []
        if len(scores) > 1:
            (first, value), (second, other) = scores[:2]
            amounts = _amount(value, known[metric]), second, _amount(other, known[metric])
            found.append(Markup("<b>{}</b> is the {}, {} ({} {}).").format(first, what, *amounts))
    return found


def _facts(runs: RunSet) -> list[tuple[str, str]]:
    """Short lines describing the compared data."""
    configurations = [run.manifest.configuration for run in runs.runs]
    changed = f"{len(runs.changed)} under other conditions" * bool(runs.changed)
    trivial = counted(len(runs.trivial), "trivial baseline") * bool(runs.trivial)
    cores = runs.runs[0].manifest.machine.get("cores", "")
    frames = [f"{len(keys)} {_task(task)}" for task, keys in runs.keys.items()]
    cameras = {key.camera for keys in runs.keys.values() for key in keys}
    trained = [record.budget for record in runs.records.values() if not record.trivial]
    budgets = sorted({int(budget["iterations"]) for budget in trained if budget.get("iterations")})
    iterations = " to ".join(f"{n:,}" for n in dict.fromkeys([*budgets[:1], *budgets[-1:]]))
    presets = f"preset {', '.join(dict.fromkeys(config.preset for config in configurations))}"
    seeds = counted(len({seed for config in configurations for seed in config.seeds}), "seed")
    files = [run.folder.rows for run in runs.runs if run.folder.rows.exists()]
    when = max((datetime.fromtimestamp(file.stat().st_mtime) for file in files), default=None)
    lines = [
        ("Methods", "; ".join(filter(None, [", ".join(runs.ranked), changed, trivial]))),
        ("Subjects", ", ".join(sorted(runs.rows.subjects))),
        ("Frames", ", ".join(frames) + f"; {counted(len(cameras), 'camera')}" * bool(cameras)),
        ("Images", f"{runs.image_size} pixels" * bool(runs.image_size)),
        ("Training", f"{presets}; {f'{iterations} iterations; ' * bool(iterations)}{seeds}"),
        ("Machine", ", ".join(filter(None, [runs.machine, cores and f"{cores} cores"]))),
        ("Results of", f"{when.day} {when:%B %Y}" if when else ""),
    ]
    return [(name, text) for name, text in lines if text]
