"""The results of a suite as Markdown: tables by region and by held-out sequence, with differences from a method."""

from __future__ import annotations

from itertools import product
from pathlib import Path

from ...bench.engine.scoring import FULL
from ..runs import FrameSelection, RunSet
from ..statistics.command import CompareSettings, compare_methods
from ..statistics.primary import primary_section
from ..table_report import table_of
from ..writers import to_markdown
from .ablations import ablation_table


def suite_report(run: Path, method: str) -> str:
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, and the ablations of a method.

    The primary endpoints are first; everything else is labelled as exploratory. Under each table are the paired differences of every other method from ``method``, with intervals and tests. Those of the
    ablations are such differences, of whole frames and of the face, in all sequences and in each held-out one.
    """
    read = RunSet.read([run])
    tested = sorted({frame[1] for frame in read.rows.frames("self_reenactment", FULL)})
    whole = read.by_camera
    ablations = [label for label, record in whole.records.items() if record.condition]
    runs = whole.only([label for label in whole.records if label not in ablations])
    parts = {"All frames": FrameSelection()}
    parts |= {f"Region {region}": FrameSelection(region) for region in sorted(runs.rows.regions - {FULL})}
    parts |= {f"Sequence {name}": FrameSelection(sequences=(name,)) for name in tested}
    sections = [primary_section(runs)]
    sections += [_section(title, runs.of(part), method) for title, part in parts.items()]
    if ablations:
        runs = whole.only([method, *ablations])
        for region, chosen in product((FULL, "face"), ((), *((name,) for name in tested))):
            title = ", ".join([f"Ablations of {method}", *([] if region == FULL else [region]), *chosen])
            table = ablation_table(runs.of(FrameSelection(region, chosen)), method)
            sections.append(f"## {title} (exploratory)\n\n{to_markdown(table).strip()}")
        table = ablation_table(runs, method, crossed=True)
        title = f"Ablations of {method}, novel views minus self-reenactment (exploratory)"
        sections.append(f"## {title}\n\n{to_markdown(table).strip()}")
    return "\n\n".join(sections) + "\n"


def _section(title: str, runs: RunSet, method: str) -> str:
    """A table and, where the method is among several, their differences from it."""
    text = f"## {title} (exploratory)\n\n{to_markdown(table_of(runs)).strip()}"
    if method not in runs.ranked or len(runs.ranked) < 2:
        return text
    folders = tuple(str(run.folder.root) for run in runs.runs)
    compared = compare_methods(runs, CompareSettings(folders, against=method))
    return f"{text}\n\n```text\n{compared.text}\n```"
