"""The variance between and within subjects, against drawn numbers of known deviations and a small example."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from headbench.bench.condition import PLAIN, Condition
from headbench.bench.engine.store import RunFolder
from headbench.bench.manifest import MethodRecord
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.bench.rows import Rows
from headbench.reports.runs import RunSet
from headbench.reports.statistics.comparisons import PairedComparison
from headbench.reports.suite import suite as primary
from headbench.reports.suite.suite import (
    CROSSED,
    ENDPOINTS,
    LARGE,
    MARGINS,
    PAIR,
    PRIMARY,
    _cell,
    ablation_table,
    components,
    condition_table,
    drop_table,
    extremes_section,
    primary_comparisons,
    primary_section,
    read_extremes,
    suite_report,
    variance_section,
)
from headbench.reports.table_report import table_of

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


def test_rows_are_ablations_and_cells_their_differences(make_run):
    both = ("toy_plugin:MIRROR", "toy_plugin:METHOD")
    conditions = (PLAIN, Condition("less", ("toy",), {"level": 0.5}))
    runs = RunSet.read(
        [make_run("run", methods=both, settings={"toy": {"level": 0.25}}, conditions=conditions)]
    )
    table = ablation_table(runs, "toy", {"toy+less": "less"})
    (row,) = table.rows
    assert row.method == "less"
    plain = {line.method: line for line in table_of(runs).rows}
    assert "mirror" in plain
    wanted = [b.value - a.value for a, b in zip(plain["toy"].cells, plain["toy+less"].cells)]
    assert [cell.value for cell in row.cells] == pytest.approx(wanted)
    assert any(wanted)
    assert [float(cell.text.split()[0]) for cell in row.cells] == pytest.approx(wanted, abs=1e-3)


def test_crossed_cells_are_differences_between_the_tasks(make_run):
    conditions = (PLAIN, Condition("less", ("toy",), {"level": 0.5}))
    runs = RunSet.read([make_run("run", settings={"toy": {"level": 0.25}}, conditions=conditions)])
    names = {"toy+less": "less"}
    plain, crossed = (ablation_table(runs, "toy", names, crossed=each) for each in (False, True))
    (cells,), (found,) = ([row.cells for row in table.rows] for table in (plain, crossed))
    by_task = {c.task: cell.value for c, cell in zip(plain.columns, cells) if c.task}
    views = by_task.pop("novel_view")
    assert [column.task for column in crossed.columns] == [SEEN_CAMERAS, UNSEEN_CAMERAS]
    expected = [views - value for value in by_task.values()]
    assert [cell.value for cell in found] == pytest.approx(expected, abs=1e-9)
    assert any(abs(value) > 0 for value in expected)
    assert crossed.columns[0].title == "Novel view minus self-reenactment at seen cameras"
    assert "the same difference in self-reenactment" in crossed.caption


def test_speeds_of_different_runs_are_not_compared(write_run):
    runs = RunSet.read([write_run("run", {"ours": 30.0, "ours+less": 29.0})])
    table = ablation_table(runs, "ours", {"ours+less": "less"})
    assert "fps" in {column.metric for column in table_of(runs).columns}
    assert "fps" not in {column.metric for column in table.columns}
    assert [cell.value for cell in table.rows[0].cells] == pytest.approx(
        [{"psnr": -1.0, "ssim": -0.025, "lpips": 0.001, "storage": -0.1}[c.metric] for c in table.columns]
    )
    assert "Speed" not in table.caption


def test_coded_avatars_that_ablations_do_not_have_get_no_column(write_run):
    folder = RunFolder(write_run("run", {"ours": 30.0, "ours+less": 29.0}))
    rows = pd.read_parquet(folder.rows)
    rows[~((rows.condition == "less") & (rows.metric == "storage"))].to_parquet(folder.rows)
    table = ablation_table(RunSet.read([folder.root]), "ours", {"ours+less": "less"})
    assert {column.metric for column in table.columns} == {"psnr", "ssim", "lpips"}
    assert len(table.rows[0].cells) == len(table.columns)


@pytest.mark.parametrize(
    ("found", "text", "rank"),
    [
        ({"difference": -0.25, "low": -0.3, "high": -0.2, "p_holm": 0.02}, "-0.250 (-0.300, -0.200)", 1),
        ({"difference": 0.25, "low": -0.1, "high": 0.4, "p_holm": 0.2}, "+0.250 (-0.100, +0.400)", None),
        ({"difference": 0.25, "p_holm": 1.0}, "+0.250", None),
        ({"reason": "failed on 1 subject"}, "failed on 1 subject", None),
    ],
)
def test_a_cell_has_difference_interval_and_mark(found, text, rank):
    cell = _cell(PairedComparison("novel_view", "psnr", True, "less", "whole", **found), 2)
    assert (cell.text, cell.rank) == (text, rank)


VALUES = {
    "mean-image": 20.0,
    "ga": 30.0,
    "ours": 31.0,
    "ours+less": 30.5,
    "ga+tracked": 29.0,
    "ours+tracked": 30.75,
}
TRACKED = {"ga": "ga+tracked", "ours": "ours+tracked"}
DROP = {"ga": 1.5, "ours": 1.0, "ga+tracked": 0.25, "ours+tracked": -0.5}


@pytest.fixture
def tracked_run(write_run):
    """A suite's run whose self-reenactment is worse than its novel views by `DROP`."""
    folder = RunFolder(write_run("suite/run", VALUES))
    rows = pd.read_parquet(folder.rows)
    for label, drop in DROP.items():
        name, _, condition = label.partition("+")
        own = (rows.method == name) & (rows.condition == condition)
        rows.loc[own & (rows.task == "self_reenactment") & (rows.metric == "psnr"), "value"] -= drop
    rows.to_parquet(folder.rows)
    return folder.root


def of_tracked(folder):
    return RunSet.read([folder]).only([*TRACKED, *TRACKED.values()])


def test_the_drop_is_novel_view_minus_self_reenactment(tracked_run):
    table = drop_table(of_tracked(tracked_run))
    assert {row.method: row.cells[-1].value for row in table.rows} == pytest.approx(DROP)
    assert {row.method: float(row.cells[-1].text) for row in table.rows} == pytest.approx(DROP, abs=1e-4)
    assert {row.method: row.cells[0].value for row in table.rows} == {name: VALUES[name] for name in DROP}


def test_a_drop_is_missing_where_a_task_has_no_values(tracked_run):
    folder = RunFolder(tracked_run)
    rows = pd.read_parquet(folder.rows)
    rows[rows.task != "self_reenactment"].to_parquet(folder.rows)
    table = drop_table(of_tracked(tracked_run))
    assert {row.method: row.cells[-1].value for row in table.rows} == dict.fromkeys(DROP)


def test_rows_are_methods_and_cells_tracked_minus_plain(tracked_run):
    runs = of_tracked(tracked_run)
    table = condition_table(runs, TRACKED, "Tracked from images")
    plain = {row.method: row.cells for row in table_of(runs).rows}
    assert [row.method for row in table.rows] == [*TRACKED]
    for line in table.rows:
        wanted = [b.value - a.value for a, b in zip(plain[line.method], plain[TRACKED[line.method]])]
        kept = [i for i, column in enumerate(table_of(runs).columns) if column.metric != "fps"]
        assert [cell.value for cell in line.cells] == pytest.approx([wanted[i] for i in kept])


def test_tracking_from_images_is_no_ablation(tracked_run):
    sections = re.split("^## ", suite_report(tracked_run.parent, "ours"), flags=re.MULTILINE)[1:]
    by_title = {section.partition("\n")[0]: section for section in sections}
    ablations = ["", ", EMO", f", {CROSSED}"]
    ablations = [f"Ablations of ours{what} (exploratory)" for what in ablations]
    tracked = "Tracked from images (exploratory)"
    plain = [
        "Primary endpoints",
        *(f"{name} (exploratory)" for name in ("All frames", "Sequence EMO", "Cost", "Speed")),
    ]
    assert [*by_title] == [*plain, tracked, *ablations]
    assert {title for title, text in by_title.items() if "tracked" in text} == {tracked}
    assert {title for title, text in by_title.items() if "| less" in text} == {*ablations}


def test_ablations_are_compared_under_their_own_tracking(write_run):
    values = {"ga": 30.0, "ours": 31.0, "ours+less": 30.5, "ours+tracked": 29.0, "ours+less-tracked": 29.75}
    text = suite_report(write_run("suite/run", values).parent, "ours")
    found = {
        title: re.search(r"^\| less +\|.*$", section, re.MULTILINE)
        for title, section in re.findall(
            r"^## (Ablations .*?) \(exploratory\)$(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL
        )
    }
    for method, difference in {"ours": "-0.500", "ours+tracked": "+0.750"}.items():
        assert difference in found[f"Ablations of {method}"].group()
        assert "0.000" in found[f"Ablations of {method}, {CROSSED}"].group()
    assert {*found} - {f"Ablations of ours{what}" for what in ("", ", EMO", f", {CROSSED}")} == {
        f"Ablations of ours+tracked{what}" for what in ("", f", {CROSSED}")
    }


def test_an_interrupted_training_has_the_processor_of_others(tracked_run):
    folder = RunFolder(tracked_run)
    record = json.loads(folder.manifest.read_text())
    (spec,) = (metric for metric in record["metrics"] if metric["name"] == "storage")
    record["metrics"].append({**spec, "name": "training_time"})
    folder.manifest.write_text(json.dumps(record))
    rows = pd.read_parquet(folder.rows)
    times = rows[rows.metric == "storage"].assign(metric="training_time", machine="one kind")
    times.loc[times.method == "ours", "machine"] = ""  # without a time
    times.loc[times.subject == "d", "machine"] = ""
    pd.concat([rows, times]).to_parquet(folder.rows)
    text = suite_report(tracked_run.parent, "ours")
    assert "Trained on: one kind: subjects a, b, c; unknown processors: subjects d." in text


def test_large_images_have_their_own_heading(write_run):
    for name in ("run", "run-large"):
        folder = write_run(f"suite/{name}/01", {"ga": 30.0, "ours": 31.0})
    first, large = suite_report(folder.parents[1], "ours").split(f"\n# {LARGE}\n")
    primary, usual = first.split("\n\n## All frames")
    assert primary.startswith("## Primary endpoints")
    assert ENDPOINTS in usual
    # The endpoints are those of the whole suite: the other part has no note on them.
    assert large.strip() == f"## All frames{usual}".replace(f"{ENDPOINTS}\n\n", "").strip()


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


def test_the_section_has_methods_and_their_difference(make_run):
    both = ("toy_plugin:METHOD", "toy_plugin:MIRROR")
    metrics = ("psnr",)
    runs = RunSet.read([make_run(str(seed), both, seeds=(seed,), metrics=metrics) for seed in range(2)])
    lines = variance_section(runs, ("toy", "mirror")).splitlines()
    names = {line.split("|")[1].strip() for line in lines if line.startswith("| ")} - {"", "---"}
    assert names == {"toy", "mirror", "toy - mirror"}
    assert variance_section(RunSet.read([make_run("one", both, metrics=metrics)]), ("toy", "mirror")) == ""
