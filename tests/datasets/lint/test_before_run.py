"""What a run looks for before it trains: the linter's errors that make every result meaningless, and no others."""

import pytest

from headbench.datasets.ga.reader import read_capture
from headbench.datasets.lint.before_run import CODES, errors

from .faults import FAULTS

VOID = [fault for fault in FAULTS if fault.code in CODES]


def test_a_good_capture_may_be_trained_on(pristine):
    assert errors(read_capture(pristine.union)) == []


@pytest.mark.parametrize("fault", VOID, ids=lambda fault: fault.code)
def test_a_capture_that_shows_no_head_may_not(good, fault):
    fault.plant(good)
    found = errors(read_capture(good.union, cy="bottom"))
    assert found
    assert found[0].startswith(f"{fault.code}: ")


def test_every_error_is_tried():
    assert {fault.code for fault in VOID} == {*CODES}
