"""Aggregates rows to one number per method, task and metric, or the reason why it is missing."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Literal

import pandas as pd

from ..bench.rows import ALL, FRAME, FULL, LEFT_OUT, Rows


@dataclass(frozen=True)
class Aggregate:
    """A mean; if it is missing, ``value`` is None and ``reason`` states why. With a value, ``reason`` lists what was left out.

    ``spread`` is the standard deviation of the mean over seeds; None with one seed.
    """

    status: Literal["ok", "missing", "failed"]
    value: float | None
    reason: str = ""
    spread: float | None = None


def whole_images(rows: Rows, method: str, metric: str, task: str) -> pd.DataFrame:
    """One metric of one method over whole images and all seeds; ``task`` "" for one of the avatar as a whole.

    Frames that the metric left out are excluded, unless it left out all.
    """
    return _judged(rows.select(method=method, metric=metric, task=task, region=FULL, seeds=ALL))


def _judged(found: pd.DataFrame) -> pd.DataFrame:
    """Rows without frames that their metric left out, unless it left out all."""
    missing = (found["status"] == "missing").to_numpy()
    if not missing.any():
        return found
    kept = ~(missing & found["reason"].str.startswith(LEFT_OUT).to_numpy())
    return found[kept] if kept.any() else found


def summarise(rows: Rows, method: str, metric: str, task: str) -> Aggregate:
    """Aggregate `whole_images`; ``rows`` of all methods determine the frames (``task`` "": subjects)."""
    whole = rows.select(method=method, metric=metric, task=task, region=FULL, seeds=ALL)
    mine = _judged(whole)
    if mine.empty:
        own = rows.select(method=method, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        failed = own[own["status"] == "failed"]
        if len(failed):
            return Aggregate("failed", None, _reason(failed))
        return Aggregate("missing", None, "Not measured: run the comparison with this method and metric.")
    found = set(mine["status"])
    for status in ("failed", "missing"):
        if status in found:
            without = mine[mine["status"] == status]
            reason = _reason(without)
            if len(without) < len(mine):
                reason = f"{len(without)} of {len(mine)} values {status}: {reason}"
            return Aggregate(status, None, reason)  # type: ignore[arg-type]
    expected = len(rows.frames(task, FULL) if task else rows.subjects) * len(rows.seeds(method))
    left_out = whole[whole["status"] == "missing"]
    gap = expected - len(whole)
    if gap:
        what = "frames" if task else "avatars"
        reason = f"{gap} of {expected} {what} have no value: run the comparison to its end."
        return Aggregate("missing", None, reason)
    by_seed = [fmean(means.values()) for means in means_by_seed(mine).values()]
    said = f"Without {len(left_out)} of {len(whole)} frames, {_reason(left_out)}." if len(left_out) else ""
    return Aggregate("ok", fmean(by_seed), said, stdev(by_seed) if len(by_seed) > 1 else None)


def subject_means(rows: pd.DataFrame) -> dict[str, float]:
    """Mean of each subject: over frames of a sequence, then over sequences, then over seeds."""
    by_seed = means_by_seed(rows).values()
    subjects = sorted({subject for means in by_seed for subject in means})
    return {each: fmean(means[each] for means in by_seed if each in means) for each in subjects}


def means_by_seed(rows: pd.DataFrame) -> dict[int, dict[str, float]]:
    """Means over the frames of a sequence, then over sequences, by seed and subject, both sorted.

    Without pandas, whose grouping of a few hundred rows takes twenty times as long.
    """
    frames: dict[tuple[int, str, str], list[float]] = {}
    columns = (rows[name].tolist() for name in ("seed", "subject", "sequence", "value"))
    for seed, subject, sequence, value in zip(*columns, strict=True):
        frames.setdefault((seed, subject, sequence), []).append(float(value))
    sequences: dict[int, dict[str, list[float]]] = {}
    for (seed, subject, _), values in sorted(frames.items()):
        sequences.setdefault(seed, {}).setdefault(subject, []).append(fmean(values))
    return {
        seed: {subject: fmean(means) for subject, means in subjects.items()}
        for seed, subjects in sequences.items()
    }


def _reason(rows: pd.DataFrame) -> str:
    """The reason of the first row in a fixed order, as one line."""
    first = rows.sort_values(["seed", *FRAME]).iloc[0]
    return (
        " ".join(str(first["reason"]).split())
        or f"The rows have the status {first['status']} without a reason."
    )
