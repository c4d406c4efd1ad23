"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from ...bench.engine.scoring import FULL
from ...bench.experiments.suite_settings import TRACKED
from ..runs import FrameSelection, RunSet
from ..statistics.command import CompareSettings, compare_methods
from ..statistics.primary import primary_section
from ..table_report import table_of
from ..writers import to_markdown
from .ablations import ablation_table
from .tracked import DROP, drop_table, tracked_table

LARGE = "Images of twice the size"
MEANING = (
    f"Under the condition `{TRACKED}`, methods are trained and driven with tracking that was estimated from the images, otherwise "
    f"with the capture's own. {DROP} to a task: novel views minus that task."
)


def suite_report(runs: Sequence[Path], method: str) -> str:
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, tracking from images, ablations.

    The primary endpoints are first; everything else is labelled as exploratory. Under each table are the paired differences of
    every other method from ``method``, with intervals and tests. Those of the ablations and of tracking from images are such
    differences, of whole frames and of the face, the former also in each held-out sequence.

    Parameters
    ----------
    runs : sequence of Path
        Folders of the run of a suite and, if there is one, of that with images of twice the size.
    method : str
        Label of the method that others are compared with.
    """
    parts = [_tables(RunSet.read([folder]), method, primary=folder == runs[0]) for folder in runs]
    return f"\n# {LARGE}\n\n".join(parts)


def _tables(read: RunSet, method: str, *, primary: bool) -> str:
    whole = read.by_camera
    changed = [label for label, record in whole.records.items() if record.condition]
    runs = whole.only([label for label in whole.records if label not in changed])
    tested = sorted({frame[1] for frame in read.rows.frames("self_reenactment", FULL)})
    parts = {"All frames": FrameSelection()}
    parts |= {f"Region {region}": FrameSelection(region) for region in sorted(runs.rows.regions - {FULL})}
    parts |= {f"Sequence {name}": FrameSelection(sequences=(name,)) for name in tested}
    sections = [primary_section(runs)] if primary else []
    sections += [_section(title, runs.of(part), method) for title, part in parts.items()]
    regions = (FULL, *({"face"} & runs.rows.regions))
    tracked = {whole.records[label].name: label for label in changed if _is_tracked(whole, label)}
    if tracked:
        runs = whole.only([*tracked, *tracked.values()])
        for region in regions:
            of_region = runs.of(FrameSelection(region))
            tables = (drop_table(of_region), tracked_table(of_region, tracked))
            texts = [
                f"## {_title('Tracked from images', region)} (exploratory)",
                MEANING,
                *map(to_markdown, tables),
            ]
            sections.append("\n\n".join(map(str.strip, texts)))
    ablations = [label for label in changed if not _is_tracked(whole, label)]
    if ablations:
        runs = whole.only([method, *ablations])
        for region, chosen in product(regions, ((), *((name,) for name in tested))):
            table = ablation_table(runs.of(FrameSelection(region, chosen)), method)
            title = _title(f"Ablations of {method}", region, *chosen)
            sections.append(f"## {title} (exploratory)\n\n{to_markdown(table).strip()}")
        table = ablation_table(runs, method, crossed=True)
        title = f"Ablations of {method}, novel views minus self-reenactment (exploratory)"
        sections.append(f"## {title}\n\n{to_markdown(table).strip()}")
    return "\n\n".join(sections) + "\n"


def _is_tracked(runs: RunSet, label: str) -> bool:
    return runs.records[label].condition == TRACKED


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
