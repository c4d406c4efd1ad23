"""Runs the cells of a comparison by an executor: submits, follows, starts lost ones again, merges their rows.

Two passes: all cells, many at once; then the speed of their avatars, without neighbours that would disturb it. A cell's
own files are the truth; only the process here writes those of the run.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from ..errors import shortened
from ..machine import processor_count
from ..progress import progress
from ..rows import Rows
from ..runner.steps import Job, failed_rows, stored_rows
from ..runner.store import RunFolder
from ..specs import MAX_LABEL, MetricSpec
from .ended import Ended, Executor
from .outcome import read_outcome
from .processes import Processes
from .settings import Execution
from .slurm import Slurm
from .worker import JOB_LOG, Work, is_speed

log = logging.getLogger(__name__)
DAMAGED = "its results are missing or damaged"
Failures = dict[str, str]
"""Why cells failed, by their place."""


def execute(
    jobs: Sequence[Job], metrics: Sequence[MetricSpec], folder: RunFolder, execution: Execution
) -> Rows:
    """Work on the cells of a run, whose lock is held and whose record is written; return the rows of all.

    A cell that is done is kept. One whose process or job was lost is started again, `Execution.restarts` times at most. One
    that fails has failed rows.
    """
    works = _works(jobs, folder)
    places = {work.cell: job for work, job in zip(works, jobs)}
    failures: Failures = {}
    steady = [metric for metric in metrics if not is_speed(metric)]
    left = [work for work in works if stored_rows(places[work.cell], metrics, retry=True) is None]
    first = [work for work in left if stored_rows(places[work.cell], steady, retry=True) is None]
    _Pass(places, steady, failures, execution).run(first, folder)
    if any(map(is_speed, metrics)):
        left = [replace(work, speed=True) for work in left if work.cell not in failures]
        _Pass(places, metrics, failures, execution, speed=True).run(left, folder)
    return Rows.joined([_merged(job, metrics, failures.get(place)) for place, job in places.items()])


def _merged(job: Job, metrics: Sequence[MetricSpec], failure: str | None) -> Rows:
    """Rows of a cell that has ended."""
    rows = stored_rows(job, metrics) if failure is None else None
    return failed_rows(job, metrics, failure or f"HeadbenchError: {DAMAGED}") if rows is None else rows


def machine_of(jobs: Sequence[Job], otherwise: Mapping[str, Any]) -> Mapping[str, Any]:
    """The machine that cells were worked on; ``otherwise`` where none tells, the names of all where there were several."""
    outcomes = [read_outcome(job.cell.folder) for job in jobs]
    machines = [outcome["machine"] for outcome in outcomes if outcome is not None and "machine" in outcome]
    if not machines:
        return otherwise
    names = sorted({str(machine.get("processor")) for machine in machines})
    if len(names) > 1:
        log.warning("Cells were worked on by %s: their times and speeds do not compare.", ", ".join(names))
    return {**machines[0], "processor": shortened(" and ".join(names), MAX_LABEL - 10)}


def _works(jobs: Sequence[Job], folder: RunFolder) -> list[Work]:
    captures = {subject: index for index, subject in enumerate(dict.fromkeys(j.clip.subject for j in jobs))}
    path = tuple(os.path.abspath(entry) for entry in sys.path)
    return [
        Work(
            str(folder.root.resolve()),
            os.getcwd(),
            path,
            job.clip.subject,
            job.method.spec.name,
            job.seed,
            captures[job.clip.subject],
            speed=False,
        )
        for job in jobs
    ]


class _Pass:
    """One pass over cells, which has them worked on until each has an outcome."""

    def __init__(
        self,
        places: Mapping[str, Job],
        metrics: Sequence[MetricSpec],
        failures: Failures,
        execution: Execution,
        speed: bool = False,
    ):
        self._places, self._metrics, self._failures = places, metrics, failures
        self._execution, self._speed = execution, speed

    def run(self, works: Sequence[Work], folder: RunFolder) -> None:
        if not works:
            return
        label = "speed of cells" if self._speed else "cells"
        executor = make_executor(self._execution, folder, self._speed, len(works))
        with closing(executor), progress(label) as report:
            executor.submit(works)
            done = failed = 0
            while done < len(works):
                for ended in executor.poll(self._execution.poll_s):
                    again = self._again(ended)
                    if again is not None:
                        executor.submit([again])
                        continue
                    done += 1
                    failed += ended.work.cell in self._failures
                note = f"{executor.running} running" + (f", {failed} failed" if failed else "")
                report(done, len(works), note)

    def _again(self, ended: Ended) -> Work | None:
        """What to submit again of a cell that ended; None where it is done, or failed, which is recorded."""
        work, job = ended.work, self._places[ended.work.cell]
        outcome = read_outcome(job.cell.folder)
        reason = ""
        if outcome is not None and outcome["speed"] == self._speed:
            if outcome["status"] == "done" and stored_rows(job, self._metrics) is not None:
                return None
            reason = outcome.get("reason", "") if outcome["status"] == "failed" else ""
        if not reason:
            lost = ended.lost or DAMAGED
            if ended.again and work.restarts < self._execution.restarts:
                log.warning("%s: %s; it is started again", job.name, lost)
                return replace(work, restarts=work.restarts + 1)
            reason = f"HeadbenchError: {lost}" + (f", {work.restarts + 1} times" if work.restarts else "")
        self._failures[work.cell] = reason
        log.error("%s failed: %s; see %s", job.name, reason, job.cell.folder / JOB_LOG)
        return None


def make_executor(execution: Execution, folder: RunFolder, speed: bool, cells: int) -> Executor:
    """The executor of a pass; processes measure speed one cell at a time, with all threads."""
    if execution.executor == "slurm":
        return Slurm(folder, execution, speed)
    if speed:
        return Processes(1, None)
    cores = processor_count()
    workers = min(execution.workers or cores, cells)
    return Processes(workers, execution.threads or max(1, cores // workers))
