"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, product
from math import sqrt
from pathlib import Path
from statistics import fmean, stdev, variance
from typing import Any

from ...bench.engine.store import RunFolder
from ...bench.experiments.specs import (
    AS_TRACKED,
    EQUAL,
    LARGE_RUN,
    LEVEL,
    RECORD_FILE,
    RUN,
    SEEDS_RUN,
    TRACKED,
)
from ...bench.io.documents import read_json
from ...bench.progress import counted
from ...bench.protocol import SEEN_CAMERAS, TASK_TITLES, UNSEEN_CAMERAS
from ...bench.rows import ALL, FULL
from ..aggregate import means_by_seed, whole_images
from ..runs import WHOLE, FrameSelection, RunSet, synthetic_settings
from ..statistics.command import compare_methods, equivalence_text
from ..statistics.comparisons import LEVEL as TEST_LEVEL
from ..statistics.comparisons import PairedComparison, as_one_family, compare, subjects_needed
from ..table_report import Columns, table_of
from ..tables import Table, TableCell, TableRow
from ..writers import pipe_table, to_markdown

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
    comparisons = []
    for task, metric in PRIMARY:
        rising, margin = specs[metric].higher_is_better, MARGINS.get(metric)
        comparisons += compare(
            runs.rows, [PAIR], task=task, metric=metric, higher_is_better=rising, margin=margin
        )
    return as_one_family(comparisons)


def planned_subjects(runs: RunSet) -> int:
    """Planned number of subjects of the runs' synthetic captures; 0 if not recorded."""
    settings = [synthetic_settings(clip) for run in runs.runs for clip in run.manifest.clips]
    return max((int(values.get("subjects", 0)) for values in settings), default=0)


def primary_table(runs: RunSet) -> str:
    """Differences, intervals and verdicts of the primary endpoints as a Markdown table; "" if the runs lack them.

    As long as planned subjects are missing, the results are interim and have no verdict: testing again after
    each further subject would reject too often.
    """
    endpoints = primary_comparisons(runs)
    if not endpoints:
        return ""
    specs, planned = {spec.name: spec for spec in runs.metrics}, planned_subjects(runs)
    confidence = f"{100 * (1 - TEST_LEVEL):g} % interval"
    lines = [["endpoint", f"{PAIR[0]} - {PAIR[1]}", confidence, "p", "Holm", "", "equivalence"], ["---"] * 7]
    for c in endpoints:
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
        f"not reject. Exact sign-flip tests over subjects, Holm over the {sum(c.p is not None for c in endpoints)} endpoints with values; "
        "equivalence by two one-sided sign-flip tests, which assume that subjects differ symmetrically about the mean, Holm over "
        f"these; level {TEST_LEVEL:.0%}."
    )
    return f"{pipe_table(lines)}\n\n{how}"


def primary_section(runs: RunSet) -> str:
    """The primary endpoints as Markdown, with the status of the page's other tests."""
    exploratory = (
        "All other tests on this page are exploratory. They are corrected over the comparisons of one metric and task, "
        "including the primary endpoints."
    )
    none = f"These runs have none: primary endpoints compare `{PAIR[0]}` with `{PAIR[1]}`."
    return f"## Primary endpoints\n\n{primary_table(runs) or none} {exploratory}"


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
    return "\n\n".join(
        ["## New poses and views (exploratory)", how, text, *(f"Missing: {note}" for note in notes)]
    )


FIRST_TASK = "novel_view"


def ablation_table(runs: RunSet, method: str, names: Mapping[str, str], *, crossed: bool = False) -> Table:
    """Differences of ablations from a method, as `difference_table`; ``runs`` have only these.

    ``method`` is the label with its condition of tracking, ``names`` has the name of each ablation by its label.
    """
    pairs = [(label, method) for label in names]
    meaning = meaning_of("Ablation minus method")
    if crossed:
        both = "Ablation minus method in novel views, minus the same difference in self-reenactment"
        meaning = f"{meaning_of(both)} It is 0 where an ablation changes both tasks alike."
    return difference_table(runs, pairs, names, "Ablations", meaning, "ablations", crossed=crossed)


def meaning_of(subtracted: str) -> str:
    """Sentence about the cells of a table of differences."""
    return f"{subtracted}, mean over subjects and its {100 * (1 - TEST_LEVEL):g} % interval."


def difference_table(
    runs: RunSet,
    pairs: Sequence[tuple[str, str]],
    names: Mapping[str, str],
    title: str,
    meaning: str,
    family: str,
    *,
    crossed: bool = False,
) -> Table:
    """Paired differences, in the machine-independent columns of the comparison table.

    ``runs`` have the labels of ``pairs`` alone; each pair is a row, first minus second, named after the first label by
    ``names`` under the heading ``title``. ``meaning`` is a sentence about the cells, ``family`` that of the correction of a
    column's tests. ``crossed``: differences in novel views minus those in self-reenactment, which show whether a change helps
    more in one of the tasks. Speeds are left out, since those of consecutive runs of the same method differ by up to a tenth.
    """
    runs = runs.by_camera
    table = table_of(runs)
    bound = {spec.name for spec in runs.metrics if spec.machine_bound}
    offered = [column for column in table.columns if column.metric not in bound]
    if crossed:
        others = [column for column in offered if column.task not in ("", FIRST_TASK)]
        offered = [replace(c, title=f"{TASK_TITLES[FIRST_TASK]} minus {c.title.lower()}") for c in others]
    columns, cells_of, tested = [], [], []
    for column in offered:
        task, minus = (FIRST_TASK, column.task) if crossed else (column.task, "")
        metric, rising = column.metric, column.higher_is_better
        comparisons = compare(
            runs.rows, pairs, task=task, metric=metric, minus=minus, higher_is_better=rising
        )
        if not column.task and all(c.difference is None for c in comparisons):
            continue  # metrics of coded avatars, which conditions do not have
        columns.append(column)
        cells_of.append([_cell(c, column.digits) for c in comparisons])
        tested += [c for c in comparisons if c.p_holm is not None]
    versions = {row.method: row.version for row in table.rows}
    rows = tuple(
        TableRow(names[label], versions[label], False, cells)
        for (label, _), cells in zip(pairs, zip(*cells_of), strict=True)
    )
    marking = _marking(tested, meaning, family)
    return replace(table, columns=tuple(columns), groups=((title, rows),), notes=(), marking=marking)


def _marking(tested: Sequence[PairedComparison], meaning: str, family: str) -> str:
    test = f"exact sign-flip test over subjects, Holm over the {family} of a column, {TEST_LEVEL:.0%}"
    if any(comparison.testable for comparison in tested) or not tested:
        return f"{meaning} Bold: not 0 ({test})."
    first = tested[0]
    needed = subjects_needed(TEST_LEVEL, first.family)
    subjects = counted(first.subjects, "subject")
    return f"{meaning} {subjects} are too few to test whether they differ from 0 (needed: {needed}; {test})."


def _cell(comparison: PairedComparison, digits: int) -> TableCell:
    if comparison.difference is None:
        return TableCell("missing", None, comparison.reason)
    differs = comparison.p_holm is not None and comparison.p_holm <= TEST_LEVEL
    # One digit more than the table, since differences are smaller than values.
    return TableCell("ok", comparison.difference, comparison.text(digits + 1), rank=1 if differs else None)


COMPARED = "psnr"


def variance_section(runs: RunSet, pair: tuple[str, str]) -> str:
    """A table of standard deviations as Markdown, a row for each method and task and for the difference of ``pair``; "" with one seed.

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
            if parts := components(by_seed):
                subjects, mean, between, within = parts
                place = [name, TASK_TITLES.get(task, task), str(subjects), str(len(by_seed))]
                text = f"{mean:+.2f}" if name not in runs.ranked else f"{mean:.2f}"
                lines.append([*place, text, f"{between:.3f}", f"{within:.3f}"])
    how = (
        "Standard deviations: between subjects, of the means over seeds; within subjects, over seeds, pooled. "
        "Differences are between trainings with the same seed."
    )
    return f"## Variance between and within subjects (exploratory)\n\n{pipe_table(lines)}\n\n{how}"


def components(by_seed: Mapping[int, Mapping[str, float]]) -> tuple[int, float, float, float] | None:
    """Number of subjects with every seed, mean, standard deviations between and within; None with fewer than two of either."""
    subjects = sorted(set.intersection(*(set(means) for means in by_seed.values()))) if by_seed else []
    if len(by_seed) < 2 or len(subjects) < 2:
        return None
    values = {subject: [means[subject] for means in by_seed.values()] for subject in subjects}
    centres = [fmean(of_seeds) for of_seeds in values.values()]
    within = sqrt(fmean(variance(of_seeds) for of_seeds in values.values()))
    return len(subjects), fmean(centres), stdev(centres), within


DROP = "Drop"
DROP_MEANING = f"{DROP} to a task: novel views minus that task."


def drop_table(runs: RunSet) -> Table:
    """PSNR of all tasks, and a last column for each other task: novel views minus that task."""
    table = table_of(runs, columns=Columns((COMPARED,)))
    (first,) = (index for index, column in enumerate(table.columns) if column.task == FIRST_TASK)
    others = [index for index in range(len(table.columns)) if index != first]
    columns = [table.columns[index] for index in others]
    drops = (
        replace(c, task="", title=f"{DROP} to {c.title.lower()}", higher_is_better=False) for c in columns
    )

    def with_drops(row: TableRow) -> TableRow:
        cells, novel = list(row.cells), row.cells[first].value
        for index in others:
            other = row.cells[index].value
            if novel is None or other is None:
                cells.append(TableCell("missing", None, "–"))
            else:
                text = f"{novel - other:.{table.columns[index].digits}f}"
                cells.append(TableCell("ok", novel - other, text))
        return replace(row, cells=tuple(cells))

    return replace(table.mapped(with_drops), columns=(*table.columns, *drops))


def condition_table(runs: RunSet, changed: Mapping[str, str], title: str) -> Table:
    """Effects of a condition, one row per method; ``changed`` has the label under the condition by the plain label."""
    pairs = [(label, method) for method, label in changed.items()]
    names = {label: method for method, label in changed.items()}
    return difference_table(
        runs, pairs, names, title, meaning_of("With the condition minus without"), "methods"
    )


LARGE = "Images of twice the size"
CROSSED = "novel views minus self-reenactment"
LEVEL_START = LEVEL.partition("{")[0]
ENDPOINTS = (
    f"PSNR and LPIPS of `{PAIR[0]}` and `{PAIR[1]}` are primary endpoints: their verdicts are those [above](#primary-endpoints). The lines "
    "below are corrected over the comparisons of one metric and task instead."
)
CONDITION_TEXTS = {
    TRACKED: (
        "Tracked from images",
        "trained and driven with tracking that was estimated from the images, otherwise with the capture's own",
    ),
    AS_TRACKED: (
        "Capture not converted",
        (
            "given the capture's own head model, neck, static offset and views, otherwise those of its publication: another head "
            "model, the neck's rotation merged into the head's, no static offset, one video"
        ),
    ),
}
"""Title of the section of a condition, and what methods are under it; all others are levels of tracking errors."""
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
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, conditions, ablations, variance.

    The primary endpoints are first; everything else is labelled as exploratory. Each table is followed by the paired
    differences of all other methods from ``method``, with intervals and tests. Ablations and conditions have such differences
    for whole frames and the face; for whole frames also in each held-out sequence. ``read`` reads runs together.
    """
    runs, large, seeds = (suite_runs(folder, base) for base in (RUN, LARGE_RUN, SEEDS_RUN))
    text = _tables(read(runs), method, primary=True)
    if section := extremes_section(read_extremes(runs)):
        text += f"\n{section}\n"
    if seeds:
        names = [run.name for run in seeds]
        both = read([*(run for run in runs if run.name in names), *seeds])
        text += f"\n{variance_section(both.only([*both.ranked]), PAIR)}\n"
    if large:
        text += f"\n# {LARGE}\n\n{_tables(read(large), method, primary=False)}"
    return text


def _tables(read: RunSet, method: str, *, primary: bool) -> str:
    whole = read.by_camera
    by_condition: dict[str, dict[str, str]] = {}
    for label, record in whole.records.items():
        by_condition.setdefault(record.condition, {})[record.name] = label
    plain = by_condition[""]
    unconverted = by_condition.get(AS_TRACKED, {})
    runs = whole.only([*plain.values(), *unconverted.values()]).shared
    tested = sorted({frame[1] for frame in read.rows.frames("self_reenactment", FULL)})
    parts = {"All frames": FrameSelection()}
    parts |= {f"Region {region}": FrameSelection(region) for region in sorted(runs.rows.regions - {FULL})}
    parts |= {f"Sequence {name}": FrameSelection(sequences=(name,)) for name in tested}
    sections = [primary_section(runs), _machines(read)] if primary else []
    whole_frames = ENDPOINTS if primary and {*PAIR} <= {*runs.ranked} else ""
    sections += [
        _section(title, runs.of(part), method, whole_frames if part == WHOLE else "")
        for title, part in parts.items()
    ]
    if equal := by_condition.get(EQUAL, {}):
        budgets = {name: whole.records[label].budget.get("iterations") for name, label in plain.items()}
        count = whole.records[next(iter(equal.values()))].budget.get("iterations")
        same = {name: plain[name] for name, budget in budgets.items() if budget == count}
        labels = [label for label in ({**same, **equal}).values() if label not in whole.trivial]
        sections.append(_section("Equal iterations", whole.only(labels).shared.without_conditions, method))
    for layout, names in AVATAR_TABLES.items():
        if columns := tuple(m.name for m in runs.metrics if m.name in names and layout in m.tables):
            text = to_markdown(table_of(runs, layout, columns=Columns(columns))).strip()
            sections.append(f"## {layout.capitalize()} (exploratory)\n\n{text}")
    regions = (FULL, *({"face"} & runs.rows.regions))
    tracking = [c for c in by_condition if c == TRACKED or c.startswith(LEVEL_START)]
    for condition in (*tracking, *({AS_TRACKED} & {*by_condition})):
        changed = {name: label for name, label in by_condition[condition].items() if name in plain}
        pairs = whole.only([*changed, *changed.values()]).shared
        for region in regions:
            sections.append(_condition_section(pairs.of(FrameSelection(region)), condition, changed, region))
    ablations: dict[tuple[str, str], dict[str, str]] = {}
    """Name of each ablation by its label, by condition of tracking and method."""
    for condition, by_name in by_condition.items():
        if condition not in ("", EQUAL, AS_TRACKED, *tracking):
            under = next((name for name in tracking if condition.endswith(f"-{name}")), "")
            for name, label in by_name.items():
                ablations.setdefault((under, name), {})[label] = condition.removesuffix(f"-{under}")
    for under, name in sorted(ablations, key=lambda place: ["", *tracking].index(place[0])):
        sequences, names_of = tested if not under else (), ablations[under, name]
        sections += _ablation_sections(whole, by_condition[under][name], names_of, regions, sequences)
    return "\n\n".join(sections) + "\n"


def _ablation_sections(
    whole: RunSet, method: str, names: Mapping[str, str], regions: Sequence[str], tested: Sequence[str]
) -> list[str]:
    """Differences of ablations from a method: whole frames and regions, each held-out sequence, and between the tasks."""
    runs = whole.only([method, *names]).shared
    tables = {}
    for region, sequences in product(regions, ((), *((name,) for name in tested))):
        part = FrameSelection(region, sequences)
        tables[_title("", region, *sequences)] = ablation_table(runs.of(part), method, names)
    for region in regions:
        title = f"{_title('', region)}, {CROSSED}"
        tables[title] = ablation_table(runs.of(FrameSelection(region)), method, names, crossed=True)
    return [
        f"## Ablations of {method}{title} (exploratory)\n\n{to_markdown(table).strip()}"
        for title, table in tables.items()
    ]


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


def _condition_section(runs: RunSet, condition: str, changed: Mapping[str, str], region: str) -> str:
    """Values with and without a condition, the drop from novel views to other tasks, and paired differences."""
    level = condition.removeprefix(LEVEL_START)
    of_level = (
        f"Tracking errors of level {level}",
        f"trained and driven with simulated tracking errors of level {level}",
    )
    title, what = CONDITION_TEXTS.get(condition, of_level)
    meaning = f"Under the condition `{condition}`, methods are {what}. {DROP_MEANING}"
    tables = map(to_markdown, (drop_table(runs), condition_table(runs, changed, title)))
    return "\n\n".join(map(str.strip, [f"## {_title(title, region)} (exploratory)", meaning, *tables]))


def _title(text: str, region: str, *chosen: str) -> str:
    return ", ".join([text, *([] if region == FULL else [region]), *chosen])


def _section(title: str, runs: RunSet, method: str, note: str = "") -> str:
    """A table and, if the method is one of several, the differences of the others from it, below a ``note``."""
    text = f"## {title} (exploratory)\n\n{to_markdown(table_of(runs)).strip()}"
    if method not in runs.ranked or len(runs.ranked) < 2:
        return text
    return "\n\n".join(filter(None, [text, note, f"```text\n{compare_methods(runs, method).text}\n```"]))
