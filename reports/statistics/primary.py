"""Primary endpoints of the suite: a fixed list of tests, corrected together. All other tests are exploratory."""

from __future__ import annotations

from itertools import product

from ...bench.protocol import SEEN_CAMERAS, TASK_TITLES, UNSEEN_CAMERAS
from ..runs import RunSet, synthetic_settings
from ..writers import pipe_table
from .command import equivalence_text
from .comparisons import LEVEL, PairedComparison, as_one_family, compare

PAIR = ("ours", "ga")
PRIMARY = tuple(product(("novel_view", SEEN_CAMERAS, UNSEEN_CAMERAS), ("psnr", "lpips")))
"""Task and metric of each endpoint; `docs/explanation/suite.md` has the same list."""
MARGINS = {"psnr": 0.3}
"""Differences within which the methods count as equivalent, in the metric's unit."""


def primary_comparisons(runs: RunSet) -> list[PairedComparison]:
    """The primary endpoints of whole frames, with Holm's correction; empty if the runs lack one of `PAIR` or the metrics."""
    runs = runs.by_camera
    specs = {spec.name: spec for spec in runs.metrics}
    if not {*PAIR} <= {*runs.methods} or not {metric for _, metric in PRIMARY} <= {*specs}:
        return []
    found = [
        compare(
            *(runs.rows, [PAIR]),
            task=task,
            metric=metric,
            higher_is_better=specs[metric].higher_is_better,
            margin=MARGINS.get(metric),
        )
        for task, metric in PRIMARY
    ]
    return as_one_family(each for (each,) in found)


def planned_subjects(runs: RunSet) -> int:
    """Planned number of subjects of the runs' synthetic captures; 0 if not recorded."""
    settings = [synthetic_settings(clip) for run in runs.runs for clip in run.manifest.clips]
    return max((int(each.get("subjects", 0)) for each in settings), default=0)


def primary_table(runs: RunSet) -> str:
    """Differences, intervals and verdicts of the primary endpoints as a Markdown table; "" if the runs lack them.

    As long as planned subjects are missing, the results are interim and have no verdict: testing again after
    each further subject would reject too often.
    """
    found = primary_comparisons(runs)
    if not found:
        return ""
    specs, planned = {spec.name: spec for spec in runs.metrics}, planned_subjects(runs)
    confidence = f"{100 * (1 - LEVEL):g} % interval"
    lines = [["endpoint", f"{PAIR[0]} - {PAIR[1]}", confidence, "p", "Holm", "", "equivalence"], ["---"] * 7]
    for c in found:
        spec = specs[c.metric]
        unit = f" ({spec.unit})" if spec.unit else ""
        head = f"{TASK_TITLES.get(c.task, c.task)}, {spec.label}{unit}"
        if c.difference is None or c.p is None or c.p_holm is None:
            lines.append([head, "-", "", "", "", f"{c.verdict}: {c.reason}", ""])
            continue
        digits = spec.digits + 1
        bounds = "-" if c.low is None or c.high is None else f"{c.low:+.{digits}f}, {c.high:+.{digits}f}"
        numbers = [f"{c.difference:+.{digits}f}", bounds, f"{c.p:.4f}", f"{c.p_holm:.4f}"]
        if c.subjects < planned:
            lines.append([head, *numbers, f"interim: {c.subjects} of {planned} subjects", ""])
            continue
        lines.append([head, *numbers, c.verdict, equivalence_text(c, spec.unit)])
    how = (
        "Intervals are Student's t intervals over subjects, not corrected for multiple comparisons; they may exclude 0 where the test does "
        f"not reject. Exact sign-flip tests over subjects, Holm over the {sum(c.p is not None for c in found)} endpoints with values; "
        "equivalence by two one-sided sign-flip tests, which assume that subjects differ symmetrically about the mean, Holm over "
        f"these; level {LEVEL:.0%}."
    )
    return f"{pipe_table(lines)}\n\n{how}"


def primary_section(runs: RunSet) -> str:
    """The primary endpoints as Markdown, with the status of the page's other tests."""
    exploratory = (
        "All other tests on this page are exploratory. They are corrected over the comparisons of one metric and task, "
        "including the primary endpoints."
    )
    table = (
        primary_table(runs)
        or f"These runs have none: primary endpoints compare `{PAIR[0]}` with `{PAIR[1]}`."
    )
    return f"## Primary endpoints\n\n{table} {exploratory}"
