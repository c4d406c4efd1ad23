"""A task: a function by its name with arguments, and a folder that its outcome and its log go to."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TASK_LOG = "job.log"


@dataclass(frozen=True)
class Task:
    """One piece of work, what a process or a job is given.

    Attributes
    ----------
    root : absolute path of the output folder of the command that asks, which holds its lock.
    place : of the task in that folder: its own folder, which no other task writes in.
    function : "module:name" of what does it; called with the task and a function that takes what it is doing, in words.
    arguments : of the function, values that JSON has.
    directory, path : working directory and module path of the process that asks, where plug-ins are found.
    speed : whether it measures speed, which takes a machine without neighbours.
    restarts : how often it was started again, its earlier process or job being lost.
    device : what it computes on, for the record of the machine.
    """

    root: str
    place: str
    function: str
    arguments: Mapping[str, Any]
    directory: str
    path: tuple[str, ...]
    speed: bool = False
    restarts: int = 0
    device: str = "cpu"

    @classmethod
    def of(cls, root: Path, place: str, function: str, **arguments: Any) -> Task:
        """Make a task of this process."""
        path = tuple(os.path.abspath(entry) for entry in sys.path)
        return cls(str(root.resolve()), place, function, arguments, os.getcwd(), path)

    @property
    def folder(self) -> Path:
        """Where its outcome and its log lie."""
        return Path(self.root) / self.place
