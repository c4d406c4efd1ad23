"""Settings for executing the cells of a run: in this process, in worker processes, or as cluster jobs; and their options."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, Literal

import tyro

from ..configuration import build, merge, parse_assignments
from ..errors import UnavailableError, install_extra
from ..machine import check_device, environment_variable
from ..options import DependentOptions, check_dependent
from ..registry import unknown

ExecutorName = Literal["auto", "inline", "processes", "slurm"]


@dataclass(frozen=True)
class SlurmSettings:
    """Resources of a Slurm job; each executes one cell."""

    partition: str | None = None
    """Partition; None for the cluster's default."""
    gpus: int = 0
    """GPUs of each job."""
    cpus: int = 4
    """Processors of each job, also its number of threads."""
    memory_gb: float = 8.0
    """Memory of each job, GB."""
    hours: float = 4.0
    """Time limit of each job."""
    parallel: int = 64
    """Maximum number of concurrent jobs of an array."""
    exclusive: bool = True
    """Whether jobs that measure speed request a whole node. Otherwise, concurrent jobs bias the measurement."""
    setup: tuple[str, ...] = ()
    """Shell commands to run at the start of a job, such as ``module load cuda``."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Further options of ``sbatch`` by name, such as ``{"account": "vision", "qos": "long"}``."""

    def __post_init__(self) -> None:
        """Refuse invalid settings."""
        if self.gpus < 0 or self.cpus < 1 or self.memory_gb <= 0 or self.parallel < 1:
            raise ValueError("gpus is at least 0, cpus and parallel are at least 1, memory_gb is above 0")
        if self.hours < 1 / 60:
            raise ValueError(f"hours is {self.hours}; at least a minute")


@dataclass(frozen=True)
class Execution:
    """How the cells of a run are executed. None of these settings enters a fingerprint."""

    executor: ExecutorName = "inline"
    """``inline``, sequentially in this process; ``processes``, in parallel on this machine; ``slurm``, one job per cell; ``auto``,
    ``processes`` for several trainings on the CPU of a machine with several cores and memory for them, otherwise ``inline``. Commands
    use ``auto`` by default."""
    workers: int | None = None
    """Number of ``processes``; None: one for each core."""
    threads: int | None = None
    """Threads of each worker; None divides the cores among the workers. Speed is measured with the threads of this process."""
    restarts: int = 3
    """Maximum number of restarts of a cell whose process or job was killed, lost or timed out."""
    poll_s: float = 5.0
    """Interval between queries to Slurm, seconds."""
    slurm: SlurmSettings = field(default_factory=SlurmSettings)

    def __post_init__(self) -> None:
        """Refuse invalid settings."""
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is {value}; at least 1, or none")
        if self.restarts < 0 or self.poll_s <= 0:
            raise ValueError("restarts is at least 0, poll_s is above 0")


def import_submitit() -> Any:
    """Import submitit without letting it close open log files."""
    try:
        with environment_variable("SUBMITIT_LOG_LEVEL", "NOCONFIG"):
            return importlib.import_module("submitit")
    except ImportError as error:
        raise UnavailableError("The package submitit is not installed.", install_extra("slurm")) from error


def check_executor(execution: Execution, device: str) -> None:
    """Refuse a device that this machine lacks, and Slurm where jobs cannot be submitted.

    The jobs of Slurm check their device themselves, since the submitting machine may have none.
    """
    if execution.executor != "slurm":
        check_device(device)
        return
    missing = [name for name in ("sbatch", "srun", "squeue", "scontrol") if shutil.which(name) is None]
    if missing:
        remedy = "Start this on a machine that submits to a cluster, or choose --executor processes."
        raise UnavailableError(f"Slurm is not here: there is no {', '.join(missing)}.", remedy)
    import_submitit()


DEPENDENT = (
    DependentOptions(("workers", "threads"), "executor", ("auto", "processes")),
    DependentOptions(("restarts",), "executor", ("auto", "processes", "slurm")),
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
    """Settings of an executor, overridden by ``--set`` and by the options ``--executor`` and ``--workers``; by default ``auto``.

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
    """
    options = {"executor": executor, "workers": workers}
    options = {key: value for key, value in options.items() if value is not None}
    # `build` refuses other values.
    values = (
        merge(merge({"executor": "auto"}, settings), options) if isinstance(settings, Mapping) else settings
    )
    execution = build(Execution, values, source, "execution.")
    if execution.executor == "auto" and execution.workers is not None:
        execution = replace(execution, executor="processes")
    given = {key: f"--set execution.{key}" for key in assigned} | {key: f"--{key}" for key in options}
    check_dependent(DEPENDENT, execution, given)
    return execution


@dataclass(frozen=True, kw_only=True)
class ExecutionOptions:
    """How a command is executed."""

    executor: ExecutorName | None = None
    """Executor, as for `headbench run`."""

    workers: int | None = None
    """Number of processes, as for `headbench run`."""

    set: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="execution.KEY=VALUE")
    ] = ()
    """A setting of the executor, for example `execution.slurm.partition=gpu`; repeatable."""

    @property
    def execution(self) -> Execution:
        """Execution settings."""
        given = parse_assignments(self.set)
        if stray := sorted(given.keys() - {"execution"}):
            raise unknown("command line", "--set", stray[0], ["execution"])
        settings = given.get("execution", {})
        return chosen_execution(settings, settings, self.executor, self.workers, "command line")

    @property
    def others(self) -> dict[str, Any]:
        """All settings except these, which do not affect the results."""
        how = {field.name for field in fields(ExecutionOptions)}
        return {name: value for name, value in asdict(self).items() if name not in how}
