"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
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
from ..statistics.command import CompareSettings, compare_methods, equivalence_text
from ..statistics.comparisons import LEVEL as TEST_LEVEL
from ..statistics.comparisons import PairedComparison, as_one_family, compare, subjects_needed
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
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
    confidence = f"{100 * (1 - TEST_LEVEL):g} % interval"
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
        f"these; level {TEST_LEVEL:.0%}."
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


FOLDER = "extremes"
KEPT = ("subject", "method", "seed", "frames", "frames_broken", "measures", "missing", "no_truth")
"""Parts of an avatar's record used in the table."""


def read_extremes(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """Records of all avatars of some runs; none for a run without that test."""
    places = [run / FOLDER / RECORD_FILE for run in runs]
    found = [avatar for place in places if place.is_file() for avatar in read_json(place)["avatars"]]
    return [{name: avatar[name] for name in KEPT if name in avatar} for avatar in found]


def extremes_section(avatars: Sequence[Mapping[str, Any]]) -> str:
    """A table as Markdown: mean, worst value and failed frames of every measure by method; "" without avatars.

    A mean is over the frames of a subject, then over subjects; the worst value is that of any frame.
    """
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for avatar in avatars:
        by_method.setdefault(avatar["method"], []).append(avatar)
    rows: list[list[str]] = []
    notes: dict[str, None] = {}
    for method, own in by_method.items():
        for note in (avatar.get("missing") or avatar.get("no_truth") for avatar in own):
            if note:
                notes[f"`{method}`: {note}"] = None
        shown = [avatar for avatar in own if "missing" not in avatar]
        measures = dict.fromkeys(name for avatar in shown for name in avatar["measures"])
        for name in measures:
            found = [avatar["measures"][name] for avatar in shown if name in avatar["measures"]]
            means = [each["mean"] for each in found if each["mean"] is not None]
            worst = [(each["mean"] or 0.0, each["worst"]) for each in found if each["worst"] is not None]
            if not means or not worst:
                continue
            # If the worst value is the lowest, higher is better.
            lowest = sum(low <= mean for mean, low in worst) * 2 > len(worst)
            extreme = (min if lowest else max)(value for _, value in worst)
            counts = f"{sum(each['failed'] for each in found)} of {sum(each['frames'] for each in found)}"
            rows.append(
                [
                    method,
                    name.replace("_", " "),
                    str(len(means)),
                    f"{fmean(means):.3f}",
                    f"{extreme:.3f}",
                    counts,
                ]
            )
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
    """Differences of ablations from a method, as `difference_table`.

    Parameters
    ----------
    runs : RunSet
        A run with only ``method`` itself and its ablations.
    method : str
        Label of the method, including its condition of tracking for ablations under this condition.
    names : mapping of str
        Name of each ablation by its label.
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

    ``crossed``: differences in novel views minus those in self-reenactment, which show whether a change helps more in one of
    the tasks. Speeds are left out, since those of consecutive runs of the same method differ by up to a tenth.

    Parameters
    ----------
    runs : RunSet
        A run with the labels of ``pairs`` alone.
    pairs : sequence of tuple of str
        Pairs of labels, with one row for each difference, first minus second.
    names : mapping of str
        Name of each row by the first label.
    title, meaning, family : str
        Heading of the rows; sentence about the cells; family of the correction of a column's tests.
    """
    runs = runs.by_camera
    table = table_of(runs)
    bound = {spec.name for spec in runs.metrics if spec.machine_bound}
    kept = tuple(column for column in table.columns if column.metric not in bound)
    if crossed:
        others = [column for column in kept if column.task not in ("", FIRST_TASK)]
        kept = tuple(replace(c, title=f"{TASK_TITLES[FIRST_TASK]} minus {c.title.lower()}") for c in others)
    shown, columns, tested = [], [], []
    for column in kept:
        found = compare(
            *(runs.rows, pairs),
            task=FIRST_TASK if crossed else column.task,
            minus=column.task if crossed else "",
            metric=column.metric,
            higher_is_better=column.higher_is_better,
            level=TEST_LEVEL,
        )
        if not column.task and all(each.difference is None for each in found):
            continue  # metrics of coded avatars, which conditions do not have
        shown.append(column)
        columns.append([_cell(each, column.digits) for each in found])
        tested += [each for each in found if each.p_holm is not None]
    versions = {row.method: row.version for row in table.rows}
    rows = tuple(
        TableRow(names[label], versions[label], False, cells)
        for (label, _), cells in zip(pairs, zip(*columns), strict=True)
    )
    marking = _marking(tested, meaning, family)
    return replace(table, columns=tuple(shown), groups=((title, rows),), notes=(), marking=marking)


def _marking(tested: Sequence[PairedComparison], meaning: str, family: str) -> str:
    test = f"exact sign-flip test over subjects, Holm over the {family} of a column, {TEST_LEVEL:.0%}"
    if any(each.testable for each in tested) or not tested:
        return f"{meaning} Bold: not 0 ({test})."
    first = tested[0]
    needed = subjects_needed(TEST_LEVEL, first.family)
    subjects = counted(first.subjects, "subject")
    return f"{meaning} {subjects} are too few to test whether they differ from 0 (needed: {needed}; {test})."


def _cell(found: PairedComparison, digits: int) -> TableCell:
    if found.difference is None:
        return TableCell("missing", None, found.reason)
    # One digit more than the table, since differences are smaller than values.
    text = found.text(digits + 1)
    differs = found.p_holm is not None and found.p_holm <= TEST_LEVEL
    return TableCell("ok", found.difference, text, rank=1 if differs else None)


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
    lines = [
        ["", "task", "subjects", "seeds", f"mean ({spec.unit})", "SD between subjects", "SD within subjects"]
    ]
    lines.append(["---"] * len(lines[0]))
    for task in runs.tasks:
        values = {
            method: means_by_seed(whole_images(runs.rows, method, COMPARED, task)) for method in runs.ranked
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


NOVEL, METRIC = "novel_view", "psnr"
DROP = "Drop"
DROP_MEANING = f"{DROP} to a task: novel views minus that task."


def drop_table(runs: RunSet) -> Table:
    """PSNR of all tasks, and a last column for each other task: novel views minus that task."""
    table = table_of(runs, columns=Columns((METRIC,)))
    (first,) = (place for place, column in enumerate(table.columns) if column.task == NOVEL)
    others = [place for place in range(len(table.columns)) if place != first]

    def drop(place: int) -> Column:
        shown = table.columns[place]
        title = f"{DROP} to {shown.title.lower()}"
        return Column("", title, METRIC, shown.label, shown.unit, shown.digits, higher_is_better=False)

    def with_drops(row: TableRow) -> TableRow:
        return replace(row, cells=(*row.cells, *(_difference(row, first, place, table) for place in others)))

    columns = (*table.columns, *map(drop, others))
    return replace(table.mapped(with_drops), columns=columns)


def _difference(row: TableRow, first: int, second: int, table: Table) -> TableCell:
    novel, other = row.cells[first].value, row.cells[second].value
    if novel is None or other is None:
        return TableCell("missing", None, "–")
    difference = novel - other
    return TableCell("ok", difference, f"{difference:.{table.columns[second].digits}f}")


def condition_table(runs: RunSet, changed: Mapping[str, str], title: str) -> Table:
    """Effects of a condition, one row per method.

    Parameters
    ----------
    changed : mapping of str
        Label of the method under the condition by its plain label.
    title : str
        Heading of the rows.
    """
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
        "training_processor",
        "training_iterations",
        "training_time",
        "storage",
        "storage_coded",
        "coded_change",
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
    places = [place, *sorted(place.iterdir())] if place.is_dir() else []
    return [each for each in places if RunFolder(each).rows.is_file()]


def suite_report(folder: Path, method: str, read: Callable[[Sequence[Path]], RunSet] = RunSet.read) -> str:
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, conditions, ablations, variance.

    The primary endpoints are first; everything else is labelled as exploratory. Each table is followed by the paired
    differences of all other methods from ``method``, with intervals and tests. Ablations and conditions have such differences
    for whole frames and the face; for whole frames also in each held-out sequence.

    Parameters
    ----------
    folder : Path
        Folder of the suite.
    method : str
        Label of the reference method.
    read : callable
        Reads runs together.
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
        if shown := tuple(spec.name for spec in runs.metrics if spec.name in names and layout in spec.tables):
            text = to_markdown(table_of(runs, layout, columns=Columns(shown))).strip()
            sections.append(f"## {layout.capitalize()} (exploratory)\n\n{text}")
    regions = (FULL, *({"face"} & runs.rows.regions))
    tracking = [c for c in by_condition if c == TRACKED or c.startswith(LEVEL_START)]
    for condition in (*tracking, *({AS_TRACKED} & {*by_condition})):
        changed = {name: label for name, label in by_condition[condition].items() if name in plain}
        own = whole.only([*changed, *changed.values()]).shared
        for region in regions:
            sections.append(_condition_section(own.of(FrameSelection(region)), condition, changed, region))
    ablations: dict[tuple[str, str], dict[str, str]] = {}
    """Name of each ablation by its label, by condition of tracking and method."""
    for condition, by_name in by_condition.items():
        if condition not in ("", EQUAL, AS_TRACKED, *tracking):
            under = next((name for name in tracking if condition.endswith(f"-{name}")), "")
            for name, label in by_name.items():
                ablations.setdefault((under, name), {})[label] = condition.removesuffix(f"-{under}")
    for under, name in sorted(ablations, key=lambda place: ["", *tracking].index(place[0])):
        parts_shown, named = tested if not under else (), ablations[under, name]
        sections += _ablation_sections(whole, by_condition[under][name], named, regions, parts_shown)
    return "\n\n".join(sections) + "\n"


def _ablation_sections(
    whole: RunSet, method: str, names: Mapping[str, str], regions: Sequence[str], tested: Sequence[str]
) -> list[str]:
    """Differences of ablations from a method: whole frames and regions, each held-out sequence, and between the tasks."""
    runs = whole.only([method, *names]).shared
    chosen = [(region, parts) for region, parts in product(regions, ((), *((name,) for name in tested)))]
    tables = {_title("", region, *parts): FrameSelection(region, parts) for region, parts in chosen}
    found = {title: ablation_table(runs.of(part), method, names) for title, part in tables.items()}
    for region in regions:
        title = f"{_title('', region)}, {CROSSED}"
        found[title] = ablation_table(runs.of(FrameSelection(region)), method, names, crossed=True)
    return [
        f"## Ablations of {method}{title} (exploratory)\n\n{to_markdown(table).strip()}"
        for title, table in found.items()
    ]


def _machines(runs: RunSet) -> str:
    """The processors used for each subject; paired differences are within a subject, and so on the same processor."""
    trained = runs.rows.select(
        method=ALL, condition=ALL, metric="training_time", task="", region=FULL, seeds=ALL
    )
    machines: dict[str, set[str]] = {}
    for subject, machine in zip(trained["subject"], trained["machine"]):
        machines.setdefault(str(subject), set()).add(str(machine))
    known: dict[str, list[str]] = {}
    for subject, found in machines.items():
        # An interrupted training has no time, and thus no machine.
        for machine in sorted(found - {""}) or ["unknown processors"]:
            known.setdefault(machine, []).append(subject)
    listed = [f"{machine}: subjects {', '.join(subjects)}" for machine, subjects in known.items()]
    return f"Trained on: {'; '.join(listed) or 'unknown processors'}."


def _condition_section(runs: RunSet, condition: str, changed: Mapping[str, str], region: str) -> str:
    """Values with and without a condition, the drop from novel views to other tasks, and paired differences."""
    level = condition.removeprefix(LEVEL_START)
    of_level = (
        f"Tracking errors of level {level}",
        f"trained and driven with simulated tracking errors of level {level}",
    )
    title, what = CONDITION_TEXTS.get(condition, of_level)
    meaning = f"Under the condition `{condition}`, methods are {what}."
    tables = (drop_table(runs), condition_table(runs, changed, title))
    texts = [
        f"## {_title(title, region)} (exploratory)",
        f"{meaning} {DROP_MEANING}",
        *map(to_markdown, tables),
    ]
    return "\n\n".join(map(str.strip, texts))


def _title(text: str, region: str, *chosen: str) -> str:
    return ", ".join([text, *([] if region == FULL else [region]), *chosen])


def _section(title: str, runs: RunSet, method: str, note: str = "") -> str:
    """A table and, if the method is one of several, the differences of the others from it, below a ``note``."""
    text = f"## {title} (exploratory)\n\n{to_markdown(table_of(runs)).strip()}"
    if method not in runs.ranked or len(runs.ranked) < 2:
        return text
    folders = tuple(str(run.folder.root) for run in runs.runs)
    compared = compare_methods(runs, CompareSettings(folders, against=method))
    return "\n\n".join(filter(None, [text, note, f"```text\n{compared.text}\n```"]))
