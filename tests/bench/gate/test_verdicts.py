"""Directions and tolerances, for any numbers; exit codes; what the writers make of hostile names."""

from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.gate.baseline import Baseline, ResultKey, Results, Tolerance
from headbench.bench.gate.command import (
    Verdict,
    environment_changes,
    exit_code,
    judge,
    to_junit,
    to_markdown,
)
from headbench.bench.specs import MetricSpec

SPEC = MetricSpec("m", "M", "dB", True, 2, "a:b")
numbers = st.floats(-1e6, 1e6)
sizes = st.floats(0, 1e3)


PLACE = ResultKey("t", "a", "s", "full", "m")


def verdict_of(found, expected, tolerance, place=PLACE):
    results = Results(Path("r"), {place: found}, {}, {"m": SPEC}, {}, {place: 1})
    return judge(results, Baseline("same", {}, {}, {"m": tolerance}, {place: expected}, {place: 1}))[0]


@given(numbers, numbers, sizes, st.floats(0, 1), st.booleans())
def test_a_number_fails_beyond_the_larger_tolerance_when_worse(found, expected, absolute, relative, higher):
    outcome = verdict_of(found, expected, Tolerance(higher, absolute, relative)).outcome
    allowed = max(absolute, relative * abs(expected))
    slack = 1e-6 * (1 + abs(expected) + allowed)
    better = (found - expected) * (1 if higher else -1)
    if better < -allowed - slack:
        assert outcome == "regressed"
    elif better > allowed + slack:
        assert outcome == "improved"
    elif abs(better) < allowed - slack:
        assert outcome == "pass"


@given(numbers, numbers, sizes)
def test_direction_swaps_improved_and_regressed(found, expected, absolute):
    swap = {"regressed": "improved", "improved": "regressed", "pass": "pass"}
    up = verdict_of(found, expected, Tolerance(True, absolute)).outcome
    assert verdict_of(found, expected, Tolerance(False, absolute)).outcome == swap[up]


@given(st.integers(-10_000, 10_000), st.integers(0, 500))
def test_a_move_by_exactly_the_tolerance_passes(hundredths, tolerance):
    expected, absolute = hundredths / 100, tolerance / 100
    assert verdict_of(expected - absolute, expected, Tolerance(True, absolute)).outcome == "pass"


@pytest.mark.parametrize(
    ("outcomes", "code"), [([], 3), (["unjudged"], 3), (["pass"], 0), (["improved", "new", "unjudged"], 0)]
)
def test_exit_codes(outcomes, code):
    assert exit_code([Verdict(PLACE, outcome) for outcome in outcomes]) == code


def test_default_tolerances_are_ten_digits_or_a_share_of_speed():
    assert Tolerance.default(SPEC).allowed(1000.0) == 0.1
    fast = MetricSpec("f", "F", "FPS", True, 1, "a:b", machine_bound=True)
    assert Tolerance.default(fast).allowed(100.0) == pytest.approx(30.0)


def test_a_number_without_rows_is_missing_with_the_reason():
    baseline = Baseline("same", {}, {}, {"m": Tolerance(True, 0.1)}, {PLACE: 1.0}, {PLACE: 1})
    nothing = Results(Path("r"), {}, {}, {"m": SPEC}, {}, {})
    failed = Results(Path("r"), {}, {PLACE: "failed: why"}, {"m": SPEC}, {}, {})
    assert judge(nothing, baseline)[0].outcome == "missing"
    assert judge(failed, baseline)[0].reason == "failed: why"


@given(st.text(), st.text(min_size=1))
def test_any_name_gives_valid_xml_and_stays_in_its_cell(subject, note):
    verdict = verdict_of(0.0, 1.0, Tolerance(True, 0.1), ResultKey("t", "a", subject, "full", "m"))
    root = ElementTree.fromstring(to_junit([verdict], [note]).split("\n", 1)[1])
    assert root.find("testsuite/testcase/failure") is not None
    assert all(element.get("time") for element in (*root.iter("testcase"), *root.iter("testsuite")))
    table = [line for line in to_markdown([verdict], 1, []).splitlines() if line.startswith("| regressed")]
    assert len(table) == 1
    assert table[0].replace("\\\\", "").replace("\\|", "").count("|") == 10


def test_the_environment_is_compared_entry_by_entry():
    before = {"cores": 2, "packages": {"torch": "2.4", "numpy": "2"}}
    now = {"cores": 2, "packages": {"torch": "2.5", "numpy": "2"}, "device": "cpu"}
    assert environment_changes(before, now) == ["device: None to cpu", "packages.torch: 2.4 to 2.5"]
    assert environment_changes(before, before) == []
    assert len(environment_changes({"torch": "9" * 10**6}, {})[0]) < 1000
