"""From rows to the numbers of tables: means, columns of coded avatars, and remarks on what cannot be compared.

A number of a method, task and metric is a mean over frames, sequences, subjects and seeds, or the reason why it is missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Literal

from ..bench.engine.config import CODED
from ..bench.errors import InputError
from ..bench.manifest import Manifest, MethodRecord
from ..bench.rows import ALL, FRAME, FULL, LEFT_OUT, SUSPECT, Row, Rows
from ..bench.specs import ACTING, DYNAMIC, OFF, MetricSpec

if TYPE_CHECKING:
    import pandas as pd

AVERAGED = "frames, then sequences, then subjects"


@dataclass(frozen=True)
class Aggregate:
    """A mean over frames, then sequences, subjects and seeds."""

    status: Literal["ok", "missing", "failed"]
    value: float | None
    reason: str = ""  # why the value is missing, or what it was taken without
    spread: float | None = None  # standard deviation of the mean over seeds; None with one seed


def whole_images(rows: Rows, method: str, metric: str, task: str) -> pd.DataFrame:
    """One metric of one method over whole images and all seeds; ``task`` "" for one of the avatar as a whole.

    Frames that the metric left out are excluded, unless it left out all.
    """
    return _judged(rows.select(method=method, metric=metric, task=task, region=FULL, seeds=ALL))


def _judged(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows without frames that their metric left out, unless it left out all."""
    missing = (rows["status"] == "missing").to_numpy()
    if not missing.any():
        return rows
    judged = ~(missing & rows["reason"].str.startswith(LEFT_OUT).to_numpy())
    return rows[judged] if judged.any() else rows


def summarise(rows: Rows, method: str, metric: str, task: str) -> Aggregate:
    """Aggregate `whole_images`; ``rows`` of all methods determine the frames (``task`` "": subjects)."""
    whole = rows.select(method=method, metric=metric, task=task, region=FULL, seeds=ALL)
    judged = _judged(whole)
    if judged.empty:
        every = rows.select(method=method, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        failed = every[every["status"] == "failed"]
        if len(failed):
            return Aggregate("failed", None, _reason(failed))
        return Aggregate("missing", None, "Not measured: run the comparison with this method and metric.")
    statuses: tuple[Literal["failed", "missing"], ...] = ("failed", "missing")
    for status in statuses:
        if len(without := judged[judged["status"] == status]):
            count = f"{len(without)} of {len(judged)} values {status}: " * (len(without) < len(judged))
            return Aggregate(status, None, count + _reason(without))
    expected = len(rows.frames(task, FULL) if task else rows.subjects) * len(rows.seeds(method))
    if gap := expected - len(whole):
        what = "frames" if task else "avatars"
        reason = f"{gap} of {expected} {what} have no value: run the comparison to its end."
        return Aggregate("missing", None, reason)
    by_seed = [fmean(means.values()) for means in means_by_seed(judged).values()]
    left_out = whole[whole["status"] == "missing"]
    reason = f"Without {len(left_out)} of {len(whole)} frames, {_reason(left_out)}." if len(left_out) else ""
    return Aggregate("ok", fmean(by_seed), reason, stdev(by_seed) if len(by_seed) > 1 else None)


def subject_means(rows: pd.DataFrame) -> dict[str, float]:
    """Mean of each subject: over frames of a sequence, then over sequences, then over seeds."""
    by_seed = means_by_seed(rows).values()
    subjects = sorted({subject for means in by_seed for subject in means})
    return {name: fmean(means[name] for means in by_seed if name in means) for name in subjects}


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
    reason = " ".join(str(first["reason"]).split())
    return reason or f"The rows have the status {first['status']} without a reason."


OTHERS_LIMIT = 0.1
"""Times are marked if other processes used more than this number of cores in total.

If one core is busy with other processes for a tenth of the time, a frame with synchronised threads takes at most a tenth
longer. Consecutive measurements on an idle machine differ by as much.
"""


@dataclass(frozen=True)
class Conditions:
    """Conditions under which the times of one method were measured."""

    places: frozenset[tuple[str, int]]  # machine and number of threads; empty if they were not recorded
    others: float  # maximum number of cores used by other processes, 0 if no load was recorded
    known: bool  # whether the load was recorded for all of them

    @classmethod
    def of(cls, rows: pd.DataFrame) -> Conditions:
        """Conditions of measured rows, at least one."""
        recorded = rows[rows["threads"] > 0]
        places = frozenset((str(m), int(t)) for m, t in zip(recorded["machine"], recorded["threads"]))
        others = rows["other_cores"].astype(float).dropna()
        return cls(places, float(others.max()) if len(others) else 0.0, len(others) == len(rows))

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
    by_metric: dict[str, dict[str, Conditions]] = {}
    for metric in metrics:
        if metric.machine_bound and not metric.per_frame:
            tables = {method: whole_images(rows, method, metric.name, "") for method in methods}
            measured = {method: table[table["status"] == "ok"] for method, table in tables.items()}
            by_metric[metric.name] = {m: Conditions.of(table) for m, table in measured.items() if len(table)}
    return by_metric


def marks(
    by_metric: Mapping[str, Mapping[str, Conditions]], trivial: Sequence[str]
) -> dict[tuple[str, str], str]:
    """The note for each metric and method whose time is not comparable with the others of its column.

    The note states the highest load in the column, so that its methods share a note.
    """
    notes = {}
    for metric, by_method in by_metric.items():
        places = [each.places for method, each in by_method.items() if method not in trivial and each.places]
        differ = len(set(places)) > 1
        most = max((each.others for each in by_method.values()), default=0.0)
        for method, each in by_method.items():
            note = []
            if each.others > OTHERS_LIMIT:
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
        values = rows.select(method=method, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        values = values[(values["status"] == "ok") & values["reason"].str.startswith(SUSPECT)]
        for (metric, task), frames in values.groupby(["metric", "task"]):
            why = str(frames["reason"].iloc[0]).removeprefix(SUSPECT)
            notes[str(metric), method, str(task)] = (
                f"Suspect, not ranked: {len(frames)} frames are {why}, which a method that has not seen them cannot reach."
            )
    return notes


def mechanisms(rows: Rows, methods: Sequence[str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Note on the mechanism of each method by label, and a sentence on each one that is off, see `Mechanism`."""
    notes, off = {}, []
    for method in methods:
        value = summarise(rows, method, DYNAMIC, "").value
        measured = rows.select(method=method, metric=DYNAMIC, task="", region=ALL, seeds=ALL)
        reasons = list(filter(None, map(str, measured["reason"])))
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


STORAGE, QUALITY, SPEED, LATENCY = "storage", "psnr", "fps", "latency_p50"
TASKS = ("novel_view", "self_reenactment")
NO_FRAMES = "The run has frames of neither task."
STORAGE_CODED = MetricSpec(
    *("storage_coded", "Coded", "MB"),
    higher_is_better=False,
    digits=2,
    implementation="headbench.reports.aggregate:with_coded",
    summary="Bytes of the files through the codec of all methods, SI megabytes.",
    kind="avatar",
    tables=("comparison", "cost"),
)
CODED_CHANGE = MetricSpec(
    *("coded_change", "By coding", "dB"),
    higher_is_better=True,
    digits=2,
    implementation="headbench.reports.aggregate:with_coded",
    summary="PSNR of the coded avatar minus that of the trained one, on the same frames; the lower one of the tasks' means.",
    kind="avatar",
    tables=("comparison", "cost"),
)


def with_coded(manifest: Manifest, rows: Rows) -> tuple[Manifest, Rows]:
    """Convert cells of the condition `CODED` to values of `STORAGE_CODED` and `CODED_CHANGE` of the plain methods.

    A run without this condition, or one that is derived from another run, is not changed.
    """
    labels = coded_labels(manifest)
    if not labels:
        return manifest, rows
    records = [record for record in manifest.methods if record.label not in labels.values()]
    coded = [row for record in records if not record.condition for row in _coded_rows(rows, record, labels)]
    metrics = list(manifest.metrics)
    index = next((i + 1 for i, metric in enumerate(metrics) if metric.name == STORAGE), len(metrics))
    metrics[index:index] = [STORAGE_CODED, CODED_CHANGE]
    manifest = replace(manifest, methods=tuple(records), metrics=tuple(metrics))
    return manifest, Rows.joined([rows.of_methods([r.label for r in records]), Rows.of(coded)])


def coded_labels(manifest: Manifest) -> dict[str, str]:
    """Label of the coded avatars by the method's name; empty for a run that is derived from another one."""
    if manifest.configuration.source:
        return {}
    return {record.name: record.label for record in manifest.methods if record.condition == CODED}


def check_codecs(manifests: Sequence[Manifest], file: Path) -> None:
    """Refuse runs whose methods use different codecs.

    Plain methods must have files as trained, without a codec, and all coded ones the same codec with
    the same steps. Runs that did not record codecs are accepted.
    """
    codecs: dict[str, dict[str, str]] = {"trained": {}, "coded": {}}
    for manifest in manifests:
        labels = coded_labels(manifest).values()
        for record in manifest.methods:
            kind = "coded" if record.label in labels else "trained"
            if record.codec is not None and (kind == "coded" or not record.condition):
                codecs[kind] |= dict.fromkeys(record.codec.split("; "), record.label)
    for kind, refused, expected in (
        ("trained", {*codecs["trained"]} - {""}, "files as trained, without a codec"),
        (
            "coded",
            len(codecs["coded"]) > 1 or "" in codecs["coded"],
            "one codec with one set of steps for all methods",
        ),
    ):
        if refused:
            pairs = sorted(codecs[kind].items())
            text = "; ".join(f"codec {codec or 'none'} ({label})" for codec, label in pairs)
            remedy = "Sizes from different codecs are not comparable; code all avatars with one codec."
            raise InputError(file, f"methods, codec of {kind} avatars", expected, text, remedy)


def _coded_rows(rows: Rows, record: MethodRecord, labels: Mapping[str, str]) -> list[Row]:
    """Rows of both metrics of a plain method, by subject and seed."""
    coded, result = labels.get(record.name), []
    for seed, subject in product(sorted(rows.seeds(record.label)), sorted(rows.subjects)):
        changes = []
        for task in TASKS:
            if task in rows.tasks:
                before, after = (
                    _mean_or_reason(rows, label, QUALITY, task, subject, seed)
                    for label in (record.label, coded)
                )
                changes.append((after[0] - before[0], after[1] or before[1]))
        # Missing ones first: the minimum over one task would hide that the other is unknown.
        change = min(changes, key=lambda c: (math.isfinite(c[0]), c[0]), default=(math.nan, NO_FRAMES))
        size = _mean_or_reason(rows, coded, STORAGE, "", subject, seed)
        for spec, (value, reason) in ((STORAGE_CODED, size), (CODED_CHANGE, change)):
            row = Row(
                *(record.label, record.version, seed, "", subject, "", -1, "", FULL, spec.name),
                *(value, "", "ok" if math.isfinite(value) else "missing", reason),
            )
            result.append(row)
    return result


def _mean_or_reason(
    rows: Rows, label: str | None, metric: str, task: str, subject: str, seed: int
) -> tuple[float, str]:
    """Mean of one metric of one avatar, over frames and sequences, and "", or NaN and the reason."""
    if label is None:
        return math.nan, "The method has no coded avatar."
    values = rows.select(method=label, metric=metric, task=task, region=FULL, seeds=(seed,), subject=subject)
    if values.empty:
        failed = rows.select(method=label, metric=ALL, task=ALL, region=ALL, seeds=(seed,), subject=subject)
        reasons = [str(reason) for reason in failed["reason"] if reason]
        return math.nan, reasons[0] if reasons else f"The run did not measure {metric} of the coded avatar."
    missing = values[values["status"] != "ok"]
    if len(missing):
        return math.nan, str(missing.iloc[0]["reason"])
    return next(iter(subject_means(values).values())), ""


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """Indices of the points on the Pareto front, by increasing cost.

    One point dominates another if it costs no more and is no worse, and is strictly better in one of the two. Equal
    points do not dominate each other. Lower costs and higher qualities are better; all numbers are finite.
    """
    front: list[int] = []
    for index in sorted(range(len(costs)), key=lambda i: (costs[i], -qualities[i])):
        point = qualities[index], costs[index]
        last = (qualities[front[-1]], costs[front[-1]]) if front else None
        if last is None or point[0] > last[0] or point == last:
            front.append(index)
    return front
