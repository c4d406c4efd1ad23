"""The primary endpoints of the suite: one family, the same list in code and documentation."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from headbench.bench.manifest import MethodRecord
from headbench.bench.rows import Rows
from headbench.reports.runs import RunSet
from headbench.reports.suite import suite as primary
from headbench.reports.suite.suite import MARGINS, PAIR, PRIMARY, primary_comparisons, primary_section

from ..conftest import LPIPS, PSNR
from ..made_rows import row

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "suite.md"
TASKS = tuple(dict.fromkeys(task for task, _ in PRIMARY))


def test_the_documentation_lists_the_same_endpoints():
    section = PAGE.read_text(encoding="utf-8").split("## Primary endpoints")[1].split("\n## ")[0]
    assert tuple(re.findall(r"^\| `(\w+)` \| `(\w+)` \|$", section, re.MULTILINE)) == PRIMARY
    assert "`{}` against `{}`".format(*PAIR) in section
    assert f"equivalence within {MARGINS['psnr']:g} dB" in section
    assert [*MARGINS] == ["psnr"]


@pytest.fixture
def runs():
    """Runs of ten subjects; ours ahead of ga by 0.2 dB, other in each task and metric, a third method far behind."""
    generator = np.random.default_rng(0)
    rows = [
        row(method, metric, level + generator.normal(0, 0.1), f"s{s}", task=task)
        for method, level in (("ga", 30.0), ("ours", 30.2), ("gbs", 20.0))
        for task, metric in PRIMARY
        for s in range(10)
    ]
    records = {name: MethodRecord(name, "1", "m:M", False, None, {}) for name in ("ga", "ours", "gbs")}
    return RunSet((), Rows.of(rows), (PSNR, LPIPS), TASKS, records, (), {}, {})


def test_all_endpoints_are_one_family(runs):
    found = primary_comparisons(runs)
    assert [(c.task, c.metric) for c in found] == [*PRIMARY]
    assert {(c.first, c.second, c.family) for c in found} == {(*PAIR, len(PRIMARY))}
    options = {"permutation_type": "samples", "n_resamples": np.inf, "vectorized": True}
    values = [[v for _, v in c.differences] for c in found]
    expected = np.array([stats.permutation_test((v,), np.mean, **options).pvalue for v in values])
    # Holm's procedure as a sequence of rejections, at the smallest level that rejects each hypothesis.
    order = expected.argsort()
    adjusted = {
        i: max((6 - k) * expected[j] for k, j in enumerate(order[: n + 1])) for n, i in enumerate(order)
    }
    assert [c.p_holm for c in found] == pytest.approx([min(1.0, adjusted[i]) for i in range(6)])
    assert [c.margin for c in found] == [MARGINS.get(metric) for _, metric in PRIMARY]
    assert [c.equivalent is None for c in found] == [metric not in MARGINS for _, metric in PRIMARY]


def test_the_section_shows_each_endpoint_with_its_test(runs):
    text = primary_section(runs)
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    assert len(lines) == len(PRIMARY)
    assert lines[0].startswith("| Novel view, PSNR (dB) | +0.")
    assert sum("within 0.3 dB" in line for line in lines) == 3
    assert "exploratory" in text


def test_runs_without_the_pair_have_no_primary_endpoint(runs):
    other = runs.only(["ours", "gbs"])
    assert primary_comparisons(other) == []
    assert "primary endpoints compare `ours` with `ga`" in primary_section(other)


@pytest.mark.parametrize(("planned", "interim"), [(0, 0), (10, 0), (12, len(PRIMARY))])
def test_there_is_no_verdict_before_all_subjects_are_measured(runs, monkeypatch, planned, interim):
    monkeypatch.setattr(primary, "planned_subjects", lambda runs: planned)
    text = primary_section(runs)
    assert text.count("interim: 10 of 12 subjects") == interim
    assert ("is better" in text or "no significant difference" in text) == (not interim)


def test_planned_subjects_are_those_of_the_captures():
    steps = [{"parameters": {"synthetic": {"subjects": 10}}}, {"parameters": {}}]
    run = SimpleNamespace(manifest=SimpleNamespace(clips=[SimpleNamespace(steps=steps)]))
    assert primary.planned_subjects(SimpleNamespace(runs=(run, run))) == 10
    assert primary.planned_subjects(SimpleNamespace(runs=())) == 0
