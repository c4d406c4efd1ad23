"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from ...bench.engine.scoring import FULL
from ...bench.engine.store import RunFolder
from ...bench.experiments.suite_settings import AS_TRACKED, EQUAL, LARGE_RUN, LEVEL, RUN, SEEDS_RUN, TRACKED
from ...bench.rows import ALL
from ..runs import WHOLE, FrameSelection, RunSet
from ..statistics.command import CompareSettings, compare_methods
from ..statistics.primary import PAIR, primary_section
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
from ..writers import to_markdown
from .ablations import ablation_table, difference_table, meaning_of
from .extremes import extremes_section, read_extremes
from .variance import variance_section

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
    ablations: dict[str, dict[str, str]] = {name: {} for name in ("", *tracking)}
    """Name of each ablation by its label, for each condition of tracking."""
    for condition, by_name in by_condition.items():
        if method in by_name and condition not in ("", EQUAL, AS_TRACKED, *tracking):
            under = next((name for name in tracking if condition.endswith(f"-{name}")), "")
            ablations[under][by_name[method]] = condition.removesuffix(f"-{under}")
    for under, named in ablations.items():
        if named:
            parts_shown = tested if not under else ()
            sections += _ablation_sections(whole, by_condition[under][method], named, regions, parts_shown)
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
