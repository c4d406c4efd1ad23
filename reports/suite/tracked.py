"""Tables of methods under a condition of tracking: next to the plain methods, and as differences from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from statistics import fmean

from ...bench.protocol import TASK_TITLES
from ..aggregate import subject_means, whole_images
from ..runs import RunSet
from ..statistics.paired import interval
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
from ..writers import pipe_table
from .ablations import difference_table, meaning_of

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


def drops_by_tracking(runs: RunSet, titles: Mapping[str, str]) -> str:
    """PSNR of novel views minus that of self-reenactment as a Markdown table, a row for each condition of tracking and task.

    Means and intervals are over the subjects that all methods have under all conditions; "" if no method has a condition.

    Parameters
    ----------
    runs : RunSet
        Methods with and without conditions.
    titles : mapping of str
        Title of each condition by its name, "" for that without one.
    """
    labels = {
        condition: {
            record.name: label for label, record in runs.records.items() if record.condition == condition
        }
        for condition in titles
    }
    labels = {condition: own for condition, own in labels.items() if own}
    methods = [name for name in labels.get("", {}) if all(name in own for own in labels.values())]
    if not methods or len(labels) < 2:
        return ""
    shared = runs.only([own[name] for own in labels.values() for name in methods]).shared.by_camera
    lines = [["drop of PSNR, dB", *(f"`{name}`" for name in methods)], ["---", *["---:"] * len(methods)]]
    for task in (task for task in shared.tasks if task != NOVEL):
        for condition, title in ((name, titles[name]) for name in labels):
            row = [f"{TASK_TITLES.get(task, task)}, {title}"]
            for name in methods:
                means = [
                    subject_means(found[found["status"] == "ok"])
                    for each in (NOVEL, task)
                    for found in [whole_images(shared.rows, labels[condition][name], METRIC, each)]
                ]
                values = [
                    value - means[1][subject] for subject, value in means[0].items() if subject in means[1]
                ]
                if not values or len(values) < len(shared.rows.subjects):
                    row.append("–")
                    continue
                bounds = interval(values)
                text = f" ({bounds[0]:.1f}, {bounds[1]:.1f})" if bounds else ""
                row.append(f"{fmean(values):.2f}{text}")
            lines.append(row)
    subjects = ", ".join(sorted(shared.rows.subjects))
    return f"Subjects {subjects}, means and 95 % intervals:\n\n{pipe_table(lines)}"
