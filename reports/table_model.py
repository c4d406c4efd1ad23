"""The table as a typed model: what the writers lay out, and nothing else.

A value is a mean of means: frames -> sequence -> subject -> seed, each level weighing its members equally
(macro), so that a long sequence or a subject with many frames does not outvote the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Column:
    """One metric of one task (``task`` "" for a metric of the avatar as a whole).

    ``published`` columns hold what a paper printed, beside the measured column before them.
    """

    task: str
    title: str
    metric: str
    label: str
    unit: str
    digits: int
    higher_is_better: bool
    published: bool = False

    @property
    def arrow(self) -> str:
        """Which way is better: an arrow up or down."""
        return "↑" if self.higher_is_better else "↓"


@dataclass(frozen=True)
class TableCell:
    """A value, or why there is none.

    Attributes
    ----------
    status : "ok", "missing" (could not or was not measured), "failed" (the method ended in an error), "published"
        (a paper's figure, not measured) or "none" (no paper's figure).
    value : full precision; None unless ok or published.
    text : as displayed.
    spread : standard deviation over seeds, as displayed; "" with one seed.
    rank : 1 for all that may be the best, then 2, 3, ... for the next displayed values; None where nothing is ranked.
    note : index into `Table.notes`, or None.
    """

    status: Literal["ok", "missing", "failed", "published", "none"]
    value: float | None
    text: str
    spread: str = ""
    rank: int | None = None
    note: int | None = None

    @property
    def shown(self) -> str:
        """Value and spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True)
class TableRow:
    """A method's cells, one per column; a trivial method is a floor and never ranked."""

    method: str
    version: str
    trivial: bool
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class TaskSummary:
    """What stands behind a task's columns."""

    task: str
    title: str
    protocol_id: str
    protocol_hash: str
    frames: int
    subjects: int


@dataclass(frozen=True)
class Table:
    """A comparison, ready to be written in any format. ``marking`` tells what the ranks say, and by which test."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[TableRow, ...]], ...]  # (title, rows); empty groups are left out
    notes: tuple[str, ...]
    tasks: tuple[TaskSummary, ...]
    seeds: int
    marking: str = ""
    image_size: str = ""
    machine: str = ""

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """All rows, in order."""
        return tuple(row for _, rows in self.groups for row in rows)

    @property
    def caption(self) -> str:
        """One paragraph: what was measured, on how much, under which protocol, and how it was averaged."""
        parts = []
        for task in self.tasks:
            frames = "1 frame" if task.frames == 1 else f"{task.frames} frames"
            subjects = "1 subject" if task.subjects == 1 else f"{task.subjects} subjects"
            name = f"{task.protocol_id} " if task.protocol_id else ""
            parts.append(f"{task.title}: {frames}, {subjects}, protocol {name}({task.protocol_hash}).")
        if self.image_size:
            parts.append(f"Images of {self.image_size} pixels.")
        parts.append("Mean over frames, then sequences, then subjects; one seed.")
        if self.seeds > 1:
            spread = f"mean of {self.seeds} seeds ± its standard deviation from seed to seed."
            parts[-1] = f"Mean over frames, then sequences, then subjects; {spread}"
        parts += [self.marking] if self.marking else []
        if any(column.published for column in self.columns):
            parts.append(
                "Columns headed published: figures from papers, of other data and code, not comparable."
            )
        if self.machine and any(column.metric == "fps" for column in self.columns):
            parts.append(f"Speed measured on {self.machine}.")
        return " ".join(parts)
