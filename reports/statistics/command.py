"""``headbench compare``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import chain, combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.options import DependentOptions
from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ...bench.specs import CommandResult, MetricSpec, command
from ...bench.terminal import table
from ..aggregate import conditions, note_of
from ..runs import FrameSelection, RunSet
from ..tables import AVATAR_TITLE, BELOW_CAUSES, COMPARISON, not_better
from ..writers import csv_text
from .comparisons import LEVEL, PairedComparison, compare


@dataclass(frozen=True)
class CompareSettings:
    """Paired differences between methods of finished runs: size, interval, exact test, Holm's correction. With --baseline:
    comparison of one run with a baseline file, for CI.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames. Seeds of a method are combined; other settings count as another method."""
    baseline: str | None = None
    """Compare one run, or what `headbench evaluate` wrote, with this baseline file (JSON), which is kept under version
    control. Exit code 0: no value is worse; 1: a value is worse; 3: results or baseline missing or invalid."""
    update: bool = False
    """With --baseline: write the results into the file instead of judging them; tolerances that it has are kept."""
    captures: Literal["same", "remade"] | None = None
    """With --update: `same` (default) requires captures with the same fingerprint; `remade` is for captures
    that are synthesised again for every run: everything except the fingerprint must be the same."""
    judge_speed: bool = False
    """With --baseline: also judge metrics that depend on the machine and its load (frames per second, milliseconds, training
    time, memory), where the baseline was measured on a machine of the same kind. Without it they are shown, but do not affect
    the exit code."""
    junit: str | None = None
    """With --baseline: also write a JUnit XML file: one test case for every task, method, subject and metric."""
    markdown: str | None = None
    """With --baseline: also write a Markdown summary."""
    against: Annotated[str | None, tyro.conf.arg(metavar="METHOD")] = None
    """Compare every method with this one only, instead of all pairs: with fewer comparisons, fewer subjects are needed."""
    metrics: tuple[str, ...] = ()
    """Metrics to compare; default: those of the comparison table."""
    trivial: bool = False
    """Also compare the trivial baselines (mean image, nearest camera)."""
    region: str = "full"
    """Region of the frames to compare on, such as face."""
    sequences: tuple[str, ...] = ()
    """Only frames of these sequences; default: all."""
    level: float = 0.05
    """Level of the tests; intervals have a confidence of one minus it."""
    equivalence: tuple[str, ...] = ()
    """Also test whether methods are equivalent: METRIC=MARGIN in the metric's unit, such as `psnr=0.3`, for each metric to
    test."""
    format: Literal["text", "csv"] = "text"
    """Format of the output; csv adds uncorrected p-values and subjects won, --json also the difference of each subject."""

    dependent = (
        DependentOptions(("update", "captures", "judge_speed", "junit", "markdown"), "baseline"),
        DependentOptions(("captures",), "update"),
        DependentOptions(("judge_speed", "junit", "markdown"), "update", False),
        DependentOptions(
            ("against", "metrics", "trivial", "region", "sequences", "level", "equivalence", "format"),
            *("baseline", False),
        ),
    )

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        if self.baseline is not None and len(self.runs) != 1:
            raise ValueError(f"runs: one folder with --baseline, found {len(self.runs)}")
        if not 0 < self.level < 1:
            raise ValueError(f"level is {self.level}; a number between 0 and 1")
        self.margins()

    def margins(self) -> dict[str, float]:
        """Margins of equivalence by metric. Raises `ValueError` for words that are not METRIC=MARGIN with a positive margin."""
        margins = {}
        for word in self.equivalence:
            metric, _, number = word.partition("=")
            with suppress(ValueError):
                margins[metric] = float(number)
            if not metric or not 0 < margins.get(metric, 0.0) < math.inf:
                raise ValueError(
                    f"equivalence is {word}; METRIC=MARGIN with a positive number, such as psnr=0.3"
                )
        return margins


FIELDS = (
    *("task", "metric", "first", "second", "difference", "low", "high", "effect", "p", "p_holm"),
    *("family", "subjects", "wins", "seeds_first", "seeds_second", "verdict", "reason", "note"),
    *("margin", "p_equivalence", "p_equivalence_holm", "equivalent"),
)


@command("compare", group="compare")
def compare_runs(settings: CompareSettings, progress: Progress = no_progress) -> CommandResult:
    """Test differences between methods, or compare a run with a baseline file (CI)."""
    if settings.baseline is not None:
        from ...bench.gate.command import compare_with_baseline

        return compare_with_baseline(
            Path(settings.runs[0]),
            Path(settings.baseline),
            update=settings.update,
            captures=settings.captures,
            judge_speed=settings.judge_speed,
            junit=settings.junit,
            markdown=settings.markdown,
        )
    part = FrameSelection(settings.region, settings.sequences)
    runs = RunSet.read([Path(folder) for folder in settings.runs], part)
    return compare_methods(
        runs,
        settings.against,
        metrics=settings.metrics,
        trivial=settings.trivial,
        level=settings.level,
        margins=settings.margins(),
        csv=settings.format == "csv",
        progress=progress,
    )


def compare_methods(
    runs: RunSet,
    against: str | None = None,
    *,
    metrics: Sequence[str] = (),
    trivial: bool = False,
    level: float = LEVEL,
    margins: Mapping[str, float] | None = None,
    csv: bool = False,
    progress: Progress = no_progress,
) -> CommandResult:
    """`compare_runs` of loaded runs: all pairs of methods, or all methods with ``against``."""
    runs, margins = runs.by_camera, margins or {}
    pairs = _pairs(runs, against, trivial)
    names = [spec.name for spec in runs.metrics]
    for name in metrics:
        if name not in names:
            raise InputError("command line", "--metrics", f"metrics of the runs: {', '.join(names)}", name)
    compared = metrics or [spec.name for spec in runs.metrics if COMPARISON in spec.tables]
    for name in margins:
        if name not in compared:
            raise InputError(
                "command line", "--equivalence", f"compared metrics: {', '.join(compared)}", name
            )
    specs = [spec for spec in runs.metrics if spec.name in compared]
    columns = [(task, spec) for task in runs.tasks for spec in specs if spec.per_frame]
    columns += [("", spec) for spec in specs if not spec.per_frame]
    families: list[tuple[MetricSpec, list[PairedComparison]]] = []
    for index, (task, spec) in enumerate(columns):
        family = compare(
            *(runs.rows, pairs),
            task=task,
            metric=spec.name,
            higher_is_better=spec.higher_is_better,
            level=level,
            margin=margins.get(spec.name),
        )
        families.append((spec, family))
        progress(index + 1, len(columns), spec.label)
    times = conditions(runs.rows, specs, list(dict.fromkeys(chain(*pairs))))
    records = []
    for comparison in chain(*(family for _, family in families)):
        by_method = times.get(comparison.metric, {})
        timed = {n: by_method[n] for n in (comparison.first, comparison.second) if n in by_method}
        records.append({**_plain(comparison), "note": note_of(timed)})
    if csv:
        text = _csv(records)
    else:
        blocks = [
            _text(task, [(spec, family) for spec, family in families if family[0].task == task], level)
            for task in dict.fromkeys(task for task, _ in columns)
        ]
        notes = [f"{spec.label}: {note}" for spec in specs if (note := note_of(times.get(spec.name, {})))]
        subjects = counted(max(c.subjects for _, family in families for c in family), "subject")
        how = f"p: exact sign-flip test over {subjects}, with Holm's correction for all pairs of a metric and task."
        below = [how, *notes, runs.cameras, runs.part]
        worse = not_better(runs.rows, runs.metrics, runs.ranked, runs.trivial, runs.tasks)
        warnings = ["\n".join([*worse.values(), BELOW_CAUSES])] if worse else []
        text = "\n\n".join([*warnings, *blocks, "\n".join(filter(None, below))])
    return CommandResult(text, {"level": level, "comparisons": records}, verbatim=csv)


def _pairs(runs: RunSet, against: str | None, trivial: bool) -> list[tuple[str, str]]:
    """The pairs to compare: all, or every method with one."""
    methods = runs.methods if trivial else runs.ranked
    if against is None:
        pairs = list(combinations(methods, 2))
    elif against in runs.methods:
        pairs = [(method, against) for method in methods if method != against]
    else:
        raise InputError("command line", "--against", f"one of {', '.join(runs.methods)}", against)
    if not pairs:
        raise InputError("runs", "methods", "two methods to compare", ", ".join(methods) or "none")
    return pairs


def _plain(comparison: PairedComparison) -> dict[str, Any]:
    """All fields and results of a comparison, as JSON values."""
    derived = {name: getattr(comparison, name) for name in ("subjects", "wins", "verdict", "equivalent")}
    return {**asdict(comparison), "differences": dict(comparison.differences), **derived}


def equivalence_text(comparison: PairedComparison, unit: str) -> str:
    """Outcome of the test of equivalence in words, with its p-value; "" without one."""
    if comparison.margin is None or comparison.p_equivalence_holm is None:
        return ""
    margin = f"within {comparison.margin:g} {unit}".rstrip()
    text = f"equivalent {margin}" if comparison.equivalent else f"equivalence {margin} not shown"
    return f"{text} (Holm {comparison.p_equivalence_holm:.4f})"


def _csv(comparisons: Sequence[dict[str, Any]]) -> str:
    lines: list[list[object]] = [list(FIELDS)]
    for comparison in comparisons:
        first, second = comparison["seeds"]
        values = {**comparison, "seeds_first": first, "seeds_second": second}
        lines.append([values[name] for name in FIELDS])
    return csv_text(lines).rstrip()


def _text(task: str, families: Sequence[tuple[MetricSpec, Sequence[PairedComparison]]], level: float) -> str:
    """The comparisons of a task as a table for a terminal, those of a metric below each other."""
    lines = []
    for spec, comparisons in families:
        unit = f"{spec.unit}, " if spec.unit else ""
        lines.append([f"{spec.label} ({unit}{'higher' if spec.higher_is_better else 'lower'} is better)"])
        for c in comparisons:
            name = f"{c.first} - {c.second}"
            if c.difference is None or c.p is None or c.p_holm is None:
                lines.append([name, "-", "", "", f"{c.verdict}: {c.reason}"])
                continue
            # One digit more than the table, since differences are smaller than values.
            digits = spec.digits + 1
            bounds = "-" if c.low is None or c.high is None else f"{c.low:+.{digits}f} {c.high:+.{digits}f}"
            verdict = "; ".join(filter(None, [c.verdict, equivalence_text(c, spec.unit)]))
            p = f"{c.p_holm:.4f}" if c.testable else "-"
            lines.append([name, f"{c.difference:+.{digits}f}", bounds, p, verdict])
    heads = ["Methods", "Difference", f"{100 * (1 - level):g} % interval", "p", "Conclusion"]
    return table(heads, lines, title=TASK_TITLES.get(task, task) or AVATAR_TITLE)
