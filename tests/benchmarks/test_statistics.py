"""Tests reject and intervals cover as often as they say, on nested frames that are alike; the full run is slow."""

import dataclasses

import numpy as np
import pytest

from headbench.tests.benchmarks import statistics as calibration
from headbench.tests.benchmarks.simulation import Population
from headbench.tests.benchmarks.statistics import Calibration, best_set_errors, calibrate


def test_the_simulation_has_the_moments_it_says():
    population = Population(
        400, sequences=2, timesteps=200, mean=0.5, seeds=2, seed_sd=0.3, correlation=0.8, sequence_sd=0.2
    )
    subjects = population.draw(np.random.default_rng(0))
    frames = np.array([[q.first[0] - q.second[0] for q in s.sequences] for s in subjects])
    assert frames.mean() == pytest.approx(0.5, abs=0.1)
    within = frames - frames.mean(axis=2, keepdims=True)
    neighbours = np.corrcoef(within[..., 1:].ravel(), within[..., :-1].ravel())[0, 1]
    assert neighbours == pytest.approx(0.8, abs=0.05)
    # Subject, both methods' seeds, sequence and frame: independent, so that variances add.
    assert frames[:, 0, 0].var() == pytest.approx(0.25**2 + 2 * 0.3**2 + 0.2**2 + 0.4**2, rel=0.2)
    seeds = np.array([s.means()[0] for s in subjects])
    assert (seeds[:, 0] - seeds[:, 1]).var() == pytest.approx(2 * 0.3**2, rel=0.25)


def test_a_few_trials_keep_the_promise_and_the_frame_test_does_not():
    found = calibrate("", Population(7, sequences=2, timesteps=60, correlation=0.9), 80)
    assert found.as_promised
    assert 0.87 <= found.covered <= 1.0
    assert found.rejected <= 0.12
    assert found.frame_test > 0.5


def test_a_broken_promise_is_told():
    good = Calibration("", True, True, 10_000, 0.05, 0.95, 0.9, 0.0022)
    assert good.as_promised
    for change in ({"rejected": 0.08}, {"covered": 0.92}, {"covered": 0.98}, {"rejected": 0.02}):
        assert not dataclasses.replace(good, **change).as_promised
    assert dataclasses.replace(good, promised=False, covered=0.9).as_promised


def test_five_subjects_are_not_said_to_be_tested():
    assert calibrate("", Population(5, sequences=1, timesteps=10), 3).rejected is None


def test_the_truly_best_is_seldom_left_out():
    left_out, kept = best_set_errors(4, 8, 300, advantage=0.3)
    assert left_out <= 0.05
    assert kept < 0.9
    assert best_set_errors(3, 5, 3) == (0, 1)


@pytest.mark.slow
def test_every_case_keeps_its_promise(capsys):
    findings = calibration.run()
    with capsys.disabled():
        print(f"\n{findings.text}")
    assert findings.passed
    cases = {case["case"]: case for case in findings.data["cases"]}
    for name in ("7 subjects", "9 subjects", "9 subjects, 3 seeds", "20 subjects"):
        assert 0.03 <= cases[name]["rejected"] <= 0.07
        assert 0.93 <= cases[name]["covered"] <= 0.97
        assert cases[name]["frame_test"] > 0.8
