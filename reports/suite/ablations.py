"""Paired differences between variants of a method and the method itself: ablations, tracking from images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ..runs import RunSet
from ..statistics.comparisons import PairedComparison, compare, subjects_needed
from ..statistics.paired import LEVEL
from ..table_report import table_of
from ..tables import Table, TableCell, TableRow

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
    return f"{subtracted}, mean over subjects and its {100 * (1 - LEVEL):g} % interval."


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
            level=LEVEL,
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
    test = f"exact sign-flip test over subjects, Holm over the {family} of a column, {LEVEL:.0%}"
    if any(each.testable for each in tested) or not tested:
        return f"{meaning} Bold: not 0 ({test})."
    first = tested[0]
    needed = subjects_needed(LEVEL, first.family)
    subjects = counted(first.subjects, "subject")
    return f"{meaning} {subjects} are too few to test whether they differ from 0 (needed: {needed}; {test})."


def _cell(found: PairedComparison, digits: int) -> TableCell:
    if found.difference is None:
        return TableCell("missing", None, found.reason)
    # One digit more than the table, since differences are smaller than values.
    text = found.text(digits + 1)
    differs = found.p_holm is not None and found.p_holm <= LEVEL
    return TableCell("ok", found.difference, text, rank=1 if differs else None)
