"""The variance between and within subjects, against drawn numbers of known deviations and a small example."""

import numpy as np
import pytest

from headbench.reports.runs import RunSet
from headbench.reports.suite.variance import components, variance_section


def test_components_are_those_of_a_small_example():
    by_seed = {0: {"a": 1.0, "b": 5.0, "c": 9.0}, 1: {"a": 3.0, "b": 5.0}}
    subjects, mean, between, within = components(by_seed)
    assert (subjects, mean) == (2, 3.5)
    assert between == pytest.approx(np.std([2, 5], ddof=1))
    assert within == pytest.approx(np.sqrt((2 + 0) / 2))


def test_drawn_deviations_are_found_again():
    generator = np.random.default_rng(0)
    levels = 0.5 * generator.standard_normal(2000)
    by_seed = {
        seed: {str(i): level + 0.1 * generator.standard_normal() for i, level in enumerate(levels)}
        for seed in range(3)
    }
    _, _, between, within = components(by_seed)
    assert within == pytest.approx(0.1, rel=0.05)
    assert between == pytest.approx(np.hypot(0.5, 0.1 / np.sqrt(3)), rel=0.05)


@pytest.mark.parametrize("by_seed", [{}, {0: {"a": 1.0, "b": 2.0}}, {0: {"a": 1.0}, 1: {"a": 2.0}}])
def test_one_seed_or_one_subject_has_no_components(by_seed):
    assert components(by_seed) is None


def test_the_section_has_methods_and_their_difference(make_run):
    both = ("toy_plugin:METHOD", "toy_plugin:MIRROR")
    metrics = ("psnr",)
    runs = RunSet.read([make_run(str(seed), both, seeds=(seed,), metrics=metrics) for seed in range(2)])
    lines = variance_section(runs, ("toy", "mirror")).splitlines()
    names = {line.split("|")[1].strip() for line in lines if line.startswith("| ")} - {"", "---"}
    assert names == {"toy", "mirror", "toy - mirror"}
    assert variance_section(RunSet.read([make_run("one", both, metrics=metrics)]), ("toy", "mirror")) == ""
