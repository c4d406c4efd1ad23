"""Options of commands that use an executor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any

import tyro

from ..configuration import build, merge, parse_assignments
from ..options import DependentOptions, check_dependent
from ..registry import unknown
from .settings import Execution, ExecutorName

DEPENDENT = (
    DependentOptions(("workers", "threads"), "executor", ("processes",)),
    DependentOptions(("restarts",), "executor", ("processes", "slurm")),
    DependentOptions(("poll_s", "slurm"), "executor", ("slurm",)),
)
"""Settings of `Execution` that apply to some executors only."""


def chosen_execution(
    settings: Mapping[str, Any],
    assigned: Mapping[str, Any],
    executor: ExecutorName | None,
    workers: int | None,
    source: str,
) -> Execution:
    """Settings of an executor, overridden by ``--set`` and by the options ``--executor`` and ``--workers``.

    Parameters
    ----------
    settings : Mapping[str, Any]
        All settings of ``execution``, including those in ``assigned``.
    assigned : Mapping[str, Any]
        Settings of ``execution`` given with ``--set``.
    executor, workers : ExecutorName, int or None
        Values of the options; None if not given.
    source : str
        File or option of the settings, for error messages.

    Raises
    ------
    InputError
        Settings are invalid, or given settings have no effect with the executor.
    """
    options = {"executor": executor, "workers": workers}
    options = {key: value for key, value in options.items() if value is not None}
    values = (
        merge(settings, options) if isinstance(settings, Mapping) else settings
    )  # otherwise `build` refuses them
    execution = build(Execution, values, source, "execution.")
    given = {key: f"--set execution.{key}" for key in assigned} | {key: f"--{key}" for key in options}
    check_dependent(DEPENDENT, execution, given)
    return execution


@dataclass(frozen=True, kw_only=True)
class ExecutionOptions:
    """How a command is executed."""

    executor: ExecutorName = "inline"
    """Executor, as for `headbench run`."""

    workers: int | None = None
    """Number of processes, as for `headbench run`; only with `--executor processes`."""

    set: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="execution.KEY=VALUE")
    ] = ()
    """A setting of the executor, for example `execution.slurm.partition=gpu`; repeatable."""

    @property
    def execution(self) -> Execution:
        """Execution settings. Raises `InputError` for invalid settings."""
        given = parse_assignments(self.set)
        if stray := sorted(given.keys() - {"execution"}):
            raise unknown("command line", "--set", stray[0], ["execution"])
        executor = None if self.executor == "inline" else self.executor
        settings = given.get("execution", {})
        return chosen_execution(settings, settings, executor, self.workers, "command line")

    @property
    def others(self) -> dict[str, Any]:
        """All settings except these, which do not affect the results."""
        own = {field.name for field in fields(ExecutionOptions)}
        return {name: value for name, value in asdict(self).items() if name not in own}
