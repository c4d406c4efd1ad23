"""Load, machine and number of threads during the measurement of the times in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from ..bench.rows import ALL, SUSPECT, Rows
from ..bench.specs import ACTING, DYNAMIC, OFF, MetricSpec
from .aggregate import summarise, whole_images

OTHERS_LIMIT = 0.1
"""Times are marked if other processes used more than this number of cores in total.

If one core is busy with other processes for a tenth of the time, a frame with synchronised threads takes at most a tenth
longer.
Consecutive measurements on an idle machine differ by as much.
"""


@dataclass(frozen=True)
class Conditions:
    """Conditions under which the times of one method were measured.

    Attributes
    ----------
    places : frozenset[tuple[str, int]]
        Pairs of machine and number of threads; empty if they were not recorded.
    others : float
        Maximum number of cores used by other processes, 0 if no load was recorded.
    known : bool
        Whether the load was recorded for all of them.
    """

    places: frozenset[tuple[str, int]]
    others: float
    known: bool

    @classmethod
    def of(cls, rows: pd.DataFrame) -> Conditions:
        """Conditions of measured rows, at least one."""
        recorded = rows[rows["threads"] > 0]
        places = frozenset((str(m), int(t)) for m, t in zip(recorded["machine"], recorded["threads"]))
        others = rows["other_cores"].astype(float).dropna()
        return cls(places, float(others.max()) if len(others) else 0.0, len(others) == len(rows))

    @property
    def loaded(self) -> bool:
        """Whether other processes used more than `OTHERS_LIMIT`."""
        return self.others > OTHERS_LIMIT

    @property
    def text(self) -> str:
        """Machines and threads as text; "" if they were not recorded."""
        return "; ".join(
            f"{machine} with {threads} thread{'s' * (threads > 1)}"
            for machine, threads in sorted(self.places)
        )


def conditions(
    rows: Rows, metrics: Sequence[MetricSpec], methods: Sequence[str]
) -> dict[str, dict[str, Conditions]]:
    """Conditions of each machine-dependent metric, by metric and method, for methods with a value."""
    found: dict[str, dict[str, Conditions]] = {}
    for metric in metrics:
        if metric.machine_bound and not metric.per_frame:
            own = {method: whole_images(rows, method, metric.name, "") for method in methods}
            measured = {method: table[table["status"] == "ok"] for method, table in own.items()}
            found[metric.name] = {m: Conditions.of(table) for m, table in measured.items() if len(table)}
    return found


def marks(
    found: Mapping[str, Mapping[str, Conditions]], trivial: Sequence[str]
) -> dict[tuple[str, str], str]:
    """The note for each metric and method whose time is not comparable with the others of its column.

    The note states the highest load in the column, so that its methods share a note.
    """
    notes = {}
    for metric, by_method in found.items():
        places = [each.places for method, each in by_method.items() if method not in trivial and each.places]
        differ = len(set(places)) > 1
        most = max((each.others for each in by_method.values()), default=0.0)
        for method, each in by_method.items():
            note = []
            if each.loaded:
                note.append(f"Measured under load: other processes used up to {most:.2f} cores.")
            if differ and each.places and method not in trivial:
                note.append(f"Measured on {each.text}; not comparable with other machines or thread counts.")
            if note:
                notes[metric, method] = " ".join(note)
    return notes


def suspects(rows: Rows, methods: Sequence[str]) -> dict[tuple[str, str, str], str]:
    """The note for each metric, method and task with values that are marked as suspect in their rows."""
    notes = {}
    for method in methods:
        own = rows.select(method=method, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        own = own[(own["status"] == "ok") & own["reason"].str.startswith(SUSPECT)]
        for (metric, task), found in own.groupby(["metric", "task"]):
            why = str(found["reason"].iloc[0]).removeprefix(SUSPECT)
            notes[str(metric), method, str(task)] = (
                f"Suspect, not ranked: {len(found)} frames are {why}, which a method that has not seen them cannot reach."
            )
    return notes


def mechanisms(rows: Rows, methods: Sequence[str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Note on the mechanism of each method by label, and a sentence on each one that is off, see `Mechanism`."""
    notes, off = {}, []
    for method in methods:
        value = summarise(rows, method, DYNAMIC, "").value
        own = rows.select(method=method, metric=DYNAMIC, task="", region=ALL, seeds=ALL)
        reasons = list(filter(None, map(str, own["reason"])))
        name, _, meaning = "".join(reasons[:1]).partition(": ")
        if value is None or not meaning:
            continue
        name = name.removesuffix(OFF)
        notes[method] = f"{name}: {meaning}."
        if value < ACTING and any(f"{OFF}: " in reason for reason in reasons):
            off.append(f"{method}: {name}{OFF}: {value:.1f} % of the splats change ({meaning}).")
    return notes, tuple(off)


def note_of(by_method: Mapping[str, Conditions]) -> str:
    """One line on methods whose times are not comparable, by `marks`; "" if all are comparable."""
    methods: dict[str, list[str]] = {}
    for (_, method), note in marks({"": by_method}, ()).items():
        methods.setdefault(note, []).append(method)
    return " ".join(f"{', '.join(names)}: {note}" for note, names in methods.items())


def measured_on(by_method: Mapping[str, Conditions], trivial: Sequence[str], machine: str) -> str:
    """Machines and threads of the compared methods; ``machine`` if they were not recorded."""
    compared = {method: each for method, each in by_method.items() if method not in trivial} or by_method
    texts: dict[str, None] = {}
    for each in compared.values():
        if text := each.text or machine:
            texts[text if each.known else f"{text}, load not recorded"] = None
    return "; ".join(texts)
