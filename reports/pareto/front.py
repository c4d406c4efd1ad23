"""The Pareto front of costs and qualities."""

from __future__ import annotations

from collections.abc import Sequence


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
