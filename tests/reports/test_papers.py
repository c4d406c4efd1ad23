"""Printed tables as data, and runs in their form."""

import json
from dataclasses import replace

import pytest
import yaml

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.configuration import build_file
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.registry import discover
from headbench.reports import papers as method_cards
from headbench.reports import papers as module
from headbench.reports.papers import (
    FOLDER,
    Paper,
    as_printed,
    citations,
    counts,
    measured_figures,
    measured_text,
    papers,
    printed_figures,
    printed_tables,
)
from headbench.reports.runs import RunSet
from headbench.reports.table_report import table_text

from .test_table_report import GEOMETRY, OPACITY


def figures(name):
    return printed_figures(discover("methods")[name].spec)


def test_claims_of_a_paper_come_before_what_others_ran():
    found = figures("ours")
    own = [figure.own for figure in found]
    assert own == sorted(own, reverse=True)
    claimed, others = (
        {f.values.get("novel_view/psnr") for f in found if f.own == kind} for kind in (True, False)
    )
    assert "32.97" in claimed
    assert {"31.28", "26.33"} <= others


def test_measured_figures_say_on_what_they_were_measured(tmp_path, monkeypatch):
    file = tmp_path / "measured.json"
    monkeypatch.setattr(method_cards, "MEASURED", file)
    assert measured_figures("ours") is None
    stored = {"suite": "suite", "data": "two subjects", "methods": {"ours": {"novel_view/psnr": "30.10"}}}
    file.write_text(json.dumps(stored))
    assert measured_figures("ga") is None
    assert (
        measured_text(measured_figures("ours")) == "novel view 30.10 dB (by headbench, suite: two subjects)"
    )


def test_every_method_with_a_source_has_a_citation():
    cards = {card["name"]: card for card in citations()}
    for name, plugin in discover("methods").items():
        spec = plugin.spec
        if spec is not None and spec.source:
            assert spec.source in cards[name]["summary"]
            assert spec.bibtex.strip().splitlines()[:1] == cards[name]["bibtex"].splitlines()[:1]


PAPER = "tensorial-2025"


def shown(runs, number):
    (printed,) = printed_tables(PAPER, number)
    return as_printed(RunSet.read(runs), PAPER, printed)


def test_measured_methods_stand_above_the_printed_rows(write_run):
    values = {"ours": 33.0, "mine": 32.0, "insta": 28.0, "mean-image": 17.0}
    folder = write_run("a", values, {"ours": OPACITY})
    table = shown([folder], "3")
    (_, measured), (title, printed) = table.groups
    assert [row.method for row in measured] == ["Ours", "mine", "INSTA"]
    assert title == (
        "Printed in Table 3 of the paper (not comparable): "
        "nine NeRSemble subjects (074 104 165 175 210 218 264 302 304)"
    )
    assert [(row.method, row.trivial) for row in printed] == [("INSTA", True), ("Ours", True)]
    keys = [f"{column.task}/{column.metric}".lstrip("/") for column in table.columns]
    assert dict(zip(keys, (cell.text for cell in printed[1].cells))) == {
        "novel_view/psnr": "32.97",
        "novel_view/ssim": "0.95",
        "novel_view/lpips": "0.059",
        "self_reenactment/psnr": "28.07",
        "self_reenactment/ssim": "0.93",
        "self_reenactment/lpips": "0.077",
        "storage": "10",
        "fps": "300",
    }
    assert {(cell.status, cell.rank) for row in printed for cell in row.cells} == {("published", None)}
    assert measured[0].cells[0].text == "33.00"  # the decimals of the printed values
    assert measured[0].cells[0].rank == 1
    assert "arXiv 2504.14967" in table.caption
    assert "grade A" in table.caption


def test_settings_decide_the_printed_row_of_a_method(write_run):
    opacity = write_run("opacity", {"ours": 35.0}, {"ours": OPACITY})
    geometry = write_run("geometry", {"ours": 36.0, "ga": 30.0}, {"ours": GEOMETRY})
    (_, measured), _ = shown([opacity, geometry], "4").groups
    names = [row.method for row in measured]
    assert names == [
        "Ours, opacity (dynamic=opacity)",
        "Ours, position rotation scale (dynamic=position+rotation+scale)",
        "ga",
    ]
    other = write_run("b", {"ours": 33.0}, {"ours": {"lines": {"dynamic": ["color"]}}})
    assert shown([other], "4").groups[0][1][0].method == "ours"


def test_a_condition_is_a_printed_row_by_its_settings_alone(write_run):
    tracked = Named("tracked")
    conditions = {
        "moved": (GEOMETRY, Condition("moved", ("ours",), GEOMETRY)),
        "moved-tracked": (GEOMETRY, Condition("moved-tracked", settings=GEOMETRY, clip=tracked)),
        "tracked": (OPACITY, Condition("tracked", clip=tracked)),
        "off": ({"lines": {"dynamic": []}}, Condition("off", settings={"lines": {"dynamic": []}})),
    }
    settings = {"ours": OPACITY} | {f"ours+{name}": config for name, (config, _) in conditions.items()}
    folder = RunFolder(write_run("a", {name: 30.0 + i for i, name in enumerate(settings)}, settings))
    manifest = folder.read_manifest()
    known = (PLAIN, *(condition for _, condition in conditions.values()))
    replace(manifest, configuration=replace(manifest.configuration, conditions=known)).write(folder.manifest)
    measured = {number: shown([folder.root], number).groups[0][1] for number in ("3", "4")}
    assert [row.method for row in measured["3"]] == ["Ours"]
    names = ["Ours, opacity", "Ours, position rotation scale (moved)"]
    assert [(row.method, row.cells[0].text) for row in measured["4"]] == list(zip(names, ["30.00", "31.00"]))


def test_printed_metrics_that_a_run_lacks_are_missing(write_run, tmp_path, monkeypatch):
    paper = yaml.safe_load((FOLDER / f"{PAPER}.yaml").read_text())
    paper["tables"][0]["rows"][0]["values"] = {"novel_view/csim": "0.91", "cross_reenactment/csim": "0.6"}
    paper["claims"] = []  # about the replaced values
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(paper))
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    (printed,) = printed_tables("other", "3")
    table = as_printed(RunSet.read([write_run("a", {"ga": 30.0})]), "other", printed)
    csim = [column.metric for column in table.columns].index("csim")
    cell = table.rows[0].cells[csim]
    assert (cell.status, cell.text) == ("missing", "–")
    assert table.notes[cell.note]
    assert "Cross-reenactment is printed, but not measured here." in table.caption


def test_printed_training_times_are_in_the_unit_of_their_column(write_run):
    """Table 3 of the paper: 10 minutes of INSTA, 3.5 hours of PointAvatar."""
    (printed,) = printed_tables("gpavatar-2025", "3")
    table = as_printed(RunSet.read([write_run("a", {"ga": 30.0})]), "gpavatar-2025", printed)
    column = [column.metric for column in table.columns].index("training_time")
    assert table.columns[column].unit == "min"
    shown = {row.method: row.cells[column].text for row in table.groups[-1][1]}
    assert (shown["INSTA"], shown["PointAvatar"]) == ("10.0", "210.0")


@pytest.mark.parametrize("format", ["text", "md", "latex", "html", "csv", "json"])
def test_every_format_has_measured_and_printed_values(write_run, format):
    folder = write_run("a", {"ours": 33.25})
    text = table_text([folder], format, paper=PAPER, number="3")
    assert "33.25" in text
    assert "32.97" in text
    assert "32.97" not in table_text([folder], format)


def test_all_tables_of_a_paper_follow_each_other(write_run):
    folder = write_run("a", {"ours": 33.0})
    text = table_text([folder], "md", paper=PAPER)
    for table in printed_tables(PAPER, None):
        assert f"Printed in {table.table} of" in text
    with pytest.raises(InputError, match="--table: expected one of Table .*, for a file of format json"):
        table_text([folder], "json", paper=PAPER)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"paper": "tensorial"}, "--as: expected one of .*Did you mean 'tensorial-2025'"),
        ({"paper": PAPER, "number": "77"}, "--table: expected a table of tensorial-2025: .*, found 77"),
        ({"number": "3"}, "--table: expected --as PAPER beside it"),
        ({"paper": PAPER, "layout": "cost"}, "--as: expected no --layout"),
        ({"paper": PAPER, "digits": ("2",)}, "--as: expected no --layout, --columns or --digits"),
    ],
)
def test_options_that_do_not_fit_are_refused(write_run, options, message):
    with pytest.raises(InputError, match=message):
        table_text([write_run("a", {"ours": 33.0})], "md", **options)


def test_every_paper_has_the_schema_and_known_methods():
    assert papers()
    methods = {name for name, plugin in discover("methods").items() if plugin.spec}
    for name, paper in papers().items():
        assert name == name.lower()
        for table in paper.tables:
            used = {row.method for row in table.rows} - {""}
            assert used <= methods | {"rgbavatar", "flashavatar"}, (name, table.table)
            assert all(text for text in (table.data, table.conditions, table.read))
    assert counts()["A"]["values"] > 0


CHANGES = [
    (lambda p: p.update(arxiv="25.1"), "arxiv: a number such as 2504.14967"),
    (lambda p: p["tables"][0].update(rows=[]), "rows: at least one, each name once; found none"),
    (lambda p: p["tables"][0]["rows"][0].update(values={}), "values: at least one; found none"),
    (lambda p: p["tables"][0]["rows"][0]["values"].update(psnr="3"), "values: TASK/METRIC of .*; found psnr"),
    (
        lambda p: p["tables"][0]["rows"][0]["values"].update(fps=25),
        "values.fps: expected text, found 25",
    ),
    (lambda p: p["tables"][0]["rows"][0]["values"].update({"drive/psnr": "3"}), "found drive/psnr"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=[m[:24] for _, m in CHANGES])
def test_a_file_with_a_wrong_key_or_value_is_refused(tmp_path, change, message):
    paper = yaml.safe_load((FOLDER / f"{PAPER}.yaml").read_text())
    change(paper)
    (tmp_path / "paper.yaml").write_text(yaml.safe_dump(paper))
    with pytest.raises(InputError, match=message):
        build_file(Paper, tmp_path / "paper.yaml")
