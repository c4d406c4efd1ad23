import html
import re
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from matplotlib.figure import Figure

from headbench.bench.io.figures import drawable, pixels
from headbench.bench.io.style import escape_markdown


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("naïve Ωλ → – ±", "naïve Ωλ → – ±"),
        ("张三 a", "U+5F20 U+4E09 a"),
        (
            "\N{GRINNING FACE WITH SMILING EYES}\nb",
            "\N{GRINNING FACE WITH SMILING EYES}\nb",
        ),  # DejaVu Sans has some
        ("\N{PARROT}\nb", "U+1F99C\nb"),
    ],
)
def test_characters_that_the_font_lacks_are_code_points(text, drawn):
    assert drawable(text) == drawn

    def picture(name):
        figure = Figure(figsize=(3, 2), layout="constrained")
        axes = figure.subplots()
        axes.set_title(name, fontweight="bold")
        axes.set_yticks([0], [name])
        axes.plot([0], [0], label=name)
        axes.legend()
        return pixels(figure)

    with warnings.catch_warnings(action="error"):
        np.testing.assert_array_equal(picture(text), picture(drawn))


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
