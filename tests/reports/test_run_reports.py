import numpy as np
import pandas as pd
import pytest
from PIL import Image

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.protocol import evenly
from headbench.bench.rows import Rows
from headbench.reports.contact_sheet import write_contact_sheet
from headbench.reports.runs import RunData, RunSet
from headbench.reports.table_report import layouts, table_of, table_text, write_tables


def test_tables_of_a_run(toy_run):
    files = write_tables(toy_run)
    assert [f.suffix for f in files] == [".md", ".csv", ".tex", ".html", ".json"]
    assert {f.stem for f in files} == {"comparison"}
    data = RunData.read(toy_run)
    table = table_of(RunSet.read([toy_run]))
    good, failing = table.rows
    rows = pd.read_parquet(toy_run / "rows.parquet")
    error = rows[(rows["metric"] == "error") & (rows["task"] == "novel_view") & (rows["method"] == "toy")]
    assert good.cells[0].value == pytest.approx(error.groupby("subject")["value"].mean().mean())
    assert good.cells[1].status == "missing"
    assert "Put them there." in table.notes[good.cells[1].note]
    assert good.cells[-1].value == 1.0
    assert {cell.status for cell in failing.cells} == {"failed"}
    assert "RuntimeError: the training diverged" in table.notes
    assert "Images of 8 x 6 pixels" in table.caption
    for task in ("novel_view", "self_reenactment"):
        assert data.manifest.protocols[task].hash in table.caption
    for file, name in zip(files, ("md", "csv", "latex", "html", "json")):
        assert file.read_text() == table_text([toy_run], name)


def test_metrics_of_another_table_are_shown_there_alone(toy_run, change_manifest):
    change_manifest(toy_run, lambda m: m["metrics"][-1].update(tables=["cost"]))
    runs = RunSet.read([toy_run])
    assert layouts(runs) == ("comparison", "cost")
    (column,) = table_of(runs, "cost").columns
    assert (column.metric, column.title) == ("files", "Storage and training")
    assert "files" not in {column.metric for column in table_of(runs).columns}
    assert "protocol" not in table_text([toy_run], "md", "cost")  # it is about no frames
    assert [f.name for f in write_tables(toy_run)][5:8] == ["cost.md", "cost.csv", "cost.tex"]
    with pytest.raises(InputError, match="comparison, cost"):
        table_text([toy_run], "md", "speed")
    with pytest.raises(InputError, match="md, csv, latex, html, json"):
        table_text([toy_run], "xlsx")


def test_contact_sheet_of_a_run(toy_run):
    (path,) = write_contact_sheet(toy_run, frames_per_task=2)
    assert path == toy_run / "contact_sheet.png"
    assert Image.open(path).size[0] >= 700
    sheet = np.asarray(Image.open(path).convert("RGB"))
    data = RunData.read(toy_run)
    key = evenly(data.keys("novel_view"), 2)[0]
    level = data.ground_truth(key)[0, 0, 0]
    assert (sheet == (level, level, level)).all(axis=2).sum() >= 8 * 6  # the truth of that frame is on it


def test_a_capture_that_changed_since_is_not_shown(toy_run, change_manifest):
    change_manifest(toy_run, lambda m: m["clips"][0].update(fingerprint="0" * 64))
    with pytest.raises(InputError, match="the capture of the run"):
        write_contact_sheet(toy_run)


@pytest.mark.parametrize("column", ["method", "metric", "task"])
def test_rows_of_what_the_run_does_not_have_are_refused(toy_run, column):
    rows = pd.read_parquet(RunFolder(toy_run).rows)
    Rows(rows.assign(**{column: "unheard"})).write(RunFolder(toy_run).rows)
    with pytest.raises(InputError, match=f"{column}: expected those of run.json: .*, found unheard"):
        RunData.read(toy_run)


def test_a_damaged_render_is_named(toy_run):
    path = next((toy_run / "subject1" / "toy").rglob("*.png"))
    path.write_bytes(b"no image")
    data = RunData.read(toy_run)
    with pytest.raises(InputError, match=path.name):
        [data.render("toy", task, key) for task in data.tasks for key in data.keys(task)]


def test_the_number_under_an_image_is_that_of_the_whole_image(toy_run):
    rows = pd.read_parquet(RunFolder(toy_run).rows)
    Rows(pd.concat([rows, rows.assign(region="face", value=99.0)])).write(RunFolder(toy_run).rows)
    data = RunData.read(toy_run)
    for key in data.keys("novel_view"):
        error = np.abs(data.render("toy", "novel_view", key).astype(float) - data.ground_truth(key)).mean()
        assert data.value("error", "toy", "novel_view", key) == pytest.approx(error)
        assert data.value("error", "failing", "novel_view", key) is None
        assert data.render("failing", "novel_view", key) is None
        assert "the training diverged" in data.reason("failing", "novel_view", key)
