"""Methods of runs as points of cost and quality, and their Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...bench.errors import InputError
from ...bench.specs import MetricSpec
from ..aggregate import Conditions, conditions, note_of, summarise
from ..runs import RunData, check_same_protocol


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """Indices of the points on the Pareto front, by increasing cost.

    One point dominates another if it costs no more and is no worse, and is strictly better in one of the two. Equal
    points do not dominate each other. Lower costs and higher qualities are better; all numbers are finite.
    """
    front: list[int] = []
    for index in sorted(range(len(costs)), key=lambda i: (costs[i], -qualities[i])):
        point = qualities[index], costs[index]
        last = (qualities[front[-1]], costs[front[-1]]) if front else None
        if last is None or point[0] > last[0] or point == last:
            front.append(index)
    return front


SIZE, SPEED, LATENCY = "storage", "fps", "latency_p50"


@dataclass(frozen=True)
class ParetoPoint:
    """One method of one run, means over frames, subjects and seeds.

    ``megabytes`` and ``milliseconds`` are None where the run did not measure them. Milliseconds are the
    median frame time, or the inverse of the mean rate if a run has no median. ``derived_from`` and
    ``variant`` are "" for a trained avatar.
    """

    run: str
    method: str
    derived_from: str
    variant: str
    quality: float
    megabytes: float | None
    milliseconds: float | None
    machine: str

    @property
    def series(self) -> str:
        """The method that was trained."""
        return self.derived_from or self.method


def front_of(
    points: Sequence[ParetoPoint], cost: str, *, higher_is_better: bool, series: str | None = None
) -> list[int]:
    """Indices of the front of all points, or of one series, whose cost (a field of `ParetoPoint`) was measured."""
    among = [i for i, point in enumerate(points) if series in (None, point.series)]
    known = [i for i in among if getattr(points[i], cost) is not None]
    sign = 1.0 if higher_is_better else -1.0
    front = pareto_front([getattr(points[i], cost) for i in known], [sign * points[i].quality for i in known])
    return [known[i] for i in front]


def read_points(
    runs: Sequence[RunData], task: str, metric: str, time: str = ""
) -> tuple[list[ParetoPoint], list[str], MetricSpec, str]:
    """Every method of every run except trivial baselines, as points; return these, omitted methods with reasons,
    the metric, and a note on frame times that are not comparable ("": all are).

    ``metric`` "" is the first of frames that the runs have; ``time`` names the metric of milliseconds; "" the
    median latency, or the inverse of the frames per second. Raises `InputError` if runs were scored on
    different frames or protocols, if one lacks the task or the metric, and if no point remains.
    """
    points: list[ParetoPoint] = []
    left_out: list[str] = []
    timings: dict[str, Conditions] = {}
    spec = None
    for data in runs:
        folder = data.folder.root
        data.rows.check()
        if task not in data.tasks:
            raise InputError(folder, "task", ", ".join(data.tasks), task)
        found = next((m for m in data.metrics if m.per_frame and metric in ("", m.name)), None)
        if found is None:
            names = ", ".join(m.name for m in data.metrics if m.per_frame)
            raise InputError(folder, "metric", f"a metric of frames: {names}", metric)
        metric = found.name
        spec = spec or found
        times = [m.name for m in data.metrics if m.unit == "ms"]
        if time and time not in times:
            raise InputError(folder, "time", f"a metric in ms: {', '.join(times) or 'none'}", time)
        check_same_protocol(runs[0], data, task)
        measured = conditions(data.rows, data.metrics, data.methods)
        derived = {c.name for c in data.manifest.configuration.conditions if c.derive}
        for record in data.manifest.methods:
            if record.trivial:
                continue
            label = record.label
            quality, size, speed, latency = (
                summarise(data.rows, label, name, where)
                for name, where in ((metric, task), (SIZE, ""), (SPEED, ""), (time or LATENCY, ""))
            )
            if quality.value is None:
                left_out.append(f"{label} of {folder}: {quality.reason}")
                continue
            milliseconds, timed = latency.value, time or LATENCY
            if milliseconds is None and not time and speed.value:
                milliseconds, timed = 1000.0 / speed.value, SPEED
            if milliseconds is not None and label in measured.get(timed, {}):
                timings[label if len(runs) == 1 else f"{label} of {folder}"] = measured[timed][label]
            source, variant = (record.name, record.condition) if record.condition in derived else ("", "")
            costs = size.value, milliseconds
            points.append(
                ParetoPoint(str(folder), label, source, variant, quality.value, *costs, data.machine)
            )
    if spec is None or not points:
        found_instead = "; ".join(left_out) or "none"
        raise InputError("runs", "", "a method, no trivial baseline, with a value", found_instead)
    return points, left_out, spec, note_of(timings)
