"""Conclusions of a comparison as text: title, one sentence for each task and for costs, and their limitations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
from markupsafe import Markup

from ...bench.progress import counted
from ...bench.protocol import SEEN_CAMERAS, TASK_TITLES, UNSEEN_CAMERAS
from ...bench.specs import MetricSpec
from ..aggregate import summarise
from ..cameras import SPLIT_TASK
from ..conditions import conditions
from ..pareto.points import SIZE, SPEED
from ..runs import RunSet
from ..statistics.comparisons import subjects_needed
from ..statistics.paired import LEVEL
from ..tables import Table
from .frames import ShownFrame

Values = Mapping[tuple[str, str, ShownFrame], float]
WORDS = [
    "no",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
]
NAMED = 3
"""Maximum number of methods named in a title, and compared one by one in a sentence."""
MIDDLE = 0.9
"""Share of frames between the ends of a span."""


@dataclass
class Conclusions:
    """Texts of the head of a page; ``sentences`` and ``limits`` are HTML."""

    title: str
    sentences: list[Markup] = field(default_factory=list)
    limits: list[Markup] = field(default_factory=list)
    facts: list[tuple[str, str]] = field(default_factory=list)


def in_words(number: int) -> str:
    """Spell out a number up to twelve."""
    return WORDS[number] if number < len(WORDS) else str(number)


def listed(names: Sequence[Any]) -> Markup:
    """Names with commas and "and"."""
    if len(names) < 2:
        return Markup(", ").join(names)
    return Markup("{} and {}").format(Markup(", ").join(names[:-1]), names[-1])


def title_of(runs: RunSet) -> str:
    """Description of the comparison: methods, or their number, and subjects."""
    names = runs.ranked or runs.methods
    what = "avatar methods" if runs.ranked else "baselines"
    methods = str(listed(names)) if len(names) <= NAMED else f"{in_words(len(names)).capitalize()} {what}"
    subjects = sorted(runs.rows.subjects)
    where = f"subject {subjects[0]}" if len(subjects) == 1 else f"{in_words(len(subjects))} subjects"
    return f"{methods} on {where}"


def verdict(
    runs: RunSet,
    table: Table,
    metrics: Sequence[MetricSpec],
    comparisons: Sequence[Mapping[str, Any]],
    values: Values,
) -> Conclusions:
    """Describe the results of the methods that ``table`` ranks.

    Parameters
    ----------
    metrics : Sequence[MetricSpec]
        Metrics of frames; sentences are on the first.
    comparisons : Sequence[Mapping[str, Any]]
        Those of `compare_methods`; where they can be tested, sentences have intervals and the outcome of the test.
    values : Values
        Of `frame_values`, for spans of frames where nothing can be tested.
    """
    whole, runs = runs, runs.by_camera
    ranked = [row.method for row in table.rows if not row.trivial]
    found = Conclusions(title_of(runs), facts=_facts(whole))
    spans = []
    for task in runs.tasks if metrics else ():
        scores = _scores(runs, ranked, metrics[0], task)
        if not scores:
            continue
        (leader, best), others = scores[0], scores[1:]
        own = [
            _seen_from(leader, c) for c in comparisons if (c["task"], c["metric"]) == (task, metrics[0].name)
        ]
        against = {c["other"]: c for c in own if c["other"] in dict(others) and c["gain"] is not None}
        where, amount = _task(task), _amount(best, metrics[0])
        if not others:
            text = Markup("<b>{}</b> reaches a {} of {} in {}.").format(
                leader, metrics[0].label, amount, where
            )
            found.sentences.append(text)
        elif against and all(c["testable"] for c in against.values()):
            found.sentences.append(_tested(leader, amount, metrics[0], where, against))
        else:
            second, next_best = others[0]
            lead = _amount(abs(best - next_best), metrics[0])
            found.sentences.append(
                Markup("<b>{}</b> has the best {} in {}: {}, {} ahead of {}.").format(
                    leader, metrics[0].label, where, amount, lead, second
                )
            )
            spans.append(_span(runs, values, metrics[0], task, leader, second))
    found.sentences += _costs(runs, ranked)
    found.limits = _limits(runs, len(ranked), [span for span in spans if span], bool(spans))
    return found


def _scores(runs: RunSet, names: Sequence[str], spec: MetricSpec, task: str) -> list[tuple[str, float]]:
    """Methods with their means, best first."""
    means = [(name, summarise(runs.rows, name, spec.name, task).value) for name in names]
    known = [(name, value) for name, value in means if value is not None]
    return sorted(known, key=lambda pair: -pair[1] if spec.higher_is_better else pair[1])


def _task(task: str) -> str:
    return TASK_TITLES[task].lower() if task in TASK_TITLES else task


def _signed(value: float, spec: MetricSpec, *, unit: bool = False) -> str:
    text = f"{value:+.{spec.digits}f}".replace("-", "−")
    return f"{text}\u00a0{spec.unit}" if unit and spec.unit else text


def _amount(value: float, spec: MetricSpec) -> str:
    return f"{value:.{spec.digits}f}\u00a0{spec.unit}".rstrip("\u00a0")


def _seen_from(leader: str, comparison: Mapping[str, Any]) -> dict[str, Any]:
    """A comparison with the leader first; gains are positive if it is better."""
    first, second = comparison["first"], comparison["second"]
    sign = (1 if first == leader else -1) * (1 if comparison["higher_is_better"] else -1)
    ends = [comparison[name] for name in ("low", "high")]
    bounds = sorted(sign * end for end in ends) if None not in ends else None
    difference = comparison["difference"]
    return {
        "other": second if first == leader else first if second == leader else "",
        "gain": None if difference is None else sign * difference,
        "bounds": bounds,
        "testable": not comparison["verdict"].startswith("not testable"),
        "better": comparison["verdict"] == f"{leader} is better",
    }


def _tested(
    leader: str, amount: str, spec: MetricSpec, where: str, against: Mapping[str, Mapping[str, Any]]
) -> Markup:
    def with_interval(name: str) -> Markup:
        c = against[name]
        bounds = c["bounds"]
        ends = f"{_signed(bounds[0], spec)} to {_signed(bounds[1], spec)}" if bounds else ""
        interval = f", 95\u00a0% interval {ends}" if ends else ""
        return Markup("{} ({}{})").format(name, _signed(c["gain"], spec, unit=True), interval)

    better = sorted((n for n, c in against.items() if c["better"]), key=lambda n: against[n]["gain"])
    alike = sorted((n for n, c in against.items() if not c["better"]), key=lambda n: against[n]["gain"])
    text = Markup("<b>{}</b> has the best {} in {}, {}.").format(leader, spec.label, where, amount)
    if alike:
        text += Markup(" Its lead over {} is not significant.").format(listed([*map(with_interval, alike)]))
    if better:
        shown, rest = better[:NAMED], better[NAMED:]
        parts = [*map(with_interval, shown)]
        if rest:
            gains = [against[name]["gain"] for name in rest]
            ends = dict.fromkeys(f"{gain:.{spec.digits}f}" for gain in (min(gains), max(gains)))
            numbers = f"{' to '.join(ends)}\u00a0{spec.unit}".rstrip("\u00a0")
            of = f"the other {in_words(len(rest))}" if len(rest) > 1 else rest[0]
            parts.append(Markup("{} (by {})").format(of, numbers))
        text += Markup(" It is better than {}.").format(listed(parts))
    return text


def _costs(runs: RunSet, names: Sequence[str]) -> list[Markup]:
    """The smallest and the fastest method, each with the next one."""
    known = {spec.name: spec for spec in runs.metrics}
    phrases = []
    for metric, words in ((SIZE, "is the smallest, {} ({} {})"), (SPEED, "is the fastest, {} ({} {})")):
        if metric in known:
            scores = _scores(runs, names, known[metric], "")
            if len(scores) > 1:
                (first, value), (second, other) = scores[:2]
                shown = words.format(_amount(value, known[metric]), second, _amount(other, known[metric]))
                phrases.append(Markup("<b>{}</b> {}").format(first, shown))
    text = [Markup("; ").join(phrases) + "."] if phrases else []
    times = conditions(runs.rows, [s for s in runs.metrics if s.name == SPEED], list(names))
    if phrases and any(each.loaded for own in times.values() for each in own.values()):
        text.append(Markup("Times were measured while other processes used the machine."))
    return text


def _span(
    runs: RunSet, values: Values, spec: MetricSpec, task: str, leader: str, second: str
) -> Markup | None:
    """Difference of the best method to the next one in single frames."""
    sign = 1 if spec.higher_is_better else -1
    leads = []
    whole = SPLIT_TASK if task in (SEEN_CAMERAS, UNSEEN_CAMERAS) else task
    for key in runs.keys[task]:
        frame = ShownFrame(whole, key)
        pair = [values.get((spec.name, name, frame)) for name in (leader, second)]
        if pair[0] is not None and pair[1] is not None:
            leads.append(sign * (pair[0] - pair[1]))
    if len(leads) < 2:
        return None
    low, high = np.quantile(leads, [(1 - MIDDLE) / 2, (1 + MIDDLE) / 2])
    ahead = sum(lead > 0 for lead in leads)
    return Markup("in {} the lead of {} over {} is from {} to {} ({} of {} frames ahead)").format(
        _task(task), leader, second, _signed(low, spec), _signed(high, spec, unit=True), ahead, len(leads)
    )


def _limits(runs: RunSet, methods: int, spans: Sequence[Markup], untested: bool) -> list[Markup]:
    """Limitations of the sentences."""
    if methods < 2:
        return []
    pairs, subjects = methods * (methods - 1) // 2, len(runs.rows.subjects)
    if not untested:
        return [
            Markup(
                "Exact sign-flip test over {}, Holm’s correction, level {:g}\u00a0%. It applies to subjects of captures like "
                "these, not to other captures, resolutions or training budgets. “Not significant” does not mean equal: "
                "the interval shows how large a difference may be."
            ).format(counted(subjects, "subject"), 100 * LEVEL)
        ]
    text = Markup("{} cannot decide which method is better: a test of {} needs {}.").format(
        f"{in_words(subjects).capitalize()} subject{'s' * (subjects != 1)}",
        counted(pairs, "pair"),
        counted(subjects_needed(LEVEL, pairs), "subject"),
    )
    if spans:
        text += Markup(
            " In single frames, {}. These ranges contain the middle {:.0f}\u00a0% of the frames; they are not confidence"
            " intervals."
        ).format(Markup("; ").join(spans), 100 * MIDDLE)
    return [text]


def _facts(runs: RunSet) -> list[tuple[str, str]]:
    """Short lines describing the compared data."""
    cores = runs.runs[0].manifest.machine.get("cores", "")
    trivial = f"{in_words(len(runs.trivial))} trivial baseline{'s' * (len(runs.trivial) != 1)}"
    methods = ", ".join(runs.ranked)
    changed = f"{in_words(len(runs.changed))} under other conditions"
    subjects = sorted(runs.rows.subjects)
    frames = [f"{len(keys)} {_task(task)}" for task, keys in runs.keys.items()]
    cameras = {key.camera for keys in runs.keys.values() for key in keys}
    budgets = sorted(
        {
            int(r.budget["iterations"])
            for r in runs.records.values()
            if not r.trivial and r.budget.get("iterations")
        }
    )
    iterations = " to ".join(f"{n:,}" for n in dict.fromkeys([*budgets[:1], *budgets[-1:]]))
    preset = ", ".join(dict.fromkeys(run.manifest.configuration.preset for run in runs.runs))
    seeds = counted(len({seed for run in runs.runs for seed in run.manifest.configuration.seeds}), "seed")
    written = max(
        (run.folder.rows.stat().st_mtime for run in runs.runs if run.folder.rows.exists()), default=0
    )
    when = datetime.fromtimestamp(written)
    lines = [
        (
            "Methods",
            "; ".join(filter(None, [methods, changed * bool(runs.changed), trivial * bool(runs.trivial)])),
        ),
        ("Subjects" if len(subjects) > 1 else "Subject", ", ".join(subjects)),
        ("Frames", ", ".join(frames) + f"; {counted(len(cameras), 'camera')}" * bool(cameras)),
        ("Images", f"{runs.image_size} pixels" if runs.image_size else ""),
        (
            "Training",
            "; ".join(
                filter(None, [f"preset {preset}", f"{iterations} iterations" * bool(iterations), seeds])
            ),
        ),
        ("Machine", ", ".join(filter(None, [runs.machine, cores and f"{cores} cores"]))),
        ("Results of", f"{when.day} {when:%B %Y}" if written else ""),
    ]
    return [(name, text) for name, text in lines if text]
