"""Title, sentences and limits of a page, from rows whose outcome is known."""

import re

import pytest

from headbench.bench.rows import ALL, Rows
from headbench.reports.page.frames import ShownFrame, frame_values
from headbench.reports.page.verdict import _span, in_words, verdict
from headbench.reports.runs import RunData, RunSet
from headbench.reports.statistics.command import CompareSettings, compare_methods
from headbench.reports.table_report import table_of


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
        folders = CompareSettings((str(run.folder.root),))
        comparisons = compare_methods(runs, folders).data["comparisons"] if len(runs.ranked) > 1 else []
        return verdict(runs, table_of(runs), metrics, comparisons, frame_values(runs, metrics))

    return said


def text(sentences):
    return re.sub(r"<.*?>", "", " ".join(sentences)).replace("\u00a0", " ")


def test_few_subjects_name_the_lead_and_no_winner(said):
    found = said({"good": 30.0, "better": 31.25, "mean-image": 12.0})
    assert found.title == "good and better on four subjects"
    assert "better has the best PSNR in novel view: 31.2500, 1.2500 ahead of good." in text(found.sentences)
    assert "cannot decide which method is better: a test of 1 pair needs 6 subjects" in text(found.limits)
    assert "interval " not in text(found.sentences)
    assert "mean-image" not in text(found.sentences)


@pytest.mark.parametrize(
    ("shifts", "expected"),
    [
        ((0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.2, 0.1), "It is better than good (+"),
        ((1.0, -1.0, 1.2, -1.1, 1.3, -0.9, 1.1, -1.2), "Its lead over good (+"),
    ],
)
def test_enough_subjects_bring_intervals_and_a_test(said, shifts, expected):
    found = said({"good": 30.0, "better": 30.05}, shifts)
    assert expected in text(found.sentences)
    assert re.search(r"95 % interval [+−][0-9.]+ to \+[0-9.]+", text(found.sentences))
    assert "Exact sign-flip test over 8 subjects" in text(found.limits)


def test_frames_of_few_subjects_give_a_span(toy_run):
    runs = RunSet.read([toy_run])
    task = runs.tasks[0]
    metric = next(spec for spec in runs.metrics if spec.per_frame)
    frames = [ShownFrame(task, key) for key in sorted(runs.keys[task])]
    sign = 1 if metric.higher_is_better else -1
    values = {(metric.name, "toy", frame): sign * float(n % 2) for n, frame in enumerate(frames)}
    values |= {(metric.name, "failing", frame): sign * 0.5 for frame in frames}
    span = _span(runs, values, metric, task, "toy", "failing")
    digits = metric.digits
    assert f"is from −{0.5:.{digits}f} to +{0.5:.{digits}f}" in span
    assert f"({len(frames) // 2} of {len(frames)} frames ahead)" in span


def test_the_smallest_and_the_fastest_are_named(said):
    found = said({"good": 30.0, "better": 31.0})
    assert "good is the smallest, 8.0000 (better 8.1000); better is the fastest" in text(found.sentences)


def test_one_method_has_no_limits_to_state(said):
    found = said({"only": 30.0})
    assert found.title == "only on four subjects"
    assert "only reaches a PSNR of 30.0000 in novel view." in text(found.sentences)
    assert found.limits == []


def test_names_are_escaped(said):
    assert "<b>&lt;i&gt;</b>" in "".join(said({"<i>": 31.0, "other": 30.0}).sentences)


@pytest.mark.parametrize(("number", "word"), [(1, "one"), (12, "twelve"), (13, "13")])
def test_numbers_up_to_twelve_are_words(number, word):
    assert in_words(number) == word
