import json
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.bench.rows import Rows
from headbench.reports.runs import RunSet
from headbench.reports.table_report import Columns, published_rows, table_of, table_text

from .latex import check_latex, compile_latex
from .made_rows import TASKS

METRICS = ("psnr", "ssim", "lpips", "storage", "fps")
ALL = [f"{task}/{name}" for task in TASKS for name in METRICS[:3]] + [*METRICS[3:]]
OPACITY, GEOMETRY = (
    {"lines": {"dynamic": [*names]}} for names in (["opacity"], ["position", "rotation", "scale"])
)


def labels(table):
    return [row.method for row in table.rows]


def test_paper_1_shows_every_method_and_ours_last(write_run):
    folder = write_run("a", {"ours": 33.0, "mine": 32.0, "ga": 31.0, "insta": 28.0, "mean-image": 17.0})
    table = table_of(RunSet.read([folder]), "paper-1")
    assert labels(table) == ["INSTA", "GaussianAvatars", "mine", "Ours"]
    quality = [("psnr", 2), ("ssim", 3), ("lpips", 3)]
    assert [(c.title, c.metric, c.digits) for c in table.columns] == [
        *((title, *of) for title in ("Novel view", "Self-reenactment") for of in quality),
        ("Avatar", "storage", 1),
        ("Avatar", "fps", 0),
    ]
    assert table.rows[-1].cells[0].text == "33.00"


def test_paper_3_compares_insta_and_ours(write_run):
    folder = write_run("a", {"ours": 33.0, "ga": 31.0, "insta": 28.0}, {"ours": OPACITY})
    table = table_of(RunSet.read([folder]), "paper-3", published=True)
    assert labels(table) == ["INSTA", "Ours"]
    assert [c.published for c in table.columns] == [False, True] * 8
    insta, ours = (row.cells[1::2] for row in table.rows)
    assert [c.text for c in insta] == ["27.97", "0.92", "0.11", "27.50", "0.92", "0.103", "53", "25"]
    assert [c.text for c in ours] == ["32.97", "0.95", "0.059", "28.07", "0.93", "0.077", "10", "300"]
    for cell in (*insta, *ours):
        assert (cell.status, cell.rank) == ("published", None)
        assert "Table 3 (nine NeRSemble subjects)" in table.notes[cell.note]
        assert "arXiv 2504.14967" in table.notes[cell.note]
    assert "not comparable" in table.caption
    plain = table_of(RunSet.read([folder]), "paper-3")
    assert [row.cells for row in plain.rows] == [row.cells[::2] for row in table.rows]


GALLERY = Path(__file__).parents[2] / "reports" / "gallery"


@pytest.mark.parametrize("layout", ["paper-1", "comparison"])
def test_tables_of_papers_alone_have_the_mean_over_cameras(layout):
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    rows = rows[(rows.method == "ga") & (rows.metric == "psnr") & (rows.region == "full")]
    held_out = rows[rows.task == "novel_view"].camera.iloc[0]
    own = rows[rows.task == "self_reenactment"]
    where = own.camera.where(own.camera == held_out, "seen").map(
        {"seen": SEEN_CAMERAS, held_out: UNSEEN_CAMERAS}
    )
    groups = where.mask(where.notna(), "self_reenactment") if layout == "paper-1" else where
    expected = own.groupby([groups, "sequence"]).value.mean().groupby(level=0).mean().to_dict()
    table = table_of(RunSet.read([GALLERY]), layout, columns=Columns(("psnr", "self_reenactment")))
    (row,) = [row for row in table.rows if row.method in ("ga", "GaussianAvatars")]
    found = {column.task: cell.value for column, cell in zip(table.columns, row.cells, strict=True)}
    assert found == pytest.approx(expected)


def test_paper_4_puts_settings_of_ours_from_runs_side_by_side(write_run):
    opacity = write_run("opacity", {"ours": 35.0}, {"ours": OPACITY})
    geometry = write_run("geometry", {"ours": 36.0, "ga": 30.0}, {"ours": GEOMETRY})
    table = table_of(RunSet.read([opacity, geometry]), "paper-4", published=True)
    assert labels(table) == ["Ours (dynamic=opacity)", "Ours (dynamic=position+rotation+scale)"]
    assert {c.metric for c in table.columns} == {"psnr", "ssim", "lpips"}
    first, second = (row.cells[1::2] for row in table.rows)
    assert [c.text for c in first] == ["35.16", "0.97", "0.026", "31.64", "0.96", "0.036"]
    assert [c.text for c in second] == ["36.39", "0.97", "0.018", "30.97", "0.96", "0.030"]


def test_other_settings_are_not_given_the_papers_figures(write_run):
    folder = write_run("a", {"ours": 33.0, "insta": 28.0}, {"ours": {"lines": {"dynamic": ["color"]}}})
    table = table_of(RunSet.read([folder]), "paper-3", published=True)
    assert {c.status for c in table.rows[1].cells[1::2]} == {"none"}
    assert {c.text for c in table.rows[1].cells[1::2]} == {""}


@pytest.mark.parametrize("format", ["md", "latex", "html"])
def test_a_published_figure_stands_under_that_word(write_run, format):
    folder = write_run("a", {"ours": 33.0, "insta": 28.0}, {"ours": OPACITY})
    text = table_text([folder], format, "paper-3", published=True)
    assert "32.97" in text
    assert text.lower().count("published") >= 8
    assert "32.97" not in table_text([folder], format, "paper-3")


def test_every_layout_compiles_in_latex(write_run, tmp_path):
    methods = {"ours": 33.0, "my_own-2": 32.0, "ga": 31.0, "insta": 28.0, "mean-image": 17.0}
    folder = write_run("a", methods, {"ours": OPACITY})
    other = write_run("b", {"ours": 33.0}, {"ours": GEOMETRY})
    published = ("paper-1", "paper-3", "paper-4")
    texts = [
        *(table_text([folder], "latex", layout) for layout in ("comparison", "speed", "cost")),
        *(table_text([folder, other], "latex", layout, layout != "paper-1") for layout in published),
    ]
    for text in texts:
        check_latex(text)
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
        ("paper-1", ("ssim", "novel_view"), ("1",), ["novel_view/ssim"]),
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
        ("speed", ("novel_view",), (), "--columns: expected one of fps, found 'novel_view'"),
        ("paper-4", ("fps",), (), "--columns: expected one of .*, found 'fps'"),
        ("comparison", ("storage", "novel_view"), (), "--columns: expected a metric of frames beside a task"),
        ("comparison", (), ("x",), "--digits: expected N or METRIC=N with N from 0 to 9, found x"),
        ("comparison", (), ("=3",), "--digits: expected N or METRIC=N with N from 0 to 9, found =3"),
        ("comparison", (), ("-1",), "--digits: expected N or METRIC=N with N from 0 to 9, found -1"),
        ("comparison", (), ("psrn=2",), "--digits: expected one of .*, found 'psrn'"),
    ],
)
def test_columns_and_digits_that_a_table_lacks_are_refused(write_run, layout, columns, digits, message):
    folder = write_run("a", {"ours": 31.0})
    with pytest.raises(InputError, match=message):
        table_text([folder], "md", layout, columns=columns, digits=digits)


def test_a_layout_needs_the_metrics_that_are_shown_alone(write_run, change_manifest):
    folder = write_run("a", {"ours": 31.0})
    file = RunFolder(folder).rows
    rows = pd.read_parquet(file)
    Rows(rows[rows["metric"] != "lpips"]).write(file)
    change_manifest(folder, lambda m: m.update(metrics=[s for s in m["metrics"] if s["name"] != "lpips"]))
    with pytest.raises(InputError, match="metrics of layout paper-1"):
        table_text([folder], "md", "paper-1")
    assert "31.00" in table_text([folder], "md", "paper-1", columns=("psnr",))


def test_layouts_that_a_run_cannot_fill_are_refused(write_run, make_run):
    with pytest.raises(InputError, match="metrics of layout paper-1"):
        table_text([make_run("toy")], "md", "paper-1")
    folder = write_run("a", {"ga": 31.0, "gbs": 30.0})
    with pytest.raises(InputError, match="insta, ours"):
        table_text([folder], "md", "paper-3")
    with pytest.raises(InputError, match="figures that papers printed"):
        table_text([folder], "md", "paper-1", published=True)
    with pytest.raises(InputError, match="paper-4"):
        table_text([folder], "md", "paper-5")


def test_every_published_row_has_its_source_and_numbers():
    rows = published_rows()
    assert len(rows) == 4
    for row, source in rows:
        assert "arXiv" in source
        assert row.table.startswith("Table ")
        assert all(float(value) > 0 for value in row.values.values())
        assert {name.rpartition("/")[2] for name in row.values} <= set(METRICS)
