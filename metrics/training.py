"""Training time and memory of an avatar, from the record of its fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ..bench.contracts import Measurement
from ..bench.errors import UnavailableError
from ..bench.specs import MetricSpec

TRAINING_TIME = MetricSpec(
    name="training_time",
    label="Training",
    unit="min",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.training:training_time",
    summary="Wall-clock time of the training.",
    kind="training",
    tables=("cost",),
    machine_bound=True,
    default=True,
)
TRAINING_MEMORY = replace(
    TRAINING_TIME,
    name="training_memory",
    label="Peak memory",
    unit="GB",
    implementation="headbench.metrics.training:training_memory",
    summary="Largest resident memory of the training process.",
)

TRAINING_PROCESSOR = replace(
    TRAINING_TIME,
    name="training_processor",
    label="Training, all threads",
    unit="s",
    digits=0,
    implementation="headbench.metrics.training:training_processor",
    summary="Processor time of the training, all threads together.",
)
TRAINING_ITERATIONS = replace(
    TRAINING_TIME,
    name="training_iterations",
    label="Iterations",
    unit="",
    digits=0,
    machine_bound=False,
    implementation="headbench.metrics.training:training_iterations",
    summary="Iterations of the training.",
)


def training_time(record: Mapping[str, Any]) -> Measurement:
    """Minutes of wall clock from the start of the fit to its end.

    Details: ``seconds``, and ``threads``, ``cores`` and ``other_cores`` of `ProcessorLoad` if recorded.

    Raises `UnavailableError` if the training was interrupted, since only its last part was recorded.
    """
    interruptions = int(record.get("interruptions", 0))
    if interruptions:
        times = "once" if interruptions == 1 else f"{interruptions} times"
        raise UnavailableError(f"The training was interrupted {times}.", "Train it in one go for its time.")
    seconds = _number(record, "seconds")
    load = record.get("load", {})
    threads = {name: float(load[name]) for name in ("threads", "cores", "other_cores") if name in load}
    return Measurement(seconds / 60, {"seconds": seconds, **threads})


def training_processor(record: Mapping[str, Any]) -> Measurement:
    """Processor seconds from the start of the fit to its end, of all threads and finished child processes.

    Raises `UnavailableError` if the training was interrupted, as `training_time` does.
    """
    details = training_time(record).details
    return Measurement(
        _number(record, "processor_seconds"), {k: v for k, v in details.items() if k != "seconds"}
    )


def training_iterations(record: Mapping[str, Any]) -> Measurement:
    """Iterations in the budget of the training.

    Raises `UnavailableError` for a budget with a limit in seconds.
    """
    budget = record.get("method", {}).get("budget", {})
    if budget.get("iterations") is None or budget.get("seconds") is not None:
        raise UnavailableError(
            "The budget was limited in seconds.", "Limit iterations alone for their number."
        )
    return Measurement(float(budget["iterations"]), {})


def training_memory(record: Mapping[str, Any]) -> Measurement:
    """Peak resident memory of the training process, in gigabytes (SI), including interpreter and libraries.

    Details: ``bytes``; ``before_bytes``, resident memory when the training began, including earlier cells of
    a run.
    """
    peak = _number(record, "peak_memory_bytes")
    details = {"bytes": peak}
    if "memory_before_bytes" in record:
        details["before_bytes"] = _number(record, "memory_before_bytes")
    return Measurement(peak / 1e9, details)


def _number(record: Mapping[str, Any], key: str) -> float:
    if key not in record:
        raise UnavailableError(f"The record of the training has no {key}.", "Train the avatar again.")
    return float(record[key])
