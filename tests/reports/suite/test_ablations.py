"""Tables of ablations: each cell a difference from the method in the first run."""

import pandas as pd
import pytest

from headbench.bench.condition import PLAIN, Condition
from headbench.bench.engine.store import RunFolder
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.reports.runs import RunSet
from headbench.reports.statistics.comparisons import PairedComparison
from headbench.reports.suite.suite import _cell, ablation_table
from headbench.reports.table_report import table_of


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
