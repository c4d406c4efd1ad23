"""The front against its definition, tried on every pair."""

from hypothesis import given
from hypothesis import strategies as st

from headbench.reports.pareto.points import pareto_front

SMALL = st.integers(0, 6)  # many ties


def beaten(point, others):
    return any(c <= point[0] and q >= point[1] and (c, q) != point for c, q in others)


@given(st.lists(st.tuples(SMALL, SMALL), max_size=25))
def test_the_front_is_what_no_other_point_beats(points):
    front = pareto_front([c for c, _ in points], [q for _, q in points])
    assert set(front) == {i for i, point in enumerate(points) if not beaten(point, points)}
    assert len(front) == len(set(front))
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)
