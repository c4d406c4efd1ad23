"""Runs a command without cells as a single task of an executor."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..configuration import build
from ..errors import HeadbenchError
from ..io.documents import checked, read_json
from ..io.files import write_json
from ..io.lock import locked
from ..registry import resolve
from ..specs import CommandResult
from .options import ExecutionOptions
from .schedule import Schedule
from .settings import check_executor
from .task import TASK_LOG, Task

RESULT = "result.json"
PLACE = "command"


def run_as_task(function: str, settings: ExecutionOptions, folder: Path, device: str) -> CommandResult:
    """Run ``function`` ("module:name" of a command) with its settings by their executor; return its result.

    Parameters
    ----------
    folder : Path
        Folder for the log and the result, which is removed at the end.

    Raises
    ------
    HeadbenchError
        The command failed or its process was lost; the message has the reason and the log.
    """
    execution = settings.execution
    check_executor(execution, device)
    kind = f"{type(settings).__module__}:{type(settings).__name__}"
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    task = Task.of(
        folder, PLACE, f"{__name__}:execute_command", command=function, kind=kind, settings=settings.others
    )
    result = folder / PLACE / RESULT
    result.unlink(missing_ok=True)
    with locked(folder):
        failed = Schedule("command", lambda task: result.is_file(), execution).run_all(
            [replace(task, device=device)]
        )
    for reason in failed.values():
        raise HeadbenchError(f"{reason} Its log is {folder / PLACE / TASK_LOG}.")
    found = checked(read_json(result), dict[str, Any], result)
    shutil.rmtree(folder)
    return CommandResult(**found)


def execute_command(task: Task, report: Callable[[str], None]) -> None:
    """Run the command of a task in this process and write its result."""
    given = task.arguments
    settings = build(resolve(given["kind"]), given["settings"], "settings of the task")

    def progress(done: int, total: int, note: str = "") -> None:
        report(f"{done} of {total} {note}")

    found = resolve(given["command"])(settings, progress)
    write_json(task.folder / RESULT, found._asdict())
