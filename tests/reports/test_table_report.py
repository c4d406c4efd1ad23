import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS, evenly
from headbench.bench.rows import Rows
from headbench.reports.contact_sheet import write_contact_sheet
from headbench.reports.runs import RunData, RunSet
from headbench.reports.table_report import Columns, layouts, table_of, table_text, write_tables

from .latex import compile_latex
from .made_rows import TASKS


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


METRICS = ("psnr", "ssim", "lpips", "storage", "fps")
ALL = [f"{task}/{name}" for task in TASKS for name in METRICS[:3]] + [*METRICS[3:]]
OPACITY, GEOMETRY = (
    {"lines": {"dynamic": [*names]}} for names in (["opacity"], ["position", "rotation", "scale"])
)


GALLERY = Path(__file__).parents[2] / "reports" / "gallery"


def test_tables_have_seen_and_unseen_cameras_apart():
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    rows = rows[
        rows.method.eq("ga") & rows.condition.eq("") & rows.metric.eq("psnr") & rows.region.eq("full")
    ]
    held_out = rows[rows.task == "novel_view"].camera.iloc[0]
    own = rows[rows.task == "self_reenactment"]
    groups = own.camera.where(own.camera == held_out, "seen").map(
        {"seen": SEEN_CAMERAS, held_out: UNSEEN_CAMERAS}
    )
    expected = own.groupby([groups, "sequence"]).value.mean().groupby(level=0).mean().to_dict()
    table = table_of(RunSet.read([GALLERY]), columns=Columns(("psnr", "self_reenactment")))
    (row,) = [row for row in table.rows if row.method == "ga"]
    found = {column.task: cell.value for column, cell in zip(table.columns, row.cells, strict=True)}
    assert found == pytest.approx(expected)


def test_every_layout_compiles_in_latex(write_run, tmp_path):
    methods = {"ours": 33.0, "my_own-2": 32.0, "ga": 31.0, "insta": 28.0, "mean-image": 17.0}
    folder = write_run("a", methods, {"ours": OPACITY})
    other = write_run("b", {"ours": 33.0}, {"ours": GEOMETRY})
    texts = [table_text([folder], "latex", layout) for layout in ("comparison", "speed", "cost")]
    texts += [table_text([folder, other], "latex", paper="tensorial-2025", number=n) for n in "34"]
    compile_latex(texts, tmp_path)


@pytest.mark.parametrize(
    ("layout", "columns", "digits", "shown"),
    [
        ("comparison", (), (), ALL),
        ("comparison", ("lpips", "psnr"), (), [f"{task}/{m}" for task in TASKS for m in ("lpips", "psnr")]),
        ("comparison", ("psnr", "self_reenactment"), (), ["self_reenactment/psnr"]),
        (
            "comparison",
            ("self_reenactment",),
            (),
            [name for name in ALL if not name.startswith("novel_view")],
        ),
        ("comparison", ("storage",), ("storage=3",), ["storage"]),
        ("comparison", ("ssim", "novel_view"), ("1",), ["novel_view/ssim"]),
        ("speed", ("fps",), ("2",), ["fps"]),
    ],
)
def test_columns_and_digits_are_chosen(write_run, layout, columns, digits, shown):
    folder = write_run("a", {"ga": 31.0, "gbs": 30.0})
    text = table_text([folder], "json", layout, columns=columns, digits=digits)
    table = json.loads(text)
    found = [f"{c['task']}/{c['metric']}".lstrip("/") for c in table["columns"]]
    assert found == shown
    decimals = {digits[0].rpartition("=")[2]} if digits else None
    cells = [cell["text"] for _, rows in table["groups"] for row in rows for cell in row["cells"]]
    assert decimals is None or {str(len(text.partition(".")[2])) for text in cells} == decimals
    whole = json.loads(table_text([folder], "json", layout))
    assert columns or digits or table == whole


@pytest.mark.parametrize(
    ("layout", "columns", "digits", "message"),
    [
        ("comparison", ("psrn",), (), "--columns: expected one of .*, found 'psrn'.*Did you mean 'psnr'"),
        ("speed", ("psnr",), (), "--columns: expected one of fps, found 'psnr'"),
        ("comparison", ("storage", "novel_view"), (), "--columns: expected a metric of frames beside a task"),
        ("comparison", (), ("x",), "--digits: expected N or METRIC=N with N from 0 to 9, found x"),
        ("comparison", (), ("psrn=2",), "--digits: expected one of .*, found 'psrn'"),
    ],
)
def test_columns_and_digits_that_a_table_lacks_are_refused(write_run, layout, columns, digits, message):
    folder = write_run("a", {"ours": 31.0})
    with pytest.raises(InputError, match=message):
        table_text([folder], "md", layout, columns=columns, digits=digits)
