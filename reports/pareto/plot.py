"""Scatter plots of quality over costs, the Pareto front as a line."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ...bench.specs import MetricSpec
from ..plots import GREY, MARKERS, SMALL, cost_axis, plot_file, show_missing, start_axes
from .points import ParetoPoint, RatePoint, front_of

MARKER = 7.0
"""Diameter of a point, in points of 1/72 inch."""
BESIDE = ((7, -8, "left"), (-7, 3, "right"), (7, 3, "left"), (-7, -8, "right"))
"""Positions of a label: offset of its lower edge from the point, in points, and its alignment."""


def write_plot(
    path: Path,
    points: Sequence[ParetoPoint],
    costs: Mapping[str, str],
    quality: str,
    *,
    higher_is_better: bool,
) -> None:
    """Draw quality over each cost (label by field of `ParetoPoint`) side by side and write a PNG, atomically.

    Costs are on a logarithmic axis. Steps connect the front of each series: its best quality up to a cost.
    Filled points are on the front of all series; squares are trained avatars.
    """
    shapes = ""
    if any(point.variant for point in points):
        shapes = " Squares: trained; circles: derived from them without training."
    machines = ", ".join(sorted({point.machine for point in points}))
    note = f"Lines: Pareto front of each method; filled: of all.{shapes} Measured on {machines}."
    size = (6.2 * len(costs), 4.9)
    names = [point.series for point in points]
    with plot_file(path, size, 200, names, note, line="") as (figure, looks):
        colours = {name: colour for name, (colour, _) in looks.items()}
        plots = list(zip(figure.subplots(1, len(costs), squeeze=False)[0], costs))
        fronts = {}
        for axes, cost in plots:
            axes.set(xlabel=costs[cost])
            start_axes(axes, quality)
            ends = [
                front_of(points, cost, higher_is_better=higher_is_better, series=s) for s in (None, *colours)
            ]
            fronts[cost] = ends
            _draw(axes, points, cost, dict(zip(colours, ends[1:])), ends[0], colours)
        figure.draw_without_rendering()  # compute the layout before placing labels
        for axes, cost in plots:
            label_points(axes, points, cost, list(itertools.chain(*fronts[cost])))


def write_rates(path: Path, points: Sequence[RatePoint], metrics: Sequence[MetricSpec], task: str) -> None:
    """Draw quality over megabytes for the steps of the codec: a curve for each method, a panel for each metric.

    Points are labelled with their step. Sizes are on a logarithmic axis; dashed lines are the quality of avatars as trained,
    whose size is not shown.
    """
    names = list(dict.fromkeys(point.method for point in points))
    subjects = {subject for point in points for subject in point.megabytes}
    note = (
        f"Lines: one codec at several steps, multiplied by the number beside a point; dashed: as trained. "
        f"Means over {counted(len(subjects), 'subject')}."
    )
    size = (6.2 * len(metrics), 4.9)
    with plot_file(path, size, 200, names, note, line="-", markers=MARKERS) as (figure, looks):
        panels = figure.subplots(1, len(metrics), squeeze=False)[0]
        for axes, metric in zip(panels, metrics):
            unit = f", {metric.unit}" if metric.unit else ""
            axes.set(xlabel="Size, MB")
            start_axes(axes, f"{metric.label}{unit}, {TASK_TITLES.get(task, task).lower()}")
            drawn = [_draw_rates(axes, points, metric.name, name, *look) for name, look in looks.items()]
            if any(drawn):
                cost_axis(axes)
            else:
                show_missing(axes, "not measured in these runs")


def _draw_rates(
    axes: Axes, points: Sequence[RatePoint], metric: str, name: str, colour: str, marker: str
) -> bool:
    """Draw the curve of one method; return whether there is one."""
    own = {point.variant: point.mean(metric) for point in points if point.method == name}
    trained = own.pop("", None)
    curve = sorted((*value, variant) for variant, value in own.items() if value is not None)
    if curve:
        axes.plot(*list(zip(*curve))[:2], f"{marker}-", color=colour, markersize=MARKER - 2, linewidth=1)
        for size, value, variant in curve:
            step = variant.partition("-x")[2] or "1"
            axes.annotate(
                step, (size, value), (3, 4), textcoords="offset points", fontsize=SMALL - 2, color=colour
            )
    if curve and trained is not None:
        axes.axhline(trained[1], color=colour, linewidth=0.8, linestyle="--")
    return bool(curve)


def _draw(
    axes: Axes,
    points: Sequence[ParetoPoint],
    cost: str,
    fronts: Mapping[str, Sequence[int]],
    best: Sequence[int],
    colours: Mapping[str, str],
) -> None:
    """Points, steps and axis of one panel."""
    if all(getattr(point, cost) is None for point in points):
        show_missing(axes, "not measured in these runs")
        return
    for name, front in fronts.items():
        corners = [(getattr(points[i], cost), points[i].quality) for i in front]
        axes.step(*zip(*corners), where="post", color=colours[name], linewidth=1) if corners else None
    for index, point in enumerate(points):
        if getattr(point, cost) is not None:
            colour = colours[point.series]
            axes.plot(
                getattr(point, cost),
                point.quality,
                marker="o" if point.variant else "s",
                markersize=MARKER,
                color=colour,
                markerfacecolor=colour if index in best else "white",
                zorder=3,
            )
    cost_axis(axes)


def label_points(axes: Axes, points: Sequence[ParetoPoint], cost: str, order: Sequence[int]) -> None:
    """Write the names of variants next to their points without overlaps, in the given order of indices."""
    scale = axes.get_figure(root=True).dpi / 72  # type: ignore[union-attr]
    costs = {i: getattr(point, cost) for i, point in enumerate(points)}
    places = {i: (value, points[i].quality) for i, value in costs.items() if value is not None}
    taken = [
        Bbox.from_bounds(x, y, 0, 0).padded(scale * MARKER / 2)
        for x, y in axes.transData.transform(list(places.values()) or [(1, 1)])
    ]
    for index in dict.fromkeys(order):
        variant = points[index].variant
        for right, up, align in BESIDE if variant else ():
            label = axes.annotate(
                variant,
                places[index],
                (right, up),
                textcoords="offset points",
                ha=align,
                fontsize=7,
                color=GREY,
                in_layout=False,
            )
            box = label.get_window_extent()
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            label.remove()
