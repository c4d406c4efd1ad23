"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

from ...bench.engine.scoring import FULL
from ...bench.engine.store import RunFolder
from ...bench.experiments.suite_settings import AS_TRACKED, EQUAL, LARGE_RUN, LEVEL, RUN, TRACKED
from ..runs import FrameSelection, RunSet
from ..statistics.command import CompareSettings, compare_methods
from ..statistics.primary import primary_section
from ..table_report import Columns, table_of
from ..writers import to_markdown
from .ablations import ablation_table
from .tracked import DROP_MEANING, condition_table, drop_table

LARGE = "Images of twice the size"
LEVEL_START = LEVEL.partition("{")[0]
MEANINGS = {
    TRACKED: "trained and driven with tracking that was estimated from the images, otherwise with the capture's own",
    AS_TRACKED: "given the capture's own head model, neck, static offset and views, otherwise those of its publication: another head "
    "model, the neck's rotation merged into the head's, no static offset, one video",
}
AVATAR_TABLES = {
    "cost": ("training_processor", "training_iterations", "training_time", "storage"),
    "speed": ("fps", "fps_one_thread", "fps_without_head", "processor_time"),
}
"""Metrics of the tables without frames, by layout."""


def suite_runs(folder: Path) -> list[list[Path]]:
    """Folders of a suite's finished runs, one for each subject: those of the usual size, then those of twice the size, if any.

    A suite of earlier versions has one run for all subjects.
    """
    parts = []
    for base in (folder / RUN, folder / LARGE_RUN):
        places = [base, *sorted(base.iterdir())] if base.is_dir() else []
        parts.append([place for place in places if RunFolder(place).rows.is_file()])
    return [part for part in parts if part]


def suite_report(folder: Path, method: str) -> str:
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, conditions, ablations.

    The primary endpoints are first; everything else is labelled as exploratory. Under each table are the paired differences of
    every other method from ``method``, with intervals and tests. Those of the ablations and of tracking from images are such
    differences, of whole frames and of the face, the former also in each held-out sequence.

    Parameters
    ----------
    folder : Path
        Folder of the suite.
    method : str
        Label of the method that others are compared with.
    """
    parts = [
        _tables(RunSet.read(runs), method, primary=index == 0)
        for index, runs in enumerate(suite_runs(folder))
    ]
    return f"\n# {LARGE}\n\n".join(parts)


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
    sections = [primary_section(runs)] if primary else []
    sections += [_section(title, runs.of(part), method) for title, part in parts.items()]
    if equal := by_condition.get(EQUAL, {}):
        labels = [equal.get(name, label) for name, label in plain.items() if label not in whole.trivial]
        sections.append(_section("Equal iterations", whole.only(labels).shared.without_conditions, method))
    for layout, names in AVATAR_TABLES.items():
        if own := tuple(spec.name for spec in runs.metrics if spec.name in names and layout in spec.tables):
            text = to_markdown(table_of(runs, layout, columns=Columns(own))).strip()
            sections.append(f"## {layout.capitalize()} (exploratory)\n\n{text}")
    regions = (FULL, *({"face"} & runs.rows.regions))
    tracking = [c for c in by_condition if c == TRACKED or c.startswith(LEVEL_START)]
    for condition in (*tracking, *({AS_TRACKED} & {*by_condition})):
        changed = {name: label for name, label in by_condition[condition].items() if name in plain}
        own = whole.only([*changed, *changed.values()]).shared
        for region in regions:
            sections.append(_condition_section(own.of(FrameSelection(region)), condition, changed, region))
    ablations = [
        label
        for condition, labels in by_condition.items()
        if condition not in ("", EQUAL, AS_TRACKED, *tracking)
        for name, label in labels.items()
        if name == method
    ]
    if ablations:
        runs = whole.only([method, *ablations]).shared
        for region, chosen in product(regions, ((), *((name,) for name in tested))):
            table = ablation_table(runs.of(FrameSelection(region, chosen)), method)
            title = _title(f"Ablations of {method}", region, *chosen)
            sections.append(f"## {title} (exploratory)\n\n{to_markdown(table).strip()}")
        table = ablation_table(runs, method, crossed=True)
        title = f"Ablations of {method}, novel views minus self-reenactment (exploratory)"
        sections.append(f"## {title}\n\n{to_markdown(table).strip()}")
    return "\n\n".join(sections) + "\n"


def _condition_section(runs: RunSet, condition: str, changed: Mapping[str, str], region: str) -> str:
    """Values with and without a condition, the drop from novel views to other tasks, and paired differences."""
    level = condition.removeprefix(LEVEL_START)
    titles = {TRACKED: "Tracked from images", AS_TRACKED: "Capture not converted"}
    title = titles.get(condition, f"Tracking errors of level {level}")
    simulated = f"trained and driven with simulated tracking errors of level {level}"
    meaning = f"Under the condition `{condition}`, methods are {MEANINGS.get(condition, simulated)}."
    tables = (drop_table(runs), condition_table(runs, changed, title))
    texts = [
        f"## {_title(title, region)} (exploratory)",
        f"{meaning} {DROP_MEANING}",
        *map(to_markdown, tables),
    ]
    return "\n\n".join(map(str.strip, texts))


def _title(text: str, region: str, *chosen: str) -> str:
    return ", ".join([text, *([] if region == FULL else [region]), *chosen])


def _section(title: str, runs: RunSet, method: str) -> str:
    """A table and, where the method is among several, their differences from it."""
    text = f"## {title} (exploratory)\n\n{to_markdown(table_of(runs)).strip()}"
    if method not in runs.ranked or len(runs.ranked) < 2:
        return text
    folders = tuple(str(run.folder.root) for run in runs.runs)
    compared = compare_methods(runs, CompareSettings(folders, against=method))
    return f"{text}\n\n```text\n{compared.text}\n```"
