"""The best method of a curve at each cost, and the costs at which the best method changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ...bench.contracts import FloatArray
from ..statistics.paired import interval

Lines: TypeAlias = Mapping[str, Mapping[str, Sequence[tuple[float, float]]]]
"""Pairs of cost and quality by method and subject."""
GRID = 600
"""Costs at which curves are compared, evenly spaced on the axis of the plot."""


@dataclass(frozen=True)
class Leader:
    """A method that has the best mean from a certain cost on.

    Attributes
    ----------
    start : float
        Lowest cost at which the method is best: where its curve crosses that of the previous leader, or its lowest cost.
    interval : tuple[float | None, float | None] | None
        Costs around ``start`` at which the 95 % interval of the paired difference of both methods contains 0; an end
        beyond the measured costs is None. None instead of a pair for the first leader, for a method that is best from its
        lowest cost on without a crossing, and with too few subjects for an interval.
    measured : tuple[float, float]
        The lowest and the highest cost at which the method and the previous leader have values.
    """

    method: str
    start: float
    interval: tuple[float | None, float | None] | None
    measured: tuple[float, float]

    def text(self) -> str:
        """Method, cost and interval, such as "`ga` from 11 [8.2, above 120]"."""
        if self.interval is None:
            return f"`{self.method}` from {self.start:.3g}"
        low, high = (f"{end:.3g}" if end is not None else "" for end in self.interval)
        ends = f"{low or f'below {self.measured[0]:.3g}'}, {high or f'above {self.measured[1]:.3g}'}"
        return f"`{self.method}` from {self.start:.3g} [{ends}]"


def leaders(lines: Lines, *, higher_is_better: bool) -> list[Leader]:
    """The methods with the best mean, by increasing cost, over the subjects that all methods have.

    Quality is interpolated linearly between measured trainings, over the logarithm of the cost if all costs are above 0. A
    method is included from its lowest cost on. Beyond its highest cost it keeps the quality there, since that training also
    fits larger budgets.
    """
    subjects = sorted(set.intersection(*(set(own) for own in lines.values()))) if lines else []
    if not subjects:
        return []
    costs = [cost for own in lines.values() for subject in subjects for cost, _ in own[subject]]
    spaced = np.geomspace if min(costs) > 0 else np.linspace
    grid = spaced(min(costs), max(costs), GRID)
    sign = 1.0 if higher_is_better else -1.0
    values = {name: sign * _values(own, subjects, grid) for name, own in lines.items()}
    means = np.stack([each.mean(0) for each in values.values()])
    names = list(values)
    best = np.where(np.isnan(means), -np.inf, means).argmax(0)
    known = np.isfinite(means).any(0)
    found: list[Leader] = []
    for place in range(GRID):
        name = names[best[place]]
        if not known[place] or (found and found[-1].method == name):
            continue
        compared = [lines[name], *(lines[leader.method] for leader in found[-1:])]
        lowest = max(min(own[subject])[0] for own in compared for subject in subjects)
        around = None
        if found and np.isfinite(values[name][:, place - 1]).all():
            around = _around(values[name] - values[found[-1].method], place, grid)
        found.append(Leader(name, float(grid[place]), around, (lowest, max(costs))))
    return found


def _values(
    own: Mapping[str, Sequence[tuple[float, float]]], subjects: Sequence[str], grid: FloatArray
) -> FloatArray:
    """(S, G) qualities of the subjects at the costs of the grid; NaN below the lowest cost of any."""
    scale = np.log if grid[0] > 0 else np.positive
    pairs = [np.array(sorted(own[subject])).T for subject in subjects]
    return np.stack([np.interp(scale(grid), scale(cost), value, left=np.nan) for cost, value in pairs])


def _around(change: FloatArray, place: int, grid: FloatArray) -> tuple[float | None, float | None] | None:
    """Costs between which the interval of the mean ``change``, (S, G), contains 0, around a place of the grid."""
    # A method has no value below its lowest cost, and so no interval there.
    bounds = [interval(each.tolist()) if np.isfinite(each).all() else None for each in change.T]
    if bounds[place] is None:
        return None
    apart = [each is not None and (each[0] > 0 or each[1] < 0) for each in bounds]
    low = next((float(grid[i]) for i in range(place - 1, -1, -1) if apart[i]), None)
    high = next((float(grid[i]) for i in range(place, len(grid)) if apart[i]), None)
    return low, high
