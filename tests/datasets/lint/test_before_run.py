"""What a run looks for before it trains: every error of the linter, unless the reader refuses the capture."""

import numpy as np
import pytest

from headbench.bench.contracts import no_progress
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.lint.catalogue import RULES, errors
from headbench.datasets.lint.evidence import Evidence
from headbench.datasets.lint.settings import LintSettings
from headbench.datasets.steps.masks import set_background

from ..plain_reader import PlainClip
from .faults import FAULTS

ERRORS = {rule.code: rule for rule in RULES if rule.severity == "error"}
TRIED_ELSEWHERE = {"HB511", "HB513", "HB516"}  # in test_rules and test_cameras


def test_a_good_capture_may_be_trained_on(pristine):
    clip = read_capture(pristine.union)
    assert errors(clip) == []
    assert errors(set_background(clip, (0.2, 0.4, 0.6))) == []


@pytest.mark.parametrize(
    "fault", [fault for fault in FAULTS if fault.code in ERRORS], ids=lambda fault: fault.code
)
def test_no_error_of_the_linter_is_trained_on(good, fault):
    fault.plant(good)
    if ERRORS[fault.code].refused:
        with pytest.raises(InputError) as refusal:
            read_capture(good.union)
        evidence = Evidence.of_files(good.union, LintSettings(), no_progress)
        assert str(evidence.faults[0].error) == str(refusal.value), (
            "errors are collected in the reader's order"
        )
        return
    try:
        clip = read_capture(good.union)
    except InputError:
        return
    assert [found for found in errors(clip) if found.startswith(f"{fault.code}: ")]


def _room_behind(good):
    next(fault for fault in FAULTS if fault.code == "HB309").plant(good)


SOUND = {
    "the room behind, without masks": _room_behind,
    "soft masks up to 254": lambda good: good.each_image(lambda image, mask: mask // 255 * 254, masks=True),
    "masks with colours": lambda good: good.each_image(lambda image, mask: np.dstack([mask] * 3), masks=True),
    "masks with alpha": lambda good: good.each_image(
        lambda image, mask: np.dstack([np.full_like(mask, 255)] * 3 + [mask]), masks=True
    ),
    "no masks": lambda good: good.without_masks(),
}


@pytest.mark.parametrize("kind", SOUND)
def test_what_is_no_error_may_be_trained_on(good, kind):
    SOUND[kind](good)
    assert errors(read_capture(good.union)) == []


UNSOUND = {
    "HB307": lambda image, mask: 16 + (mask * (219 / 255)).astype(np.uint8),  # of a video of masks
    "HB304": lambda image, mask: np.zeros_like(mask),
    "HB305": lambda image, mask: np.full_like(mask, 255),
}


@pytest.mark.parametrize("code", UNSOUND)
def test_a_clip_without_files_is_searched(good, code):
    """As a reader of a plug-in may give."""
    good.each_image(UNSOUND[code], masks=True)
    clip = read_capture(good.union)
    found = errors(PlainClip(clip))
    assert found[0].startswith(f"{code}: ")


def test_leaks_that_the_reader_was_asked_to_record_are_no_error(good):
    next(fault for fault in FAULTS if fault.code == "HB201").plant(good)
    assert errors(read_capture(good.union, leaks="record")) == []


def test_every_error_is_tried():
    assert {*ERRORS} - {fault.code for fault in FAULTS} <= TRIED_ELSEWHERE
