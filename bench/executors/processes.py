"""The executor ``processes``: several workers on this machine, which share its cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from ..start import end_with_parent, starting_workers
from .outcome import forget_outcome, read_outcome
from .results import TaskResult
from .task import Task
from .worker import execute_task

STOP_S, POLL_S = 5.0, 1.0
"""Time for a worker to terminate, and between updates of the progress, seconds."""


@dataclass(eq=False)
class _Process:
    process: Any
    connection: Connection
    task: Task | None = None

    def stop(self) -> None:
        """Close the connection, which ends the worker, and kill the worker if it is still alive after `STOP_S`."""
        self.connection.close()
        self.process.join(STOP_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class Processes:
    """Workers that execute tasks one after another; a killed worker is replaced.

    Parameters
    ----------
    workers : int
        Maximum number of concurrent workers.
    threads : int | None
        Threads of each worker; None uses the number of this process.
    """

    def __init__(self, workers: int, threads: int | None):
        self._count, self._threads = workers, threads
        self._waiting: deque[Task] = deque()
        self._processes: list[_Process] = []

    @property
    def running(self) -> Sequence[Task]:
        """The running tasks."""
        return [process.task for process in self._processes if process.task is not None]

    def submit(self, tasks: Sequence[Task]) -> None:
        """Execute these tasks, in order, after those already queued."""
        for task in tasks:
            forget_outcome(task.folder, task.speed)
        self._waiting.extend(tasks)

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait at most ``seconds`` for a task to end; return the results of those that ended."""
        self._fill()
        connections = [p.connection for p in self._processes if p.task is not None]
        ready = wait(connections, min(seconds, POLL_S))
        ended = [self._ended(p) for p in list(self._processes) if p.connection in ready]
        self._fill()
        return ended

    def close(self) -> None:
        """Terminate all workers; their tasks resume from checkpoints when started again."""
        for process in self._processes:
            process.process.terminate()
        for process in self._processes:
            process.stop()
        self._processes = []

    def _fill(self) -> None:
        """Assign queued tasks to idle workers."""
        idle = [process for process in self._processes if process.task is None]
        while self._waiting and (idle or len(self._processes) < self._count):
            process = idle.pop() if idle else self._start()
            process.task = self._waiting.popleft()
            process.connection.send(process.task)

    def _ended(self, process: _Process) -> TaskResult:
        assert process.task is not None
        task, process.task = process.task, None
        try:
            error = process.connection.recv()
        except (EOFError, OSError):
            self._processes.remove(process)
            process.process.join()
            process.connection.close()
            return TaskResult(task, f"its process was ended by {_cause(process.process.exitcode)}")
        if error is not None:
            raise error
        outcome = read_outcome(task.folder)
        if task.device != "cpu" and outcome is not None and outcome["status"] == "failed":
            self._processes.remove(process)  # After a CUDA error, all further CUDA calls of its process fail.
            process.stop()
        return TaskResult(task)

    def _start(self) -> _Process:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=_serve, args=(theirs,))
        with starting_workers(), _threads(self._threads):
            process.start()
        theirs.close()
        started = _Process(process, ours)
        self._processes.append(started)
        return started


def _serve(connection: Connection) -> None:
    """Execute tasks until the connection is closed."""
    end_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    while True:
        try:
            task: Task = connection.recv()
        except EOFError:
            return
        error = None
        try:
            execute_task(task)
        except Exception as raised:  # noqa: BLE001 - the other process reports it
            error = raised
        connection.send(error)


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Set the number of threads of processes started in the block; libraries read it when they are imported."""
    before = os.environ.get("OMP_NUM_THREADS")
    if count is not None:
        os.environ["OMP_NUM_THREADS"] = str(count)
    try:
        yield
    finally:
        if count is not None:
            del os.environ["OMP_NUM_THREADS"]
            if before is not None:
                os.environ["OMP_NUM_THREADS"] = before


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        hint = ", probably out of memory" if -code == signal.SIGKILL else ""
        return f"{signal.Signals(-code).name}{hint}"
    return f"exit code {code}"
