"""Ranks within a column: all that may be the best first, the others by the digits shown; and the words for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..bench.rows import ALL, Rows
from .aggregate import subject_means
from .statistics.comparisons import LEVEL, BestSet, best_set
from .table_model import Column, TableRow


def best_of_column(
    rows: Rows, lines: Sequence[TableRow], index: int, column: Column, region: str
) -> BestSet | None:
    """Find the methods that may be the best of a column; None where fewer than two have values.

    Floors do not compete.
    """
    competing = _competing(lines, index)
    if len(competing) < 2:
        return None
    means = {
        method: subject_means(
            rows.select(method=method, metric=column.metric, task=column.task, region=region, seeds=ALL)
        )
        for method in competing
    }
    return best_set(means, higher_is_better=column.higher_is_better)


def ranked(
    lines: Sequence[TableRow], columns: Sequence[Column], bests: Sequence[BestSet | None]
) -> list[TableRow]:
    """Rank each column: 1 for all that may be the best and for all that look like one of them, then by digits.

    Where nothing can be told, digits alone decide. Values that look equal share a rank, and the next distinct
    one has the next.
    """
    cells = [list(line.cells) for line in lines]
    for index, (column, best) in enumerate(zip(columns, bests)):
        if best is None:
            continue
        competing = _competing(lines, index)
        shown = {i: float(cells[i][index].text) for i, line in enumerate(lines) if line.method in competing}
        order = sorted(set(shown.values()), reverse=column.higher_is_better)
        first = {value for i, value in shown.items() if best.methods and lines[i].method in best.methods}
        first = first or {order[0]}
        others = [value for value in order if value not in first]
        for i, value in shown.items():
            rank = 1 if value in first else others.index(value) + 2
            cells[i][index] = replace(cells[i][index], rank=rank)
    return [replace(line, cells=tuple(row)) for line, row in zip(lines, cells)]


def marking(columns: Sequence[Column], lines: Sequence[TableRow], bests: Sequence[BestSet | None]) -> str:
    """Say what the marks of a table mean, and by which test; "" where nothing is ranked."""
    ranks = {cell.rank for line in lines for cell in line.cells}
    if not ranks - {None}:
        return ""
    tested = [best for best in bests if best is not None and best.methods is not None]
    open_ = [(c, best) for c, best in zip(columns, bests) if best is not None and best.methods is None]
    places = ", ".join(["second underlined"] + ["third italic"] * (3 in ranks))
    if not tested:
        subjects = " or ".join(sorted({_count(best.subjects) for _, best in open_}))
        needed = max(best.needed for _, best in open_)
        return (
            f"Best bold, {places}, by the digits shown alone: with {subjects} no test can tell the best"
            f" (it takes {needed})."
        )
    subjects = " or ".join(sorted({_count(best.subjects) for best in tested}))
    test = f"exact sign-flip test over {subjects}, each method against all others, Holm, {LEVEL:.0%}"
    text = f"Bold: every method that cannot be told from the best ({test}); the others by the digits shown, {places}."
    if open_:
        names = ", ".join(f"{column.title} {column.label}" for column, _ in open_)
        text += f" Too few subjects for the test, so that the digits alone decide: {names}."
    return text


def _competing(lines: Sequence[TableRow], index: int) -> list[str]:
    return [line.method for line in lines if not line.trivial and line.cells[index].status == "ok"]


def _count(subjects: int) -> str:
    return "1 subject" if subjects == 1 else f"{subjects} subjects"
