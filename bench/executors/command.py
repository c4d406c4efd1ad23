"""``headbench status``, and the options of commands whose work an executor can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..configuration import build, merge, parse_assignments
from ..contracts import Progress
from ..options import DependentOptions, check_dependent
from ..registry import unknown
from ..runner.config import RunOptions
from ..specs import Findings
from .settings import Execution, ExecutorName

DEPENDENT = (
    DependentOptions(("workers", "threads"), "executor", ("processes",)),
    DependentOptions(("restarts",), "executor", ("processes", "slurm")),
    DependentOptions(("poll_s", "slurm"), "executor", ("slurm",)),
)
"""Settings of `Execution` that only some executors have."""


def chosen_execution(
    settings: Mapping[str, Any],
    assigned: Mapping[str, Any],
    executor: ExecutorName | None,
    workers: int | None,
    source: str,
) -> Execution:
    """Settings of an executor, with those of ``--set`` and the options ``--executor`` and ``--workers`` laid over them.

    Parameters
    ----------
    settings : all of ``execution``, those in ``assigned`` included.
    assigned : what ``--set`` gives of ``execution``.
    executor, workers : None where not given.
    source : file or option that the settings came from, for the error.

    Raises `InputError` for invalid settings, and for given ones that have no effect with the executor.
    """
    options = {"executor": executor, "workers": workers}
    options = {key: value for key, value in options.items() if value is not None}
    values = merge(settings, options) if isinstance(settings, Mapping) else settings  # which `build` refuses
    execution = build(Execution, values, source, "execution.")
    given = {key: f"--set execution.{key}" for key in assigned} | {key: f"--{key}" for key in options}
    check_dependent(DEPENDENT, given, execution)
    return execution


@dataclass(frozen=True, kw_only=True)
class ExecutionOptions:
    """How the work of a command is done."""

    executor: ExecutorName = "inline"
    """Where it is done, as for `headbench run`."""

    workers: int | None = None
    """How many processes, as for `headbench run`; with `--executor processes` alone."""

    set: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="execution.KEY=VALUE")
    ] = ()
    """A setting of the executor, for example `execution.slurm.partition=gpu`; repeatable."""

    @property
    def execution(self) -> Execution:
        """How it is done. Raises `InputError` for settings that are none."""
        given = parse_assignments(self.set)
        if stray := sorted(given.keys() - {"execution"}):
            raise unknown("command line", "--set", stray[0], ["execution"])
        executor = None if self.executor == "inline" else self.executor
        settings = given.get("execution", {})
        return chosen_execution(settings, settings, executor, self.workers, "command line")

    @property
    def others(self) -> dict[str, Any]:
        """The settings that decide what comes out: all but these."""
        own = {field.name for field in fields(ExecutionOptions)}
        return {name: value for name, value in asdict(self).items() if name not in own}


@dataclass(frozen=True)
class StatusSettings:
    """Shows the progress of a run, or afterwards, and changes nothing. Exit code 1: a cell failed."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def status(settings: StatusSettings, progress: Progress) -> Findings:
    """Show which cells of a run are waiting, running, done or failed, and the time left."""
    from .status import run_status

    return run_status(Path(settings.run))


@dataclass(frozen=True)
class SpeedSettings(RunOptions):
    """Loads the stored avatars of a finished run and measures frames per second and times of a frame again, one avatar after
    another, without training. Only these rows are replaced; the former values stay in measure.json and run.log. Let nothing
    else run on the machine meanwhile. Exit code 1: an avatar could not be measured and keeps its former speed.
    """

    run: tyro.conf.Positional[str]
    """Folder of the run."""

    methods: tuple[str, ...] = ()
    """Only these methods; default: all of the run."""


def speed(settings: SpeedSettings, progress: Progress) -> Findings:
    """Measure the speed of a finished run's avatars again, without training, and update its tables and report."""
    from ..runner.speed import measure_speed_again

    return measure_speed_again(Path(settings.run), settings, settings.methods, progress)
