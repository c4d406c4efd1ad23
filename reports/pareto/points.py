"""Methods of runs as points of cost and quality with their Pareto front, and rate and distortion of coded avatars over codec
steps with the Bjontegaard difference of rates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np

from ...bench.condition import label_of
from ...bench.engine.config import CODED
from ...bench.errors import InputError
from ...bench.specs import MetricSpec
from ..aggregate import Conditions, conditions, note_of, subject_means, summarise, whole_images
from ..runs import RunData, check_same_protocol, training_labels
from ..statistics.comparisons import LEAST_SUBJECTS, half_width

Curve = Sequence[tuple[float, float]]
"""Megabytes and quality at each step of the codec."""
LEAST_POINTS = 3
"""Minimum number of steps of a curve."""
METRICS = ("psnr", "lpips")


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


@dataclass(frozen=True)
class RatePoint:
    """A method's coded avatars at one step (``variant``), or those as trained (""): megabytes and quality by subject."""

    method: str
    variant: str
    megabytes: Mapping[str, float]
    quality: Mapping[str, Mapping[str, float]]  # by metric and subject

    def mean(self, metric: str) -> tuple[float, float] | None:
        """Megabytes and quality, means over subjects; None where a subject has no value."""
        values = self.quality.get(metric, {})
        if not self.megabytes or set(values) != set(self.megabytes):
            return None
        return float(np.mean([*self.megabytes.values()])), float(np.mean([*values.values()]))


@dataclass(frozen=True)
class RateDifference:
    """Bjontegaard difference of a method to a reference, percent; negative: fewer bytes at equal quality.

    ``low`` and ``high`` are the 95 % interval over subjects, by Student's t of the logarithm, None with fewer than
    `LEAST_SUBJECTS`; ``reason`` says why there is no ``percent``.
    """

    method: str
    reference: str
    metric: str
    percent: float | None
    low: float | None = None
    high: float | None = None
    subjects: int = 0
    reason: str = ""


def read_rates(runs: Sequence[RunData], task: str) -> tuple[list[RatePoint], list[MetricSpec]]:
    """Coded avatars of runs at their steps, and the metrics of `METRICS` that the runs have; empty without coded ones.

    Several runs may have different steps of one method; a method whose values differ between them has a curve for each
    training, named as in a `RunSet`. Raises `InputError` for two runs with different values of the same training. Runs of
    different subjects are joined before (`runs.joined_subjects`).
    """
    found: list[tuple[int, RatePoint]] = []
    metrics = [m for m in runs[0].metrics if m.name in METRICS and m.per_frame] if runs else []
    for index, run in enumerate(runs):
        derived = {c.name for c in run.manifest.configuration.conditions if c.derive}
        steps = {name for name in derived if name == CODED or name.startswith(f"{CODED}-x")}
        for record in run.manifest.methods:
            if record.trivial or (record.condition and record.condition not in steps):
                continue
            sizes = _by_subject(run, record.label, SIZE, "")
            quality = {metric.name: _by_subject(run, record.label, metric.name, task) for metric in metrics}
            found.append((index, RatePoint(record.name, record.condition, sizes, quality)))
    first = {(point.method, point.variant): point for _, point in reversed(found)}
    differing = {point.method for _, point in found if point != first[point.method, point.variant]}
    labels = training_labels(runs) if differing else []
    points: dict[tuple[str, str], RatePoint] = {}
    for index, point in found:
        if point.method in differing:
            point = replace(point, method=labels[index].get(point.method, point.method))
        if points.setdefault((point.method, point.variant), point) != point:
            expected = f"the values of {label_of(point.method, point.variant)} in another run"
            raise InputError(
                runs[index].folder.root, "method", expected, "other values", "Give one of the runs."
            )
    coded = {point.method for point in points.values() if point.variant}
    return [point for point in points.values() if point.method in coded], metrics


def _by_subject(run: RunData, label: str, metric: str, task: str) -> dict[str, float]:
    """Mean of a metric by subject; subjects with missing values are left out."""
    rows = whole_images(run.rows, label, metric, task)
    bad = set(rows[rows["status"] != "ok"]["subject"])
    return subject_means(rows[~rows["subject"].isin(bad)])


def curve_of(points: Sequence[RatePoint], method: str, metric: str, subject: str) -> Curve:
    """Megabytes and quality of a method's coded avatars of one subject, by increasing size."""
    own = [p for p in points if p.method == method and p.variant and subject in p.megabytes]
    values = [(p.megabytes[subject], p.quality[metric][subject]) for p in own if subject in p.quality[metric]]
    return sorted(values)


def rate_difference(reference: Curve, other: Curve, *, higher_is_better: bool = True) -> float | None:
    """Mean difference of ln(megabytes) at equal quality, over the common range of quality of both curves.

    Bjontegaard's difference of rates (G. Bjontegaard, "Calculation of average PSNR differences between RD-curves", ITU-T
    VCEG-M33, 2001) with piecewise cubic Hermite interpolation of the logarithm of the rate in place of one cubic, as in
    ITU-T HSTP-VID-WPOM (2020), section 4.2. exp(result) - 1 is the BD-rate. Points dominated by others of the same curve
    are left out, so that quality increases with the rate.

    None with fewer than `LEAST_POINTS` points on a curve, and for curves without a common range of quality.
    """
    rates = []
    for curve in (reference, other):
        sizes = [size for size, _ in curve]
        qualities = [quality if higher_is_better else -quality for _, quality in curve]
        front = pareto_front(sizes, qualities)
        kept = {qualities[i]: math.log(sizes[i]) for i in front}
        if len(kept) < LEAST_POINTS:
            return None
        rates.append((np.array([*kept]), np.array([*kept.values()])))
    low = max(float(quality[0]) for quality, _ in rates)
    high = min(float(quality[-1]) for quality, _ in rates)
    if not low < high:
        return None
    from scipy.interpolate import PchipInterpolator

    one, two = (float(PchipInterpolator(*rate).integrate(low, high)) for rate in rates)
    return (two - one) / (high - low)


def rate_differences(
    points: Sequence[RatePoint], metrics: Sequence[MetricSpec], reference: str
) -> list[RateDifference]:
    """The difference of every method to the reference in every metric: mean over subjects, with an interval."""
    methods = [name for name in dict.fromkeys(point.method for point in points) if name != reference]
    subjects = sorted({subject for point in points for subject in point.megabytes})
    found = []
    for metric in metrics:
        for method in methods:
            values = {
                subject: rate_difference(
                    curve_of(points, reference, metric.name, subject),
                    curve_of(points, method, metric.name, subject),
                    higher_is_better=metric.higher_is_better,
                )
                for subject in subjects
            }
            found.append(_difference(method, reference, metric.name, values))
    return found


def _difference(
    method: str, reference: str, metric: str, values: Mapping[str, float | None]
) -> RateDifference:
    lacking = [subject for subject, value in values.items() if value is None]
    if lacking or not values:
        reason = (
            f"{len(lacking)} of {len(values)} subjects have fewer than {LEAST_POINTS} steps of increasing quality, or curves "
            "without a common range of quality"
        )
        return RateDifference(method, reference, metric, None, reason=reason)
    known = [float(value) for value in values.values() if value is not None]
    mean, half = fmean(known), half_width(known) if len(known) >= LEAST_SUBJECTS else None
    low, high = (None, None) if half is None else (_percent(mean - half), _percent(mean + half))
    return RateDifference(method, reference, metric, _percent(mean), low, high, len(known))


def _percent(logarithm: float) -> float:
    return 100 * math.expm1(logarithm)
