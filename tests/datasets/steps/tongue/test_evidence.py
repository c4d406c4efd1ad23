"""What counts as a tongue and what does not, on painted heads."""

import numpy as np

from headbench.datasets.steps.tongue.evidence import ALWAYS, NEVER, find_evidence
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
