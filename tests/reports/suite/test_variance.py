"""The variance between and within subjects, against drawn numbers of known deviations and a small example."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from headbench.bench.engine.store import RunFolder
from headbench.reports.runs import RunSet
from headbench.reports.suite.suite import (
    CROSSED,
    ENDPOINTS,
    LARGE,
    components,
    condition_table,
    drop_table,
    extremes_section,
    read_extremes,
    suite_report,
    variance_section,
)
from headbench.reports.table_report import table_of

PSNR = {
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
    folder = RunFolder(write_run("suite/run", PSNR))
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
    assert {row.method: row.cells[0].value for row in table.rows} == {name: PSNR[name] for name in DROP}


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
    for row in table.rows:
        wanted = [b.value - a.value for a, b in zip(plain[row.method], plain[TRACKED[row.method]])]
        kept = [i for i, column in enumerate(table_of(runs).columns) if column.metric != "fps"]
        assert [cell.value for cell in row.cells] == pytest.approx([wanted[i] for i in kept])


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
