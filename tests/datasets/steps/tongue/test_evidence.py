"""What counts as a tongue and what does not, on painted heads."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.datasets.steps.tongue.evidence import (
    ALWAYS,
    NEVER,
    MouthEvidence,
    choose_threshold,
    decide,
    find_evidence,
)
from headbench.datasets.steps.tongue.mouth import facing_cameras, mouth_atlas, sample_clip

from .painted import BLUSH, INSIDE, SKIN, TONGUE, Moment, painted_clip

REST = [Moment({"head_turn": 0.05 * np.sin(t), "jaw_open": 0.1 * (t % 3)}) for t in range(9)]


def areas(moments, **how):
    clip = painted_clip([*REST, *moments], **how)
    atlas = mouth_atlas(clip)
    evidence = find_evidence(sample_clip(clip, atlas, facing_cameras(clip, atlas, 4)), atlas)
    return evidence.areas, evidence


def test_tongues_are_found_and_nothing_else_is():
    tongue = [
        Moment({"jaw_open": 0.4}, blob=TONGUE),
        Moment({"jaw_open": 0.7, "head_turn": 0.1}, blob=TONGUE, drop=0.016, radius=0.014),
        Moment({"jaw_open": 0.3}, blob=TONGUE, drop=0.014),
    ]
    other = [
        Moment({"jaw_open": 0.9}),
        Moment({"smile_left": 1.0, "smile_right": 1.0, "jaw_open": 0.3}),
        Moment({"pucker": 1.0}, lip_tint=tuple(BLUSH)),
        Moment({"mouth_left": 1.0}),
        Moment(tint=tuple(BLUSH)),
        Moment({"chin_raise": 1.0}, lines=0.5),
        Moment({"jaw_open": 0.5}, tint=(0.6, 0.6, 0.6)),
    ]
    found, _ = areas([*tongue, *other], tracking_mm=1.0)
    first = len(REST)
    assert (found[first : first + len(tongue)] > ALWAYS).all(), found
    assert (found[:first] < NEVER).all(), found
    assert (found[first + len(tongue) :] < NEVER).all(), found


def test_what_does_not_begin_at_the_mouth_is_no_tongue():
    found, evidence = areas([Moment(blob=TONGUE, drop=0.030, radius=0.008)])
    assert found[-1] == 0
    assert (evidence.strength[-1].astype(float) > 4).sum() > 20  # it is seen all the same


def test_darkness_teeth_and_the_subjects_own_skin_are_no_tongue():
    colours = [INSIDE * 0.3, np.full(3, 0.7), SKIN * 0.9]
    found, _ = areas([Moment({"jaw_open": 0.4}, blob=colour) for colour in colours])
    assert (found[-3:] < NEVER).all()


def test_area_is_that_of_what_covers_the_closed_mouth():
    sizes = np.array([0.009, 0.012, 0.015])
    moments = [Moment(blob=TONGUE, drop=radius + 0.001, radius=radius) for radius in sizes]
    found, _ = areas(moments, yaws=(0.0,))
    # A rim of about half a pixel of the map is added by its smoothing.
    np.testing.assert_allclose(found[-3:], np.pi * sizes**2 * 1e6, rtol=0.25)


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
