"""Whether the mechanism of a method acts: how much it changes the avatar's splats over the poses of the training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..bench.contracts import Avatar, BoolArray, Camera, ChangingAvatar, FloatArray, HeadPose, Measurement
from ..bench.errors import UnavailableError
from ..bench.specs import DYNAMIC, MetricSpec

THRESHOLDS = {"opacity": 0.05, "color": 0.05, "position": 0.5}
"""Range of a quantity above which a splat is dynamic; positions in millimetres."""
DYNAMIC_SPLATS = MetricSpec(
    name=DYNAMIC,
    label="Dynamic splats",
    unit="%",
    higher_is_better=True,
    digits=1,
    implementation="headbench.metrics.mechanism:dynamic_splats",
    summary="Splats that the method's own mechanism changes over the training poses; below 5 % it is off.",
    kind="mechanism",
    tables=("mechanism",),
    default=True,
)


def _detail(name: str, label: str, summary: str, unit: str = "%", digits: int = 1) -> MetricSpec:
    """Another value measured with `DYNAMIC_SPLATS`."""
    spec = replace(DYNAMIC_SPLATS, name=name, detail=name, label=label, summary=summary)
    return replace(spec, unit=unit, digits=digits)


_SPLATS = "splats that the penalty of ours keeps constant in more than half of the training poses"
DYNAMIC_FREE = _detail("dynamic_free", "not penalised", f"Dynamic splats, without {_SPLATS}.")
DYNAMIC_PENALISED = _detail("dynamic_penalised", "penalised", f"Dynamic ones among the {_SPLATS}.")
_LARGEST = "Largest change of a splat over the training poses by the mechanism"
OPACITY_RANGE = _detail("opacity_range", "Opacity", f"{_LARGEST}: opacity.", "", 4)
COLOR_RANGE = _detail("color_range", "Colour", f"{_LARGEST}: colour.", "", 3)
POSITION_RANGE = _detail("position_range", "Position", f"{_LARGEST}: position.", "mm", 2)


def dynamic_splats(avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]]) -> Measurement:
    """Percentage of the splats of `ChangingAvatar.changes` whose range over the poses exceeds `THRESHOLDS` in any quantity.

    The range is the largest value minus the smallest one, of the channel or axis with the largest difference: 0.05 of
    opacity or colour, 0.5 mm of position. 0 if the avatar was trained without the mechanism.

    Details: ``poses``; ``splats``; for each quantity ``<quantity>_range``, the largest of all splats, and ``<quantity>_mean``,
    their mean. If the method has a penalty, the same as ``dynamic_free``, ``<quantity>_range_free``, ``<quantity>_mean_free`` and
    ``..._penalised``: a splat is penalised if it is in more than half of the poses.

    Raises `UnavailableError` for an avatar that does not show its mechanism.
    """
    if not isinstance(avatar, ChangingAvatar):
        raise UnavailableError("The method declares no mechanism of its own.", "")
    least: dict[str, FloatArray] = {}
    most: dict[str, FloatArray] = {}
    penalised: FloatArray | None = None
    for _, pose in workload:
        changes = avatar.changes(pose)
        for name, values in changes.values.items():
            least[name] = np.minimum(least.get(name, values), values)
            most[name] = np.maximum(most.get(name, values), values)
        if changes.penalised is not None:
            penalised = changes.penalised + (0 if penalised is None else penalised)
    spans = {name: most[name] - least[name] for name in most}
    ranges = {name: span if span.ndim == 1 else span.max(axis=1) for name, span in spans.items()}
    count = len(next(iter(ranges.values()), ()))
    details = _summary(ranges, np.ones(count, bool), "")
    if penalised is not None:
        held = penalised > len(workload) / 2
        details |= _summary(ranges, held, "_penalised") | _summary(ranges, ~held, "_free")
    return Measurement(details.pop("dynamic"), {"poses": len(workload), "splats": count, **details})


def _summary(ranges: dict[str, FloatArray], chosen: BoolArray, suffix: str) -> dict[str, float]:
    """Percentage of dynamic splats, and largest and mean ranges, of the chosen ones; zeros without any."""
    dynamic = np.zeros(int(chosen.sum()), bool)
    summary: dict[str, float] = {}
    for name, values in ranges.items():
        chosen_values = values[chosen]
        dynamic |= chosen_values > THRESHOLDS[name]
        summary[f"{name}_range{suffix}"] = float(chosen_values.max(initial=0.0))
        summary[f"{name}_mean{suffix}"] = float(chosen_values.mean()) if len(chosen_values) else 0.0
    return {f"dynamic{suffix}": 100 * float(dynamic.mean()) if len(dynamic) else 0.0, **summary}
