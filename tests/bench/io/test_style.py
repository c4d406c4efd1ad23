import html
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from headbench.bench.io.style import escape_markdown

NAMES = [
    "a|b||",
    "`x`",
    "_a_ b_c",
    "*x* **",
    "~~x~~",
    "<b>x</b>",
    "a&lt;b &#35;",
    "[x](y) ![x](y)",
    "x\\",
    "\\|",
    "#1 {x}",
]


@pytest.mark.parametrize("text", NAMES)
def test_markdown_shows_the_text_in_its_cell(text):
    markdown = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    page = markdown.render(f"| a | b |\n| -- | -- |\n| {escape_markdown(text)} | 1 |\n")
    cells = re.findall("<td>(.*?)</td>", page)
    assert [html.unescape(cell) for cell in cells] == [text, "1"]


@given(st.text(max_size=40))
def test_markdown_text_stays_on_its_line_and_in_its_cell(text):
    escaped = escape_markdown(text)
    assert "\n" not in escaped
    assert len(re.split(r"(?<!\\)\|", f"| {escaped} | x |")) == 4
    assert re.sub(r"\\(.)", r"\1", escaped) == " ".join(text.split())
