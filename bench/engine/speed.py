"""Measures the speed of a finished run's avatars again, without training."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ..condition import label_of
from ..contracts import Progress
from ..errors import InputError, reason_of
from ..executors.settings import is_speed
from ..io.lock import locked
from ..machine import check_device, check_device_answers, use_device
from ..progress import log_to_file
from ..rows import ALL, Rows
from ..specs import CommandResult, MetricSpec
from .captures import open_run_clips
from .config import RunOptions, resolve_cells, resolve_metrics
from .job import Job
from .jobs import load, make_jobs
from .measuring import measure
from .run import write_reports
from .store import RunFolder

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Change:
    """Value of an avatar metric before and after it was measured again; None if unknown.

    ``load`` is the number of cores used by other processes during the measurement.
    """

    subject: str
    method: str
    seed: int
    metric: str
    unit: str
    value: tuple[float | None, float | None]
    load: tuple[float | None, float | None]
    threads: int

    @property
    def text(self) -> str:
        """The change as one line of text."""
        values = " -> ".join("none" if value is None else f"{value:.1f}" for value in self.value)
        loads = " -> ".join("not recorded" if load is None else f"{load:.2f}" for load in self.load)
        name = f"{self.subject} {self.method} seed {self.seed}"
        threads = f"{self.threads} thread{'s' * (self.threads != 1)}"
        return f"{name}: {values} {self.unit} ({threads}; cores that other processes kept busy: {loads})"


def measure_speed_again(
    run: Path, options: RunOptions, methods: Sequence[str], progress: Progress
) -> CommandResult:
    """Measure the speed of the avatars of a finished run again, one after another, and rewrite its tables and report.

    Rows of other metrics are not changed. An avatar whose measurement fails keeps its former rows. The former values stay in
    ``measure.json`` of each cell and in ``run.log``. Cells that failed in the run are left out.

    Parameters
    ----------
    methods : Sequence[str]
        Names of methods to measure; empty: all of the run.

    Raises
    ------
    InputError
        The run is unfinished, in use by another process or without a speed metric, it has no such
        method, or an avatar or a capture is missing or differs from the recorded one. Nothing has
        been measured then.
    """
    folder = RunFolder(run)
    folder.read_manifest().check_done(folder.manifest)
    with locked(folder.root), log_to_file(folder.root / "run.log"):
        jobs, metrics = _jobs(folder, options, methods)
        folder.read_rows(folder.read_manifest())
        rows = folder.rows_by_condition(folder.read_manifest())
        changes: list[Change] = []
        failures: dict[str, str] = {}
        left_out = [job.name for job in jobs if _failed(rows, job)]
        finished = [job for job in jobs if job.name not in left_out]
        for job in finished:
            _check_avatar(job)
        rows = _with_cells(rows, folder, metrics)
        folder.write_rows(rows)
        for index, job in enumerate(finished):
            progress(index, len(finished), job.name)
            try:
                new = _measured(job, metrics)
            except Exception as error:  # noqa: BLE001 - a method may fail in any way; the others are still measured
                failures[job.name] = reason_of(error)
                log.error("%s keeps its former speed: %s", job.name, reason_of(error))
                check_device_answers(job.device)
                continue
            found = list(_changes(job, metrics, rows, new))
            rows = rows.updated(new)
            folder.write_rows(rows)
            changes += found
            for change in found:
                log.info("%s", change.text)
        progress(len(finished), len(finished))
        write_reports(folder.root)
    avatars = len(finished) - len(failures)
    lines = [f"{run}: speed measured again, avatars: {avatars}; tables and report are rewritten"]
    lines += [f"{name}: former speed kept: {why}" for name, why in failures.items()]
    lines += [f"{name}: left out, it failed in the run" for name in left_out]
    data = {
        "run": run,
        "changes": [asdict(change) for change in changes],
        "failures": failures,
        "left_out": left_out,
    }
    return CommandResult("\n".join(lines), data, not failures)


def _jobs(
    folder: RunFolder, options: RunOptions, methods: Sequence[str]
) -> tuple[list[Job], list[MetricSpec]]:
    """The selected cells and the metrics of the run, checked."""
    manifest = folder.read_manifest()
    config, clips = open_run_clips(folder.root, options)
    check_device(config.device)
    metrics = resolve_metrics(config)
    if not any(map(is_speed, metrics)):
        found = ", ".join(spec.name for spec in metrics)
        raise InputError(folder.manifest, "metrics", "a metric of speed, such as fps", found)
    cells = [cell for cell in resolve_cells(config) if not cell[1].derive]
    known = dict.fromkeys(method.spec.name for method, _ in cells)
    for name in methods:
        if name not in known:
            raise InputError(folder.manifest, "methods", ", ".join(known), name)
    chosen = [cell for cell in cells if not methods or cell[0].spec.name in methods]
    protocols = {task: record.protocol(folder.manifest) for task, record in manifest.protocols.items()}
    use_device(config.device)
    return make_jobs(config, chosen, clips, protocols, folder), metrics


def _with_cells(rows: Rows, folder: RunFolder, metrics: Sequence[MetricSpec]) -> Rows:
    """Return the rows of a run with the speeds stored in its cells.

    They differ if an earlier call was killed between writing a cell's file and the run's.
    """
    table = rows.select(method=ALL, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    failed = set(_cells(table[table["status"] == "failed"]))
    again: list[Rows] = []
    for place in _cells(table):
        cell = folder.cell(*place)
        state = cell.step("measure") if place not in failed and cell.ended("measure") else None
        if state is None or not state.get("earlier"):
            continue  # its speed was not measured again
        if not cell.damage({cell.name(cell.rows): state.get("rows", "")}):
            again.append(Rows.read(cell.rows))
    names = [metric.name for metric in metrics if is_speed(metric)]
    return rows.updated(Rows.joined(again).of_metrics(names)) if again else rows


def _cells(table: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Subject, label of method and condition, and seed of rows, each once."""
    places = table[["subject", "method", "condition", "seed"]].drop_duplicates()
    return [(str(s), label_of(str(m), str(c)), int(seed)) for s, m, c, seed in places.to_numpy()]


def _failed(rows: Rows, job: Job) -> bool:
    """Whether the run has failed rows of a cell."""
    return bool((job.rows_of(rows)["status"] == "failed").any())


def _check_avatar(job: Job) -> None:
    """Raise `InputError` unless a cell has the avatar that its record describes."""
    remedy = "Start the run again: it trains that avatar."
    state = job.cell.step("fit")
    if state is None or not job.cell.is_done("fit", job.fit_fingerprint):
        found = "none" if state is None else "one of other settings, data or method version"
        raise InputError(job.cell.folder, "fit.json", "the avatar of this run", found, remedy)
    damaged = job.cell.damage(state.get("files", {}))
    for name, why in damaged.items():
        raise InputError(job.cell.folder / name, "", "the file that was written", f"one that {why}", remedy)


def _measured(job: Job, metrics: Sequence[MetricSpec]) -> Rows:
    """Measure the speed of a cell; return its rows."""
    again = [metric for metric in metrics if is_speed(metric)]
    return measure(job, load(job), metrics, again).of_metrics([metric.name for metric in again])


def _changes(job: Job, metrics: Sequence[MetricSpec], before: Rows, after: Rows) -> Iterator[Change]:
    """Change of the main value of each measurement."""
    measurements = {metric.implementation: metric for metric in reversed(metrics) if is_speed(metric)}
    for metric in measurements.values():
        old, new = (_row_of(rows, job, metric) for rows in (before, after))
        yield Change(
            job.clip.subject,
            job.label,
            job.seed,
            metric.name,
            metric.unit,
            (_number(old["value"]), _number(new["value"])),
            (_number(old["other_cores"]), _number(new["other_cores"])),
            int(new["threads"]),
        )


def _row_of(rows: Rows, job: Job, metric: MetricSpec) -> pd.Series[Any]:
    method, subject = job.method.spec.name, job.clip.subject
    found = rows.select(
        method=method,
        condition=job.condition.name,
        metric=metric.name,
        task="",
        region=ALL,
        seeds=(job.seed,),
        subject=subject,
    )
    if len(found) != 1:
        raise InputError("rows", f"{metric.name} of {job.name}", "one row", f"{len(found)}")
    return found.iloc[0]


def _number(value: float) -> float | None:
    return None if pd.isna(value) else float(value)
