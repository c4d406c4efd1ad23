"""From rows to one number per method, task and metric, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from ..bench.errors import InputError
from ..bench.store import COLUMNS

FRAME = ["subject", "sequence", "timestep", "camera"]
STATUSES = ("ok", "missing", "failed")


@dataclass(frozen=True)
class Aggregate:
    """A mean, or why there is none (``value`` None, ``reason`` says it).

    ``spread`` is the standard deviation of the mean from seed to seed; None with one seed.
    """

    status: Literal["ok", "missing", "failed"]
    value: float | None
    reason: str = ""
    spread: float | None = None


def check_rows(rows: pd.DataFrame) -> None:
    """Raise `InputError` for rows that lack a column, repeat a frame, or call an undefined value measured."""
    missing = [column for column in COLUMNS if column not in rows.columns]
    if missing:
        raise InputError("rows", "columns", ", ".join(COLUMNS), f"no {', '.join(missing)}")
    strange = sorted(set(rows["status"]) - set(STATUSES))
    if strange:
        raise InputError("rows", "status", f"one of {', '.join(STATUSES)}", ", ".join(map(repr, strange)))
    measured = rows[rows["status"] == "ok"]
    undefined = measured[~np.isfinite(measured["value"].astype(float))]
    if len(undefined):
        first = undefined.iloc[0]
        where = f"{first['metric']} of {first['method']}, {first['subject']} {first['timestep']}"
        raise InputError("rows", where, "a finite value", str(first["value"]))
    identity = ["method", "version", "seed", "task", *FRAME, "region", "metric"]
    repeated = rows[rows.duplicated(identity)]
    if len(repeated):
        where = " ".join(str(repeated.iloc[0][column]) for column in identity)
        raise InputError("rows", where, "each frame measured once", "a row that repeats it")
    versions = rows.groupby("method")["version"].nunique()
    mixed = versions[versions > 1]
    if len(mixed):
        found = ", ".join(sorted(set(rows.loc[rows["method"] == mixed.index[0], "version"].astype(str))))
        raise InputError("rows", f"version of {mixed.index[0]}", "one version of each method", found)


def task_frames(rows: pd.DataFrame, task: str) -> set[tuple[str, str, int, str]]:
    """Frames of a task: those that any method has a row for."""
    own = rows[(rows["task"] == task) & (rows["timestep"] >= 0)]
    return set(own[FRAME].drop_duplicates().itertuples(index=False, name=None))


def summarise(rows: pd.DataFrame, own: pd.DataFrame, task: str, metric: str) -> Aggregate:
    """Aggregate one metric of one method.

    Parameters
    ----------
    rows : of all methods; they say which frames (for ``task`` "": which subjects) have to be there.
    own : those of the method.
    """
    mine = own[(own["task"] == task) & (own["metric"] == metric)]
    if mine.empty:
        failed = own[own["status"] == "failed"]
        if len(failed):
            return Aggregate("failed", None, _because(failed))
        return Aggregate("missing", None, "Not measured: run the comparison with this method and metric.")
    for status in ("failed", "missing"):
        without = mine[mine["status"] == status]
        if len(without):
            reason = _because(without)
            if len(without) < len(mine):
                reason = f"{len(without)} of {len(mine)} values {status}: {reason}"
            return Aggregate(status, None, reason)  # type: ignore[arg-type]
    expected = task_frames(rows, task) if task else {(s,) for s in set(rows["subject"])}
    seeds = set(own["seed"])
    gap = len(expected) * len(seeds) - len(mine)
    if gap:
        what = "frames" if task else "avatars"
        reason = f"{gap} of {len(expected) * len(seeds)} {what} have no value: run the comparison to its end."
        return Aggregate("missing", None, reason)
    by_seed = _subject_means(mine).groupby(level="seed").mean()
    spread = float(by_seed.std(ddof=1)) if len(by_seed) > 1 else None
    return Aggregate("ok", macro_mean(mine), spread=spread)


def macro_mean(rows: pd.DataFrame) -> float:
    """Mean over frames of a sequence, then over sequences, then over subjects, then over seeds."""
    return float(_subject_means(rows).groupby(level="seed").mean().mean())


def subject_means(rows: pd.DataFrame) -> dict[str, float]:
    """Mean of each subject: over frames of a sequence, then over sequences, then over seeds."""
    means = _subject_means(rows).groupby(level="subject").mean()
    return {str(subject): float(value) for subject, value in means.items()}


def _subject_means(rows: pd.DataFrame) -> pd.Series[float]:
    """Means over frames and sequences, by seed and subject."""
    values = rows.assign(value=rows["value"].astype(float))
    sequences = values.groupby(["seed", "subject", "sequence"])["value"].mean()
    return sequences.groupby(level=["seed", "subject"]).mean()


def _because(rows: pd.DataFrame) -> str:
    """Return the reason of the first row in a fixed order, as one line."""
    first = rows.sort_values(["seed", *FRAME]).iloc[0]
    return " ".join(str(first["reason"]).split()) or f"The rows say {first['status']} and give no reason."
