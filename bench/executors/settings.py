"""Settings for executing the cells of a run: in this process, in worker processes, or as cluster jobs."""

from __future__ import annotations

import importlib
import shutil
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import UnavailableError, install_extra
from ..machine import check_device
from ..process import environment_variable

ExecutorName = Literal["inline", "processes", "slurm"]


@dataclass(frozen=True)
class SlurmSettings:
    """Resources of a Slurm job; each executes one cell.

    Attributes
    ----------
    partition : str | None
        Partition; None for the cluster's default.
    gpus, cpus, memory_gb, hours : int or float
        Resources of each job. ``cpus`` is also its number of threads.
    parallel : int
        Maximum number of concurrent jobs of an array.
    exclusive : bool
        Whether jobs that measure speed request a whole node. Otherwise, concurrent jobs bias the
        measurement.
    setup : tuple[str, ...]
        Shell commands to run at the start of a job, such as ``module load cuda``.
    parameters : dict[str, Any]
        Further options of ``sbatch`` by name, such as ``{"account": "vision", "qos": "long"}``.
    """

    partition: str | None = None
    gpus: int = 0
    cpus: int = 4
    memory_gb: float = 8.0
    hours: float = 4.0
    parallel: int = 64
    exclusive: bool = True
    setup: tuple[str, ...] = ()
    parameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse invalid settings."""
        if self.gpus < 0 or self.cpus < 1 or self.memory_gb <= 0 or self.parallel < 1:
            raise ValueError("gpus is at least 0, cpus and parallel are at least 1, memory_gb is above 0")
        if self.hours < 1 / 60:
            raise ValueError(f"hours is {self.hours}; at least a minute")


@dataclass(frozen=True)
class Execution:
    """How the cells of a run are executed. None of these settings enters a fingerprint.

    Attributes
    ----------
    executor : ExecutorName
        ``inline``, sequentially in this process; ``processes``, in parallel on this machine;
        ``slurm``, one job per cell.
    workers : int | None
        Number of ``processes``; None: one for each core.
    threads : int | None
        Threads of each worker; None divides the cores among the workers. Speed is measured with the
        threads of this process.
    restarts : int
        Maximum number of restarts of a cell whose process or job was killed, lost or timed out.
    poll_s : float
        Interval between queries to Slurm, seconds.
    """

    executor: ExecutorName = "inline"
    workers: int | None = None
    threads: int | None = None
    restarts: int = 3
    poll_s: float = 5.0
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
    """Import submitit without letting it close open log files. Raises `UnavailableError`."""
    try:
        with environment_variable("SUBMITIT_LOG_LEVEL", "NOCONFIG"):
            return importlib.import_module("submitit")
    except ImportError as error:
        raise UnavailableError("The package submitit is not installed.", install_extra("slurm")) from error


def check_executor(execution: Execution, device: str) -> None:
    """Check that cells can be executed.

    Raises
    ------
    InputError
        This machine has no such device. For Slurm, the jobs check it, since the submitting machine
        may have none.
    UnavailableError
        Jobs cannot be submitted from this machine.
    """
    if execution.executor != "slurm":
        check_device(device)
        return
    missing = [name for name in ("sbatch", "srun", "squeue", "scontrol") if shutil.which(name) is None]
    if missing:
        remedy = "Start this on a machine that submits to a cluster, or choose --executor processes."
        raise UnavailableError(f"Slurm is not here: there is no {', '.join(missing)}.", remedy)
    import_submitit()
