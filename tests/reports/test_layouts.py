import json
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.reports.runs import RunSet
from headbench.reports.table_report import Columns, table_of, table_text

from .latex import compile_latex
from .made_rows import TASKS

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
