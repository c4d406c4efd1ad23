"""The threshold lies where it changes least; reasons say what was seen."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.datasets.steps.tongue.evidence import ALWAYS, NEVER, MouthEvidence, choose_threshold, decide


def evidence(areas, seen=None):
    areas = np.asarray(areas, float)
    blank = np.zeros((len(areas), 2, 2))
    return MouthEvidence(areas, blank > 0, blank, np.ones(len(areas)) if seen is None else np.asarray(seen))


@given(st.lists(st.floats(0, 500), max_size=30))
def test_threshold_lies_in_the_widest_gap_between_its_bounds(areas):
    threshold, _ = choose_threshold(np.array(areas))
    assert NEVER <= threshold <= ALWAYS
    edges = sorted([NEVER, ALWAYS, *(a for a in areas if NEVER < a < ALWAYS)])
    widest = max(np.log(b / a) for a, b in pairwise(edges))
    around = [np.log(b / a) for a, b in pairwise(edges) if a - 0.06 <= threshold <= b + 0.06]
    assert max(around) == pytest.approx(widest, abs=0.01)


def test_a_clear_gap_is_taken():
    assert choose_threshold(np.array([0, 22, 24, 55, 58, 200]))[0] == pytest.approx(np.sqrt(24 * 55), abs=0.1)


def test_reasons():
    decided = decide(
        {10: "A", 11: "A", 12: "B", 13: "B"},
        evidence([0, 100, 33, 0], seen=[1, 1, 1, 0.1]),
        ("cam",),
        35.0,
        {10: "blur"},
    )
    assert decided.basis == "given"
    assert [decided.frames[t].excluded for t in (10, 11, 12, 13)] == [False, True, False, False]
    assert "100 mm2" in decided.frames[11].reason
    assert "near the threshold" in decided.frames[12].reason
    assert "not seen" in decided.frames[13].reason
    assert set(decided.reasons()) == {10, 11}
