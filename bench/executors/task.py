"""A task: the name and arguments of a function, and a folder for its outcome and log."""

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
    """Unit of work of a process or job.

    Attributes
    ----------
    root : str
        Absolute path of the output folder of the submitting command, which holds its lock.
    place : str
        Folder of the task relative to ``root``; no other task writes to it.
    function : str
        "module:name" of the function to call with the task and a callback for progress messages.
    arguments : Mapping[str, Any]
        Arguments of the function, as JSON values.
    directory, path : str or tuple[str, ...]
        Working directory and module search path of the submitting process, for importing plug-ins.
    speed : bool
        Whether the task measures speed and therefore must not share the machine.
    restarts : int
        Number of restarts after a lost process or job.
    device : str
        Compute device, for the record of the machine.
    name : str
        Name in progress messages; "" for ``place``.
    cost : float
        Expected time, relative to the other tasks of its schedule.
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
    name: str = ""
    cost: float = 1.0

    @classmethod
    def of(cls, root: Path, place: str, function: str, **arguments: Any) -> Task:
        """Create a task of this process."""
        path = tuple(os.path.abspath(entry) for entry in sys.path)
        return cls(str(root.resolve()), place, function, arguments, os.getcwd(), path)

    @property
    def folder(self) -> Path:
        """Folder of its outcome and log."""
        return Path(self.root) / self.place
