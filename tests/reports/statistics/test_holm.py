import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.reports.statistics.comparisons import holm

p_values = st.lists(st.floats(0, 1), min_size=1, max_size=7)


def rejected_step_by_step(values, level):
    """Holm's own description: go on from the least p-value while it is at most the level over those left."""
    rejected = set()
    for done, index in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        if values[index] * (len(values) - done) > level:
            break
        rejected.add(index)
    return rejected


@given(p_values, st.sampled_from([0.01, 0.05, 0.1]))
def test_rejects_what_the_sequential_procedure_rejects(values, level):
    adjusted = holm(values)
    assert {i for i, p in enumerate(adjusted) if p <= level} == rejected_step_by_step(values, level)


@given(p_values)
def test_lies_between_the_p_value_and_bonferroni_and_keeps_the_order(values):
    adjusted = np.array(holm(values))
    assert (adjusted >= values).all()
    assert (adjusted <= np.minimum(1, len(values) * np.array(values))).all()
    assert (np.diff(adjusted[np.argsort(values, kind="stable")]) >= 0).all()


def test_an_example_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
