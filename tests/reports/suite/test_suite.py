"""The endpoints and tables of a suite, and the variance between and within subjects, against small examples and scipy."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from headbench.bench.engine.store import RunFolder
from headbench.bench.experiments.specs import MOVED_LINES
from headbench.bench.manifest import MethodRecord
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.bench.rows import Rows
from headbench.reports.runs import RunSet
from headbench.reports.suite import suite as primary
from headbench.reports.suite.suite import (
    PRIMARY,
    SECTIONS,
    components,
    extremes_section,
    power_table,
    primary_comparisons,
    primary_section,
    read_extremes,
    suite_report,
    variance_table,
)

from ..conftest import LPIPS, PSNR
from ..made_rows import row

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "suite.md"
TASKS = ("novel_view", SEEN_CAMERAS, UNSEEN_CAMERAS)
MOVED = f"ours+{MOVED_LINES}"
LEVELS = {"ga": 30.0, "ours": 30.2, MOVED: 30.3, "gbs": 20.0}
CROP = replace(LPIPS, name="lpips-face", label="LPIPS face", kind="face")


def test_the_documentation_lists_the_same_endpoints():
    section = PAGE.read_text(encoding="utf-8").split("## Endpoints")[1].split("\n## ")[0]
    listed = re.findall(
        r"^\| `(\S+)` - `(\S+)` \| `(\S+)`(?: minus `(\S+)`)? \| `(\S+)` ", section, re.MULTILINE
    )
    assert listed == [(*each.pair, each.task, each.minus, each.metric) for each in PRIMARY]


@pytest.fixture
def runs():
    """Runs of ten subjects at `LEVELS`, other in each task, metric and region."""
    generator = np.random.default_rng(0)
    records, rows = {}, []
    for label, level in LEVELS.items():
        method, _, condition = label.partition("+")
        records[label] = MethodRecord(method, "1", "m:M", False, None, {}, condition=condition)
        for task in TASKS:
            for metric, region in (
                ("psnr", "full"),
                ("psnr", "face"),
                ("lpips", "full"),
                ("lpips-face", "full"),
            ):
                values = level + generator.normal(0, 0.1, 10)
                rows += [
                    row(label, metric, v, f"s{n}", task=task, region=region) for n, v in enumerate(values)
                ]
    specs = (replace(PSNR, kind="regional"), LPIPS, CROP)
    run = SimpleNamespace(folder=RunFolder(Path("run")), manifest=SimpleNamespace(clips=[]))
    return RunSet((run,), Rows.of(rows), specs, TASKS, records, (), {}, {})


def differences(runs, first, second, task, metric, region="full"):
    means = [
        runs.rows.select(method=name, metric=metric, task=task, region=region, seeds=(0,))
        .set_index("subject")["value"]
        .sort_index()
        for name in (first, second)
    ]
    return (means[0] - means[1]).to_numpy()


def test_all_endpoints_are_one_family(runs):
    found = primary_comparisons(runs)
    values = [
        differences(runs, "ours", "ga", "novel_view", "psnr", "face"),
        differences(runs, "ours", "ga", "novel_view", "lpips-face"),
        differences(runs, "ours", "ga", UNSEEN_CAMERAS, "psnr", "face"),
        differences(runs, "ours", "ga", UNSEEN_CAMERAS, "lpips-face"),
        differences(runs, MOVED, "ours", "novel_view", "psnr", "face")
        - differences(runs, MOVED, "ours", UNSEEN_CAMERAS, "psnr", "face"),
    ]
    assert [c.difference for c in found] == pytest.approx([each.mean() for each in values])
    options = {"permutation_type": "samples", "n_resamples": np.inf, "vectorized": True}
    expected = np.array([stats.permutation_test((v,), np.mean, **options).pvalue for v in values])
    # Holm's procedure as a sequence of rejections, at the smallest level that rejects each hypothesis.
    order = expected.argsort()
    adjusted = {
        i: max((5 - k) * expected[j] for k, j in enumerate(order[: n + 1])) for n, i in enumerate(order)
    }
    assert [c.p_holm for c in found] == pytest.approx([min(1.0, adjusted[i]) for i in range(5)])
    assert {c.family for c in found} == {5}


def test_the_section_has_one_verdict_for_each_endpoint(runs):
    text = primary_section(runs, runs)
    tables = [
        [line for line in part.splitlines() if line.startswith("|")][2:] for part in text.split("elsewhere")
    ]
    assert [len(lines) for lines in tables] == [len(PRIMARY)] * 2
    assert tables[0][0].startswith("| `ours` - `ga`: novel view, PSNR of the face (dB) | +0.")
    assert "novel view minus self-reenactment at unseen cameras" in tables[0][-1]
    assert sum("is better" in line or "differ" in line for line in tables[0]) == len(PRIMARY)
    crop, whole = (
        differences(runs, "ours", "ga", "novel_view", metric).mean() for metric in ("lpips-face", "lpips")
    )
    assert [f"{each:+.4f}" in tables[1][1] for each in (crop, whole)] == [True, True]
    assert not any("is better" in line for line in tables[1])


def test_runs_without_an_endpoint_have_no_verdict(runs):
    for other in (None, runs.only(["ours", "ga"]), replace(runs, metrics=runs.metrics[:2])):
        text = primary_section(other, runs)
        assert "These runs lack" in text
        assert "Holm" not in text


def test_the_power_table_scales_with_the_assumed_deviation():
    cells = [line.split(" | ") for line in power_table(10).splitlines()[2:]]
    assert [line[-1] for line in cells] == ["1.23 |", "1.33 SD |", "1.03 |", "1.33 SD |", "0.67 |"]


@pytest.mark.parametrize("subjects", [1, 2, 7])
def test_too_few_subjects_find_no_difference(subjects):
    expected = "The tests of the endpoints find no difference with fewer than 8 subjects."
    assert power_table(subjects) == expected


@pytest.mark.parametrize(("planned", "interim"), [(0, 0), (10, 0), (12, len(PRIMARY))])
def test_there_is_no_verdict_before_all_subjects_are_measured(runs, monkeypatch, planned, interim):
    monkeypatch.setattr(primary, "planned_subjects", lambda runs: planned)
    text = primary_section(runs, None)
    assert text.count("interim: 10 of 12 subjects") == interim
    assert ("is better" in text or "depends on the task" in text) == (not interim)


def test_planned_subjects_are_those_of_the_captures():
    steps = [{"parameters": {"synthetic": {"subjects": 10}}}, {"parameters": {}}]
    run = SimpleNamespace(manifest=SimpleNamespace(clips=[SimpleNamespace(steps=steps)]))
    assert primary.planned_subjects(SimpleNamespace(runs=(run, run))) == 10
    assert primary.planned_subjects(SimpleNamespace(runs=())) == 0


VALUES = {"mean-image": 20.0, "ga": 30.0, "ours": 31.0, "ours+less": 30.5, "ga+tracked": 29.0}


@pytest.fixture
def suite_run(write_run):
    return write_run("suite/run/01", VALUES)


def test_each_kind_of_captures_has_its_tables(write_run, suite_run):
    write_run("suite/run-recorded/01", {"ga": 30.0, "ours": 31.0})
    text = suite_report(suite_run.parents[1], "ours")
    recorded, exact = (text.index(f"\n# {title}\n") for title in SECTIONS.values())
    assert re.findall("^## (.*)", text[recorded:exact], re.MULTILINE) == [
        *("All frames", "Sequence EMO", "Cost", "Speed")
    ]
    assert re.findall("^## (.*)", text[exact:], re.MULTILINE)[4:] == [
        "Conditions of ours",
        "Conditions of ga",
    ]


def test_methods_and_conditions_have_differences_alone(suite_run):
    text = suite_report(suite_run.parents[1], "ours")
    found = dict(re.findall(r"^\| `(\S+)` \| (\S+)", text, re.MULTILINE))
    assert found == {"ga": "-1.0000", "ours+less": "-0.5000", "ga+tracked": "-1.0000"}
    assert not re.search(r"is better|significant|<ins>|\*\*\d", text)


def test_an_interrupted_training_has_the_processor_of_others(suite_run):
    folder = RunFolder(suite_run)
    record = json.loads(folder.manifest.read_text())
    (spec,) = (metric for metric in record["metrics"] if metric["name"] == "storage")
    record["metrics"].append({**spec, "name": "training_time"})
    folder.manifest.write_text(json.dumps(record))
    rows = pd.read_parquet(folder.rows)
    times = rows[rows.metric == "storage"].assign(metric="training_time", machine="one kind")
    times.loc[times.method == "ours", "machine"] = ""  # without a time
    times.loc[times.subject == "d", "machine"] = ""
    pd.concat([rows, times]).to_parquet(folder.rows)
    text = suite_report(suite_run.parents[1], "ours")
    assert "Trained on: one kind: subjects a, b, c; unknown processors: subjects d." in text


def avatar(subject, method, psnr, lpips, **more):
    measures = {
        "psnr": {"mean": psnr, "worst": psnr - 4, "frames": 10, "failed": 1},
        "lpips": {"mean": lpips, "worst": lpips + 0.2, "frames": 8, "failed": 0},
    }
    given = {"subject": subject, "method": method, "seed": 0, "frames": 10, "frames_broken": 1}
    return {**given, "measures": measures, "shown": ["a picture"], **more}


def test_rows_are_means_over_subjects_and_the_worst_frame(tmp_path):
    avatars = [avatar("900", "ga", 30.0, 0.1), avatar("901", "ga", 28.0, 0.2), avatar("900", "gbs", 1.0, 1.0)]
    avatars[2] |= {"missing": "no truth for its poses"}
    folder = tmp_path / "extremes"
    folder.mkdir()
    (folder / "record.json").write_text(json.dumps({"avatars": avatars}))
    found = read_extremes([tmp_path, tmp_path / "elsewhere"])
    assert [each["subject"] for each in found] == ["900", "901", "900"]
    assert not any("shown" in each for each in found)
    text = extremes_section(found)
    assert "| ga | psnr | 2 | 29.000 | 24.000 | 2 of 20 |" in text
    assert "| ga | lpips | 2 | 0.150 | 0.400 | 0 of 16 |" in text
    assert "Missing: `gbs`: no truth for its poses" in text
    assert "| gbs" not in text


def test_without_records_there_is_no_section(tmp_path):
    assert extremes_section(read_extremes([tmp_path])) == ""


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


def test_seeds_are_compared_by_method_and_difference(make_run):
    both = ("toy_plugin:METHOD", "toy_plugin:MIRROR")
    metrics = ("psnr",)
    runs = RunSet.read([make_run(str(seed), both, seeds=(seed,), metrics=metrics) for seed in range(2)])
    for of_methods, expected in ((True, {"toy", "mirror", "toy - mirror"}), (False, {"toy - mirror"})):
        lines = variance_table(runs, ("toy", "mirror"), of_methods=of_methods).splitlines()
        names = {line.split("|")[1].strip() for line in lines if line.startswith("| ")} - {"", "---"}
        assert names == expected
    assert variance_table(RunSet.read([make_run("one", both, metrics=metrics)]), ("toy", "mirror")) == ""
