"""Tables of methods trained on tracking from images: beside the plain method, and not among ablations."""

import json
import re

import pandas as pd
import pytest

from headbench.bench.engine.store import RunFolder
from headbench.reports.runs import RunSet
from headbench.reports.suite.suite import CROSSED, ENDPOINTS, LARGE, condition_table, drop_table, suite_report
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
