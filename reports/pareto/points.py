"""The Pareto front of costs and qualities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...bench.errors import InputError
from ...bench.runner.scoring import FULL
from ...bench.specs import MetricSpec
from ..aggregate import summarise
from ..runs import RunData


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """Indices of the points that no other point beats, by rising cost.

    One point beats another if it costs no more and is no worse, and is strictly better in one of the two. Equal
    points do not beat each other. Lower costs and higher qualities are better; all numbers are finite.
    """
    order = sorted(range(len(costs)), key=lambda i: (costs[i], -qualities[i]))
    front: list[int] = []
    for index in order:
        last = front[-1] if front else None
        if (
            last is None
            or qualities[index] > qualities[last]
            or qualities[index] == qualities[last]
            and costs[index] == costs[last]
        ):
            front.append(index)
    return front


SIZE, SPEED, LATENCY = "storage", "fps", "latency_p50"


@dataclass(frozen=True)
class Point:
    """One method of one run, means over frames, subjects and seeds.

    ``megabytes`` and ``milliseconds`` are None where the run did not measure them. Milliseconds are the median time of
    a frame, or those of the mean rate where a run has no median. ``derived_from`` and ``variant`` are "" for a trained
    avatar.
    """

    run: str
    method: str
    derived_from: str
    variant: str
    quality: float
    megabytes: float | None
    milliseconds: float | None
    machine: str


def read_points(
    folders: Sequence[Path], task: str, metric: str, time: str = ""
) -> tuple[list[Point], list[str], MetricSpec]:
    """Read every method of every run that is no trivial baseline; return points, what was left out and why, and the metric.

    ``metric`` "" is the first of frames that the runs have; ``time`` names the metric of milliseconds; "" the median latency, or what the frames per second give.

    Raises `InputError` where runs were not scored on the same frames by the same protocol, where one lacks the
    task or the metric, and where nothing is left to show.
    """
    points: list[Point] = []
    left_out: list[str] = []
    protocols: dict[str, Path] = {}
    spec = None
    for folder in folders:
        data = RunData.read(folder)
        data.rows.check()
        if task not in data.tasks:
            raise InputError(folder, "task", ", ".join(data.tasks), task)
        found = next((m for m in data.metrics if m.per_frame and metric in ("", m.name)), None)
        if found is None:
            names = ", ".join(m.name for m in data.metrics if m.per_frame)
            raise InputError(folder, "metric", f"a metric of frames: {names}", metric)
        metric = found.name
        units = {m.name: m.unit for m in data.metrics}
        if time and units.get(time) != "ms":
            names = ", ".join(name for name, unit in units.items() if unit == "ms") or "none"
            raise InputError(folder, "time", f"a metric in ms: {names}", time)
        spec = spec or found
        protocol = data.manifest.protocols[task].hash
        protocols.setdefault(protocol, folder)
        if len(protocols) > 1:
            first = next(iter(protocols))
            expected = f"protocol {first}, that of {protocols[first]}"
            raise InputError(folder, f"protocol of {task}", expected, protocol, "Score the same frames.")
        for method in data.methods:
            if method in data.trivial:
                continue
            quality, size, speed, latency = (
                summarise(data.rows, method=method, metric=name, task=where, region=FULL)
                for name, where in ((metric, task), (SIZE, ""), (SPEED, ""), (time or LATENCY, ""))
            )
            if quality.value is None:
                left_out.append(f"{method} of {folder}: {quality.reason}")
                continue
            milliseconds = latency.value
            if milliseconds is None and not time and speed.value:
                milliseconds = 1000.0 / speed.value
            derived = data.derived.get(method)
            source, variant = (derived["from"], derived["variant"]) if derived else ("", "")
            points.append(
                Point(
                    str(folder),
                    method,
                    source,
                    variant,
                    quality.value,
                    size.value,
                    milliseconds,
                    data.machine,
                )
            )
    if spec is None or not points:
        raise InputError(
            "runs", "", "a method, no trivial baseline, with a value", "; ".join(left_out) or "none"
        )
    return points, left_out, spec
