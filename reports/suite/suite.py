"""The results of a suite as Markdown: its endpoints, and tables by region and by held-out sequence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import sqrt
from pathlib import Path
from statistics import fmean, stdev, variance
from typing import Any

from ...bench.engine.store import RunFolder
from ...bench.experiments.specs import MOVED_LINES, RECORD_FILE, RECORDED_RUN, RUN, SEEDS_RUN
from ...bench.io.documents import read_json
from ...bench.protocol import TASK_TITLES, UNSEEN_CAMERAS
from ...bench.rows import ALL, FULL
from ..aggregate import means_by_seed, whole_images
from ..runs import FrameSelection, RunSet, synthetic_settings
from ..statistics.comparisons import LEVEL as TEST_LEVEL
from ..statistics.comparisons import PairedComparison, as_one_family, compare, detectable, subjects_needed
from ..table_report import Columns, table_of
from ..tables import COMPARISON, Table
from ..writers import pipe_table, to_markdown

PAIR = ("ours", "ga")
NOVEL, FACE = "novel_view", "face"


@dataclass(frozen=True)
class Endpoint:
    """A hypothesis of the suite: the difference of two methods in a metric of a task, over a region, is 0.

    With ``minus``, the difference in that task is subtracted, see `PairedComparison`. ``whole`` is the metric of whole frames that is
    shown beside it, without a test.
    """

    pair: tuple[str, str]
    task: str
    metric: str
    region: str = FACE
    minus: str = ""
    whole: str = "psnr"
    deviation: float | None = None  # standard deviation over subjects that the plan assumes; None: not known

    def compared(self, runs: RunSet, *, whole: bool = False) -> PairedComparison:
        """The comparison in these runs, alone in its family; of whole frames if ``whole``."""
        metric, region = (self.whole, FULL) if whole else (self.metric, self.region)
        return comparison(runs, self.pair, self.task, metric, region, self.minus)

    def title(self, runs: RunSet) -> str:
        """Name of the endpoint."""
        spec = next(spec for spec in runs.metrics if spec.name == self.metric)
        unit = f" ({spec.unit})" if spec.unit else ""
        tasks = [TASK_TITLES[task].lower() for task in (self.task, self.minus) if task]
        label = spec.label if spec.kind == FACE else f"{spec.label} of the {self.region}"
        return f"`{self.pair[0]}` - `{self.pair[1]}`: {' minus '.join(tasks)}, {label}{unit}"


PRIMARY = (
    Endpoint(PAIR, NOVEL, "psnr", deviation=0.92),
    Endpoint(PAIR, NOVEL, "lpips-face", whole="lpips"),
    Endpoint(PAIR, UNSEEN_CAMERAS, "psnr", deviation=0.77),
    Endpoint(PAIR, UNSEEN_CAMERAS, "lpips-face", whole="lpips"),
    Endpoint((f"ours+{MOVED_LINES}", "ours"), NOVEL, "psnr", minus=UNSEEN_CAMERAS, deviation=0.5),
)
"""The endpoints, one family of tests on captures as recordings are; `docs/explanation/suite.md` has the same list. The last one is
the crossing in Table 4 of the paper of `ours`: +1.2 dB in novel views and -0.7 dB in self-reenactment."""


def comparison(
    runs: RunSet, pair: tuple[str, str], task: str, metric: str, region: str = FULL, minus: str = ""
) -> PairedComparison:
    """Compare two methods on the subjects that both have. A metric of the face has no other region."""
    read = runs.only(pair).shared.by_camera
    spec = next(spec for spec in read.metrics if spec.name == metric)
    rows = read.of(FrameSelection(FULL if spec.kind == FACE else region)).rows
    rising = spec.higher_is_better
    return compare(rows, [pair], task=task, metric=metric, higher_is_better=rising, minus=minus)[0]


def primary_comparisons(runs: RunSet) -> list[PairedComparison]:
    """The endpoints with Holm's correction; empty if the runs lack a method, metric, task or region of one."""
    by_camera = runs.by_camera
    metrics, methods = {spec.name for spec in runs.metrics}, {*runs.methods}
    for endpoint in PRIMARY:
        known = {*endpoint.pair} <= methods and {endpoint.metric, endpoint.whole} <= metrics
        tasks = {endpoint.task, *filter(None, [endpoint.minus])} <= {*by_camera.tasks}
        if not (known and tasks and endpoint.region in runs.rows.regions):
            return []
    return as_one_family(endpoint.compared(runs) for endpoint in PRIMARY)


def planned_subjects(runs: RunSet) -> int:
    """Planned number of subjects of the runs' synthetic captures; 0 if not recorded."""
    settings = [synthetic_settings(clip) for run in runs.runs for clip in run.manifest.clips]
    return max((int(values.get("subjects", 0)) for values in settings), default=0)


def power_table(subjects: int) -> str:
    """Smallest differences that the first step of Holm's procedure finds with a power of 80 %, as a Markdown table."""
    needed = subjects_needed(TEST_LEVEL, len(PRIMARY))
    if subjects < needed:
        return f"The tests of the endpoints find no difference with fewer than {needed} subjects."
    effect = detectable(subjects, TEST_LEVEL / len(PRIMARY))
    lines = [["endpoint", "metric", "assumed SD", f"difference found with {subjects} subjects"], ["---"] * 4]
    for each in PRIMARY:
        tasks = " minus ".join(filter(None, [each.task, each.minus]))
        found = f"{effect:.2f} SD" if each.deviation is None else f"{effect * each.deviation:.2f}"
        assumed = "–" if each.deviation is None else f"{each.deviation:.2f}"
        lines.append([f"`{each.pair[0]}` - `{each.pair[1]}`, {tasks}", each.metric, assumed, found])
    return pipe_table(lines)


HOW = (
    f"Intervals are Student's t intervals over subjects ({1 - TEST_LEVEL:.0%}), not corrected for multiple comparisons; they may exclude 0 "
    "where the test does not reject."
)


def primary_table(recorded: RunSet) -> str:
    """Differences, intervals and verdicts of the endpoints as Markdown; "" if runs lack them.

    As long as planned subjects are missing, the results are interim and have no verdict: testing again after
    each further subject would reject too often.
    """
    endpoints = primary_comparisons(recorded)
    if not endpoints:
        return ""
    planned = planned_subjects(recorded)
    specs = {spec.name: spec for spec in recorded.metrics}
    lines = [["endpoint", "difference (interval)", "p", "Holm", ""], ["---"] * 5]
    for endpoint, c in zip(PRIMARY, endpoints, strict=True):
        interim = f"interim: {c.subjects} of {planned} subjects" if c.subjects < planned else ""
        tests = ["", ""] if c.p is None or c.p_holm is None else [f"{c.p:.4f}", f"{c.p_holm:.4f}"]
        verdict = f"{c.verdict}: {c.reason}" if c.reason else interim or c.verdict
        lines.append([endpoint.title(recorded), c.text(specs[endpoint.metric].digits + 1), *tests, verdict])
    tested = sum(c.p is not None for c in endpoints)
    test = f"Exact sign-flip tests over subjects, Holm over the {tested} endpoints with values, level {TEST_LEVEL:.0%}."
    return f"{pipe_table(lines)}\n\n{HOW} {test}"


def elsewhere_table(recorded: RunSet, exact: RunSet | None) -> str:
    """The differences of the endpoints in whole frames and on exact captures, which have no test, as Markdown."""
    lines = [["endpoint", "whole frames", "exact captures", "exact captures, whole frames"], ["---"] * 4]
    specs = {spec.name: spec for spec in recorded.metrics}
    if exact is not None and not primary_comparisons(exact):
        exact = None
    for endpoint in PRIMARY:
        beside = [endpoint.compared(recorded, whole=True)]
        if exact is not None:
            beside += [endpoint.compared(exact), endpoint.compared(exact, whole=True)]
        cells = [each.text(specs[endpoint.metric].digits + 1) for each in beside]
        lines.append([endpoint.title(recorded), *cells, *["–"] * (3 - len(cells))])
    return f"The same differences elsewhere, without a test:\n\n{pipe_table(lines)}"


def primary_section(recorded: RunSet | None, exact: RunSet | None) -> str:
    """The endpoints as Markdown, with the status of the page's other differences."""
    found = "These runs lack methods, metrics or captures of the endpoints."
    if recorded is not None and (tested := primary_table(recorded)):
        found = f"{tested}\n\n{elsewhere_table(recorded, exact)}"
    return f"## Primary endpoints\n\n{found} All other differences on this page are shown with intervals alone, without a test."


FOLDER = "extremes"
KEPT = ("subject", "method", "seed", "frames", "frames_broken", "measures", "missing", "no_truth")
"""Parts of an avatar's record used in the table."""


def read_extremes(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """Records of all avatars of some runs; none for a run without that test."""
    files = [run / FOLDER / RECORD_FILE for run in runs]
    avatars = [avatar for file in files if file.is_file() for avatar in read_json(file)["avatars"]]
    return [{name: avatar[name] for name in KEPT if name in avatar} for avatar in avatars]


def extremes_section(avatars: Sequence[Mapping[str, Any]]) -> str:
    """A table as Markdown: mean, worst value and failed frames of every measure by method; "" without avatars.

    A mean is over the frames of a subject, then over subjects; the worst value is that of any frame.
    """
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for avatar in avatars:
        by_method.setdefault(avatar["method"], []).append(avatar)
    rows: list[list[str]] = []
    notes: dict[str, None] = {}
    for method, of_method in by_method.items():
        for note in (avatar.get("missing") or avatar.get("no_truth") for avatar in of_method):
            if note:
                notes[f"`{method}`: {note}"] = None
        rendered = [avatar["measures"] for avatar in of_method if "missing" not in avatar]
        for name in dict.fromkeys(chain(*rendered)):
            measured = [measures[name] for measures in rendered if name in measures]
            means = [m["mean"] for m in measured if m["mean"] is not None]
            worst = [(m["mean"] or 0.0, m["worst"]) for m in measured if m["worst"] is not None]
            if not means or not worst:
                continue
            # If the worst value is the lowest, higher is better.
            lowest = sum(low <= mean for mean, low in worst) * 2 > len(worst)
            extreme = (min if lowest else max)(value for _, value in worst)
            counts = f"{sum(m['failed'] for m in measured)} of {sum(m['frames'] for m in measured)}"
            numbers = [str(len(means)), f"{fmean(means):.3f}", f"{extreme:.3f}", counts]
            rows.append([method, name.replace("_", " "), *numbers])
    if not rows:
        return ""
    lines = [["method", "measure", "subjects", "mean", "worst", "frames that exceed the limit"], ["---"] * 6]
    text = pipe_table([*lines, *rows])
    how = (
        "Joint samples of expression and jaw along the principal components of training, in views between and beyond the training "
        "cameras, against the path-traced person in the same pose and view (`headbench run extremes`)."
    )
    return "\n\n".join(["## New poses and views", how, text, *(f"Missing: {note}" for note in notes)])


def differences(
    runs: RunSet,
    methods: Sequence[str],
    reference: str,
    columns: Sequence[tuple[str, str, str]],
    head: str,
    sequences: tuple[str, ...] = (),
) -> str:
    """A Markdown table of the differences of methods from another, each on the subjects that both have.

    ``columns`` are tasks, metrics and regions; ``head`` is the title of the methods.
    """
    specs = {spec.name: spec for spec in runs.metrics}
    several = len({metric for _, metric, _ in columns}) > 1
    lines = [[head], ["---", *["--:"] * (1 + len(columns))]]
    for task, metric, region in columns:
        parts = [TASK_TITLES[task], *[specs[metric].label] * several, *[region] * (region != FULL)]
        lines[0].append(", ".join(parts))
    lines[0].append("subjects")
    for name in methods:
        pair = (name, reference)
        read = runs.only(pair).shared.by_camera
        rows = {region: read.of(FrameSelection(region, sequences)).rows for _, _, region in columns}
        found = [
            compare(
                *(rows[region], [pair]),
                task=task,
                metric=metric,
                higher_is_better=specs[metric].higher_is_better,
            )[0]
            for task, metric, region in columns
        ]
        cells = [each.text(specs[each.metric].digits) for each in found]
        lines.append([f"`{name}`", *cells, str(max(each.subjects for each in found))])
    return pipe_table(lines)


COMPARED = "psnr"


def variance_table(runs: RunSet, pair: tuple[str, str], *, of_methods: bool = True) -> str:
    """Standard deviations as Markdown, by task: of the difference of ``pair`` and of each method; "" with one seed.

    Between subjects: of the means over seeds. Within subjects: of seeds about the mean of their subject, pooled over subjects
    (the square root of the mean variance). Subjects without all seeds are left out.
    """
    runs = runs.by_camera
    spec = next((spec for spec in runs.metrics if spec.name == COMPARED), None)
    if spec is None or len(runs.rows.seeds(ALL)) < 2:
        return ""
    heads = [
        "",
        "task",
        "subjects",
        "seeds",
        f"mean ({spec.unit})",
        "SD between subjects",
        "SD within subjects",
    ]
    lines = [heads, ["---"] * len(heads)]
    for task in runs.tasks:
        values = {
            method: means_by_seed(whole_images(runs.rows, method, COMPARED, task)) for method in runs.ranked
        }
        if {*pair} <= {*values}:
            first, second = (values[name] for name in pair)
            values[f"{pair[0]} - {pair[1]}"] = {
                seed: {s: first[seed][s] - second[seed][s] for s in first[seed].keys() & second[seed].keys()}
                for seed in first.keys() & second.keys()
            }
        for name, by_seed in values.items():
            if name in runs.ranked and not of_methods:
                continue
            if parts := components(by_seed):
                subjects, mean, between, within = parts
                place = [name, TASK_TITLES.get(task, task), str(subjects), str(len(by_seed))]
                text = f"{mean:+.2f}" if name not in runs.ranked else f"{mean:.2f}"
                lines.append([*place, text, f"{between:.3f}", f"{within:.3f}"])
    how = (
        "Standard deviations: between subjects, of the means over seeds; within subjects, over seeds, pooled. "
        "Differences are between trainings with the same seed."
    )
    text = " ".join(filter(None, [how, runs.part]))
    return f"{pipe_table(lines)}\n\n{text}"


def components(by_seed: Mapping[int, Mapping[str, float]]) -> tuple[int, float, float, float] | None:
    """Number of subjects with every seed, mean, standard deviations between and within; None with fewer than two of either."""
    subjects = sorted(set.intersection(*(set(means) for means in by_seed.values()))) if by_seed else []
    if len(by_seed) < 2 or len(subjects) < 2:
        return None
    values = {subject: [means[subject] for means in by_seed.values()] for subject in subjects}
    centres = [fmean(of_seeds) for of_seeds in values.values()]
    within = sqrt(fmean(variance(of_seeds) for of_seeds in values.values()))
    return len(subjects), fmean(centres), stdev(centres), within


SECTIONS = {RECORDED_RUN: "Captures as recordings are", RUN: "Exact captures"}
"""Titles of the parts of the results, by folder of runs."""
AVATAR_TABLES = {
    "cost": (
        *("training_processor", "training_iterations", "training_time"),
        *("storage", "storage_coded", "coded_change"),
    ),
    "speed": ("fps", "fps_one_thread", "fps_without_head", "processor_time"),
    "mechanism": ("dynamic_splats", "opacity_range", "color_range", "position_range"),
}
"""Metrics of the tables without frames, by layout."""


def suite_runs(folder: Path, base: str = RUN) -> list[Path]:
    """Folders of a suite's finished runs of one kind, one for each subject.

    A suite of earlier versions has one run for all subjects.
    """
    place = folder / base
    folders = [place, *sorted(place.iterdir())] if place.is_dir() else []
    return [run for run in folders if RunFolder(run).rows.is_file()]


def suite_report(folder: Path, method: str, read: Callable[[Sequence[Path]], RunSet] = RunSet.read) -> str:
    """Tables of a suite as Markdown: endpoints, then for each kind of captures whole frames, regions, held-out sequences, conditions.

    Each table is followed by the paired differences of all other methods from ``method``, with intervals. ``read`` reads runs
    together.
    """
    folders = {base: suite_runs(folder, base) for base in (*SECTIONS, SEEDS_RUN)}
    runs = {base: read(found) for base, found in folders.items() if found and base in SECTIONS}
    text = primary_section(runs.get(RECORDED_RUN), runs.get(RUN)) + "\n"
    for base, title in SECTIONS.items():
        if base in runs:
            text += f"\n# {title}\n\n{_tables(runs[base], method)}"
    if section := extremes_section(read_extremes(folders[RUN])):
        text += f"\n{section}\n"
    if seeds := folders[SEEDS_RUN]:
        names, base = [run.name for run in seeds], next(iter(runs))
        both = read([*(run for run in folders[base] if run.name in names), *seeds])
        part = FrameSelection(FACE if FACE in both.rows.regions else FULL)
        table = variance_table(both.only([*both.ranked]).of(part), PAIR)
        text += f"\n## Variance between and within subjects\n\n{table}\n"
    return text


def _tables(read: RunSet, method: str) -> str:
    whole = read.by_camera
    plain = whole.only([label for label, record in whole.records.items() if not record.condition]).shared
    tested = sorted({frame[1] for frame in read.rows.frames("self_reenactment", FULL)})
    parts = {"All frames": FrameSelection()}
    parts |= {f"Region {region}": FrameSelection(region) for region in sorted(plain.rows.regions - {FULL})}
    parts |= {f"Sequence {name}": FrameSelection(sequences=(name,)) for name in tested}
    sections = [_machines(read)]
    for title, part in parts.items():
        selected = plain.of(part)
        text = f"## {title}\n\n{to_markdown(_unmarked(table_of(selected))).strip()}"
        if method in selected.ranked and len(selected.ranked) > 1:
            others = [label for label in selected.ranked if label != method]
            compared = _columns(selected, part.region)
            text += f"\n\n{differences(plain, others, method, compared, f'minus `{method}`', part.sequences)}"
        sections.append(text)
    for layout, names in AVATAR_TABLES.items():
        if columns := tuple(m.name for m in plain.metrics if m.name in names and layout in m.tables):
            text = to_markdown(_unmarked(table_of(plain, layout, columns=Columns(columns)))).strip()
            sections.append(f"## {layout.capitalize()}\n\n{text}")
    conditions: dict[str, list[str]] = {}
    for label, record in whole.records.items():
        if record.condition and record.name in whole.methods:
            conditions.setdefault(record.name, []).append(label)
    regions = (FULL, *({FACE} & read.rows.regions))
    for name, labels in conditions.items():
        compared = [place for region in regions for place in _columns(whole, region) if place[1] == COMPARED]
        table = differences(whole, labels, name, compared, f"{COMPARED.upper()} minus that of `{name}`")
        sections.append(f"## Conditions of {name}\n\n{table}")
    return "\n\n".join(sections) + "\n"


def _columns(runs: RunSet, region: str) -> list[tuple[str, str, str]]:
    """Tasks, and metrics of frames in the comparison table that have a region."""
    specs = [spec for spec in runs.metrics if spec.per_frame and COMPARISON in spec.tables]
    chosen = [spec.name for spec in specs if region == FULL or spec.kind == "regional"]
    return [(task, name, region) for task in runs.by_camera.tasks for name in chosen]


def _unmarked(table: Table) -> Table:
    """The table without ranks: verdicts are those of the endpoints."""
    plain = table.mapped(lambda row: replace(row, cells=tuple(replace(c, rank=None) for c in row.cells)))
    return replace(plain, marking="", starred="")


def _machines(runs: RunSet) -> str:
    """The processors used for each subject; paired differences are within a subject, and so on the same processor."""
    trained = runs.rows.select(
        method=ALL, condition=ALL, metric="training_time", task="", region=FULL, seeds=ALL
    )
    by_machine: dict[str, list[str]] = {}
    for subject, rows in trained.groupby("subject", sort=False):
        # An interrupted training has no time, and thus no machine.
        for machine in sorted({*map(str, rows["machine"])} - {""}) or ["unknown processors"]:
            by_machine.setdefault(machine, []).append(str(subject))
    listed = [f"{machine}: subjects {', '.join(subjects)}" for machine, subjects in by_machine.items()]
    return f"Trained on: {'; '.join(listed) or 'unknown processors'}."
