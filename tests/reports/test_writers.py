import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.reports.writers import escape_latex, to_csv, to_html, to_latex, to_markdown, to_text

from .latex import compile_latex, depth
from .made_rows import table_of

NASTY = "a_b%&{x}$#^~\\|*<i>`é"


@pytest.fixture
def table(make_rows, metrics):
    rows = make_rows({"good": 30.126, NASTY: 25.5, "floor": 10.0}, size={"good": 2.25, NASTY: 1.75})
    lpips = (rows["metric"] == "lpips") & (rows["method"] == NASTY)
    rows.loc[lpips, ["status", "value", "reason"]] = ["missing", np.nan, "No 100% weights_file."]
    return table_of(rows, metrics, ["good", NASTY, "floor"], trivial=["floor"])


def cells_of(line):
    return [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_text_is_a_block_for_each_task(table):
    *blocks, below = to_text(table).split("\n\n")
    assert [block.split(" (")[0].split("\n")[0] for block in blocks] == [
        "Novel view",
        "Self-reenactment",
        "Avatar",
    ]
    for block in blocks:
        _, _, rule, *lines = block.splitlines()
        start = len(rule.split(" ")[0])
        assert [line[:start].strip() for line in lines[:2]] == ["good", NASTY]
        assert lines[2:3] == ["Trivial baselines (not ranked)"]
    assert re.search(r"good +30.13 \* +30.126\n", blocks[0])
    assert re.search(r"25.50 +– \[1\]", blocks[0])
    assert "[1] No 100% weights_file." in below
    assert "hash-novel" not in below
    assert "hash-novel" in to_text(table, details=True)


def test_markdown_is_a_table_of_equal_lines(table):
    text = to_markdown(table)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {len(cells_of(line)) for line in lines} == {6}
    assert cells_of(lines[0]) == ["", "Novel view", "", "Self-reenactment", "", "Avatar"]
    assert cells_of(lines[2])[:3] == ["**Method**", "**PSNR** (dB) ↑", "**LPIPS** ↓"]
    good = next(cells_of(line) for line in lines if "good" in line)
    assert good[1:] == ["**30.13**", "30.126", "**30.13**", "30.126", "<ins>2.2</ins>"]
    nasty = next(cells_of(line) for line in lines if "25.50" in line)
    assert nasty[1:3] == ["<ins>25.50</ins>", "–<sup>1</sup>"]
    assert "<i>" not in text
    assert r"<sup>1</sup> No 100% weights_file." in text
    assert "hash-novel" in text


def test_csv_reads_back_with_full_precision(table):
    rows = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert [row["method"] for row in rows] == ["good", NASTY, "floor"]
    first, second, floor = rows
    assert float(first["novel_view/psnr"]) == pytest.approx(30.126, abs=1e-12)
    assert (first["novel_view/psnr/rank"], second["novel_view/psnr/rank"]) == ("1", "2")
    assert (second["novel_view/lpips"], second["novel_view/lpips/status"]) == ("", "missing")
    assert second["notes"] == "No 100% weights_file."
    assert (floor["group"], floor["novel_view/psnr/rank"]) == ("Trivial baselines (not ranked)", "")
    assert first["protocol"] == "novel_view=hash-novel_view self_reenactment=hash-self_reenactment"


def test_latex_is_a_booktabs_table_with_marks(table):
    text = to_latex(table)
    assert re.findall(r"\\begin\{(\S+?)\}", text) == ["table*", "tabular", "minipage"]
    for rule in (r"\toprule", r"\midrule", r"\bottomrule", r"\cmidrule(lr){2-3} \cmidrule(lr){4-5}"):
        assert rule in text
    assert r"PSNR\,(dB) $\uparrow$ & LPIPS $\downarrow$" in text
    assert r"\tabfirst{30.13}" in text
    assert r"\tabsecond{25.50}" in text
    assert r"--\textsuperscript{1}" in text
    assert r"\providecommand{\tabfirst}[1]{\textbf{#1}}" in text
    assert r"No 100\% weights\_file." in text


def test_latex_has_a_short_caption_and_the_protocol_in_comments(table):
    table = replace(table, name="paper-1", image_size="144 x 208", part="Region: face.")
    lines = to_latex(table).splitlines()
    (caption,) = (line for line in lines if line.startswith(r"\caption"))
    assert caption == (
        r"\caption{Novel view (5 frames) and Self-reenactment (5 frames), 2 subjects, "
        r"images of 144$\times$208 pixels. Region: face. Best in bold, second underlined, by the digits shown.}"
    )
    comments = "\n".join(line for line in lines if line.startswith("% "))
    assert "booktabs and graphicx" in comments
    for fact in table.facts:
        assert f"% {fact}\n" in comments
    assert "protocol (hash-novel_view)" in comments
    assert r"\label{tab:headbench-paper-1}" in lines


def test_latex_compiles_whatever_names_hold(table, tmp_path):
    names = [
        NASTY,
        "ours_2 50% #1 & \\input{x} ^ ~",
        "naïve Ærø ÿ",
        "*日本語 – “x” …",
        "[Ð--þ\nb \\end{tabular}",
    ]
    noted = table.notes[0] + " ".join(names)
    tables = [
        replace(
            table.mapped(lambda row, name=name: replace(row, method=name, cells=marked(row.cells))),
            name=f"table {number}",
            notes=(noted,),
            image_size="144 x 208",
        )
        for number, name in enumerate(names)
    ]
    texts = [to_latex(one) for one in tables]
    assert all(r"\tabfirst{30.13}\textsuperscript{1}" in text for text in texts)
    compile_latex(texts, tmp_path)


def marked(cells):
    """The cells, each with a note."""
    return tuple(replace(cell, note=0) for cell in cells)


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        *(("*ours", "{*}ours"), ("[ours]", "{[}ours{]}")),  # "\\\\*" and "\\\\[" are other commands
        *(("a-b--c---d", "a-b-{}-c-{}-{}-d"), ("why?`", "why?{`}")),  # ligatures
        ("þ ø", r"\texttt{U+00FE} ø"),  # the first is not in the default encoding of fonts
    ],
)
def test_latex_prints_the_characters_of_a_name(text, escaped):
    assert escape_latex(text) == escaped


@given(st.text(max_size=40))
def test_latex_text_has_no_live_character(text):
    escaped = escape_latex(text)
    assert depth(escaped) == 0
    bare = re.sub(r"\$\\[a-z]+\$|\\[a-zA-Z]+|\\[{}$&#%_]", "", escaped)
    assert not set(bare) & set("\\$&#%_^~\n")
    assert all(ord(c) < 256 for c in escaped)


def test_a_spread_stands_beside_its_mean_in_every_format(make_rows, metrics):
    rows = make_rows({"a": lambda metric, seed, *frame: 20.0 + seed, "b": 18.0}, seeds=(0, 1))
    table = table_of(rows, metrics, "ab")
    assert "**20.50 ± 0.707**" in to_markdown(table)
    assert r"\tabfirst{20.50}\tabspread{0.707}" in to_latex(table)
    first = next(csv.DictReader(io.StringIO(to_csv(table))))
    assert (first["novel_view/psnr"], first["novel_view/psnr/spread"]) == ("20.5", "0.707")


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
    return to_html(table_of(rows, metrics, names, trivial=["floor"]))


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
    assert by_method["Method"][0][1] == "PSNR ↑dB"


def test_nothing_from_outside_is_live_and_nothing_is_fetched(page):
    assert page.count("<script") == 1  # which sorts the table
    assert "src=" not in page
    assert "&lt;script&gt;&amp;" in page
    assert "No &lt;weights&gt;." in page
    assert all(link.startswith("#note-") for link in Cells(page).links)
    assert 'title="30.126' in page


@pytest.mark.commands
def test_the_page_is_sorted_by_a_column_in_a_browser(page, new_tab, serious):
    tab = new_tab(390, 700)
    tab.set_content(page)
    assert serious(tab) == []
    names = tab.locator("tbody").first.locator("tr:not(.group) th")
    best_first = ["good", "<script>&", "third"]
    assert names.all_inner_texts() == best_first
    for column, order in (("Method", sorted(best_first)), ("PSNR", best_first)):
        button = tab.locator("thead button", has_text=column).first
        for expected in (order, order[::-1]):
            button.click()
            assert names.all_inner_texts() == expected
