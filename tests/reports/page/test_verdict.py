"""The head of a page, from rows whose outcome is known."""

import re

import pytest

from headbench.bench.rows import ALL, Rows
from headbench.reports.page.sections import verdict
from headbench.reports.runs import RunData, RunSet
from headbench.reports.statistics.command import compare_methods


@pytest.fixture
def said(write_run):
    """The verdict of a run of some subjects; values of methods are shifted in each subject by a number."""

    def said(methods, shifts=(0.0,) * 4):
        run = RunData.read(write_run("run", methods))
        rows = run.rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        one = rows[rows["subject"] == "a"]
        parts = []
        for number, shift in enumerate(shifts):
            wobble = one["method"].map({name: i * shift for i, name in enumerate(methods)})
            parts.append(Rows(one.assign(subject=f"s{number}", value=one["value"] + wobble)))
        Rows.joined(parts).write(run.folder.rows)
        runs = RunSet.read([run.folder.root])
        metrics = [spec for spec in runs.metrics if spec.per_frame]
        comparisons = compare_methods(runs).data["comparisons"] if len(runs.ranked) > 1 else []
        found = verdict(runs, metrics, comparisons)
        return found, re.sub(r"<.*?>", "", " ".join(found.sentences)).replace("\u00a0", " ")

    return said


def test_few_subjects_have_a_lead_and_no_significant_difference(said):
    found, text = said({"good": 30.0, "better": 31.25, "mean-image": 12.0})
    assert found.title == "good and better on 4 subjects"
    assert "better has the best PSNR in novel view, 31.2500, 1.2500 ahead of good" in text
    assert found.limit == "4 subjects cannot show which method is better: a test of 1 pair needs 6."
    assert "significant" not in text
    assert "mean-image" not in text
    assert "good is the smallest, 8.0000 (better 8.1250). better is the fastest, 131.2500" in text


@pytest.mark.parametrize(
    ("shifts", "outcome"),
    [
        ((0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.2, 0.1), ", significant"),
        ((1.0, -1.0, 1.2, -1.1, 1.3, -0.9, 1.1, -1.2), ", not significant"),
    ],
)
def test_enough_subjects_have_an_interval_and_a_test(said, shifts, outcome):
    found, text = said({"good": 30.0, "better": 30.05}, shifts)
    assert re.search(rf"ahead of good \(95 % interval [+−][0-9.]+ to \+[0-9.]+{outcome}\)", text)
    assert "Exact sign-flip test over 8 subjects" in found.limit


def test_names_are_escaped_and_one_method_is_compared_with_none(said):
    found, _ = said({"<i>": 30.0})
    assert found.title == "<i> on 4 subjects"
    assert found.sentences[0] == "<b>&lt;i&gt;</b> has the best PSNR in novel view, 30.0000."
    assert found.limit == ""
