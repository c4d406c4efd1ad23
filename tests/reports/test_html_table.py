from html.parser import HTMLParser

import numpy as np
import pytest

from headbench.bench.rows import Rows
from headbench.reports.tables import build_table
from headbench.reports.writers import to_html

VOID = {"meta", "br"}


class Cells(HTMLParser):
    """Reads a page: rows of (classes, text), whether tags close in order, what it asks of other places."""

    def __init__(self, text):
        super().__init__()
        self.open, self.rows, self.links, self.spans = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
            self.spans.append(0)
        given = dict(attributes)
        if tag in ("td", "th"):
            self.rows[-1].append([given.get("class", ""), ""])
            self.spans[-1] += int(given.get("colspan", 1))
        self.links += [given[name] for name in ("href", "src") if name in given]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.rows and {"td", "th"} & set(self.open):
            self.rows[-1][-1][1] += data


@pytest.fixture
def page(make_rows, metrics):
    names = {"good": 30.126, "<script>&": 25.5, "third": 20.0, "floor": 10.0}
    rows = make_rows(names)
    lpips = (rows["metric"] == "lpips") & (rows["method"] == "third")
    rows.loc[lpips, ["status", "value", "reason"]] = ["missing", np.nan, "No <weights>."]
    return to_html(build_table(Rows(rows), metrics, list(names), trivial=["floor"]))


def test_cells_say_what_they_are(page):
    cells = Cells(page)
    assert cells.open == []
    assert set(cells.spans) == {6}
    by_method = {row[0][1]: row[1:] for row in cells.rows if len(row) == 6}
    assert by_method["good"][0] == ["first", "30.13"]
    assert by_method["<script>&"][0] == ["second", "25.50"]
    assert by_method["third"][0] == ["third", "20.00"]
    assert by_method["third"][1] == ["", "–1"]
    assert by_method["floor"][0] == ["", "10.00"]
    assert by_method["Method"][0][1] == "PSNR (dB) ↑"


def test_nothing_from_outside_is_live_and_nothing_is_fetched(page):
    assert "<script" not in page
    assert "&lt;script&gt;&amp;" in page
    assert "No &lt;weights&gt;." in page
    assert all(link.startswith("#note-") for link in Cells(page).links)
    assert 'title="30.126' in page
