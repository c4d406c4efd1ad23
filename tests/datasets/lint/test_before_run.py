"""What a run looks for before it trains: every error of the linter, unless the reader refuses the capture."""

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.lint.before_run import errors
from headbench.datasets.lint.catalogue import RULES
from headbench.datasets.steps.masks import set_background

from .faults import FAULTS

ERRORS = {rule.code: rule for rule in RULES if rule.severity == "error"}
OF_CAMERAS = {"HB513", "HB516"}  # which need many cameras


def test_a_good_capture_may_be_trained_on(pristine):
    clip = read_capture(pristine.union)
    assert errors(clip) == []
    assert errors(set_background(clip, (0.2, 0.4, 0.6))) == []


@pytest.mark.parametrize(
    "fault", [fault for fault in FAULTS if fault.code in ERRORS], ids=lambda fault: fault.code
)
def test_no_error_of_the_linter_is_trained_on(good, fault):
    fault.plant(good)
    try:
        clip = read_capture(good.union)
    except InputError:
        return
    assert not ERRORS[fault.code].refused
    assert [found for found in errors(clip) if found.startswith(f"{fault.code}: ")]


def test_every_error_is_tried():
    assert {*ERRORS} - {fault.code for fault in FAULTS} <= OF_CAMERAS
