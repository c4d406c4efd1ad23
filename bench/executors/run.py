"""Runs the cells of a comparison by an executor, and merges their rows.

Two passes: all cells, many at once; then the speed of their avatars, without neighbours that would disturb it. A cell's
own files decide; only the process here writes those of the run.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ..errors import shortened
from ..io.documents import checked, read_json
from ..io.files import write_json
from ..rows import Rows
from ..runner.steps import Job, failed_rows, log_kept, stored_rows, trained_files
from ..runner.store import RunFolder
from ..specs import MAX_LABEL, MetricSpec
from .cell import cell_task
from .outcome import read_outcome
from .schedule import DAMAGED, Failures, Schedule
from .settings import Execution, is_speed
from .task import Task

log = logging.getLogger(__name__)


def execute(
    jobs: Sequence[Job], metrics: Sequence[MetricSpec], folder: RunFolder, execution: Execution
) -> Rows:
    """Work on the cells of a run, whose lock is held and whose record is written; return the rows of all.

    A cell that is done is kept. One whose process or job was lost is started again, `Execution.restarts` times at most. One
    that fails has failed rows. A run that is started again tries failed cells again, unless it had begun to measure speed:
    it then goes on with that.
    """
    captures = {subject: index for index, subject in enumerate(dict.fromkeys(j.clip.subject for j in jobs))}
    tasks = [cell_task(job, captures[job.clip.subject], folder) for job in jobs]
    places = {task.place: job for task, job in zip(tasks, jobs)}
    steady = [metric for metric in metrics if not is_speed(metric)]

    for job in jobs:
        if job.cell.is_done("fit", job.fit_fingerprint) and not job.cell.damage(trained_files(job)):
            log_kept(job)

    def left(wanted: Sequence[MetricSpec]) -> list[Task]:
        return [
            task
            for task in tasks
            if task.place not in failures and stored_rows(places[task.place], wanted, retry=True) is None
        ]

    failures = _failed_before(folder)
    schedule = Schedule("cells", lambda task: stored_rows(places[task.place], steady) is not None, execution)
    failures |= schedule.run_all(left(steady))
    if len(steady) < len(metrics):
        write_json(folder.speed_pass, {"failed": failures})
        whole = replace(
            schedule,
            label="speed of cells",
            is_done=lambda task: stored_rows(places[task.place], metrics) is not None,
            speed=True,
        )
        failures |= whole.run_all([replace(task, speed=True) for task in left(metrics)])
    return Rows.joined(_merged(job, metrics, failures.get(place)) for place, job in places.items())


def _failed_before(folder: RunFolder) -> Failures:
    """Cells that had failed when the run was ended while it measured speed, and why."""
    path = folder.speed_pass
    return checked(read_json(path), dict[str, Failures], path)["failed"] if path.exists() else {}


def _merged(job: Job, metrics: Sequence[MetricSpec], failure: str | None) -> Rows:
    """Rows of a cell that has ended."""
    rows = stored_rows(job, metrics) if failure is None else None
    return failed_rows(job, metrics, failure or f"HeadbenchError: {DAMAGED}") if rows is None else rows


def machine_of(jobs: Sequence[Job], otherwise: Mapping[str, Any]) -> Mapping[str, Any]:
    """The machine that ran the cells; ``otherwise`` if none is recorded, all names if there were several."""
    outcomes = [read_outcome(job.cell.folder) for job in jobs]
    machines = [outcome["machine"] for outcome in outcomes if outcome is not None and "machine" in outcome]
    if not machines:
        return otherwise
    record = {**machines[0], "processor": _all_of(str(machine.get("processor")) for machine in machines)}
    devices = [machine["device"] for machine in machines if "device" in machine]
    if devices:
        record["device"] = {**devices[0], "name": _all_of(str(device["name"]) for device in devices)}
    return record


def _all_of(names: Iterable[str]) -> str:
    """The different names as one; of several a warning is logged."""
    different = sorted(set(names))
    if len(different) > 1:
        log.warning(
            "Cells were executed by %s: their times and speeds are not comparable.", ", ".join(different)
        )
    return shortened(" and ".join(different), MAX_LABEL - 10)
