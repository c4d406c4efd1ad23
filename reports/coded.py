"""Adds two columns for coded avatars to their methods: megabytes with one codec, and the loss of quality by the codec."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..bench.engine.config import CODED
from ..bench.errors import InputError
from ..bench.manifest import Manifest, MethodRecord
from ..bench.rows import ALL, FULL, Row, Rows
from ..bench.specs import MetricSpec
from .aggregate import subject_means

STORAGE, QUALITY = "storage", "psnr"
TASKS = ("novel_view", "self_reenactment")
NO_FRAMES = "The run has frames of neither task."
STORAGE_CODED = MetricSpec(
    name="storage_coded",
    label="Coded",
    unit="MB",
    higher_is_better=False,
    digits=2,
    implementation="headbench.reports.coded:with_coded",
    summary="Bytes of the files through the codec of all methods, SI megabytes.",
    kind="avatar",
    tables=("comparison", "cost"),
)
CODED_CHANGE = MetricSpec(
    name="coded_change",
    label="By coding",
    unit="dB",
    higher_is_better=True,
    digits=2,
    implementation="headbench.reports.coded:with_coded",
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
    more = [row for record in records if not record.condition for row in _rows(rows, record, labels)]
    kept = rows.of_methods([record.label for record in records])
    metrics = list(manifest.metrics)
    place = next((i + 1 for i, metric in enumerate(metrics) if metric.name == STORAGE), len(metrics))
    metrics[place:place] = [STORAGE_CODED, CODED_CHANGE]
    manifest = replace(manifest, methods=tuple(records), metrics=tuple(metrics))
    return manifest, Rows.joined([kept, Rows.of(more)])


def coded_labels(manifest: Manifest) -> dict[str, str]:
    """Label of the coded avatars by the method's name; empty for a run that is derived from another one."""
    if manifest.configuration.source:
        return {}
    return {record.name: record.label for record in manifest.methods if record.condition == CODED}


def check_codecs(manifests: Sequence[Manifest], file: Path) -> None:
    """Refuse runs whose methods use different codecs.

    Plain methods must have files as trained, without a codec, and all coded ones the same codec with
    the same steps. Runs that did not record codecs are accepted. Raises `InputError`, naming ``file``.
    """
    trained: dict[str, str] = {}
    coded: dict[str, str] = {}
    for manifest in manifests:
        labels = coded_labels(manifest).values()
        for record in manifest.methods:
            found = coded if record.label in labels else trained
            if record.codec is not None and (found is coded or not record.condition):
                found |= dict.fromkeys(record.codec.split("; "), record.label)
    for kind, found, expected in (
        ("trained", trained, "files as trained, without a codec"),
        ("coded", coded, "one codec with one set of steps for all methods"),
    ):
        if found and (set(found) != {""} if found is trained else len(found) > 1 or "" in found):
            text = "; ".join(f"codec {codec or 'none'} ({label})" for codec, label in sorted(found.items()))
            remedy = "Sizes from different codecs are not comparable; code all avatars with one codec."
            raise InputError(file, f"methods, codec of {kind} avatars", expected, text, remedy)


def _rows(rows: Rows, record: MethodRecord, labels: Mapping[str, str]) -> list[Row]:
    """Rows of both metrics of a plain method, by subject and seed."""
    coded, result = labels.get(record.name), []
    for seed in sorted(rows.seeds(record.label)):
        for subject in sorted(rows.subjects):
            place = subject, seed
            size = _value(rows, coded, STORAGE, "", *place)
            changes = [
                _change(rows, record.label, coded, task, *place) for task in TASKS if task in rows.tasks
            ]
            # Missing ones first: the minimum over one task would hide that the other is unknown.
            change = min(
                changes, key=lambda each: (math.isfinite(each[0]), each[0]), default=(math.nan, NO_FRAMES)
            )
            for spec, (value, reason) in ((STORAGE_CODED, size), (CODED_CHANGE, change)):
                row = Row(
                    *(record.label, record.version, seed, "", subject, "", -1, "", FULL, spec.name),
                    *(value, "", "ok" if math.isfinite(value) else "missing", reason),
                )
                result.append(row)
    return result


def _change(
    rows: Rows, label: str, coded: str | None, task: str, subject: str, seed: int
) -> tuple[float, str]:
    """Change of `QUALITY` in a task by the codec and "", or NaN and the reason."""
    before, after = (_value(rows, of, QUALITY, task, subject, seed) for of in (label, coded))
    return after[0] - before[0], after[1] or before[1]


def _value(
    rows: Rows, label: str | None, metric: str, task: str, subject: str, seed: int
) -> tuple[float, str]:
    """Mean of one metric of one avatar, over frames and sequences, and "", or NaN and the reason."""
    if label is None:
        return math.nan, "The method has no coded avatar."
    own = rows.select(method=label, metric=metric, task=task, region=FULL, seeds=(seed,), subject=subject)
    if own.empty:
        failed = rows.select(method=label, metric=ALL, task=ALL, region=ALL, seeds=(seed,), subject=subject)
        reasons = [str(reason) for reason in failed["reason"] if reason]
        return math.nan, reasons[0] if reasons else f"The run did not measure {metric} of the coded avatar."
    missing = own[own["status"] != "ok"]
    if len(missing):
        return math.nan, str(missing.iloc[0]["reason"])
    return next(iter(subject_means(own).values())), ""
