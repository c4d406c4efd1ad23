"""What commands print: fitted to a terminal, plain in a pipe, with the values of the rows."""

import re
import sys
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench import cli, terminal

GALLERY = Path(__file__).parents[2] / "reports" / "gallery"
STYLES = re.compile(r"\x1b\[[\d;]*m")
NUMBERS = re.compile(r"[-+]?\d+\.\d+")


@pytest.fixture
def printed(capsys, monkeypatch):
    """What a command line prints on a terminal of a width, or in a pipe."""

    def printed(words, width=None, **environment):
        monkeypatch.setattr(sys.stdout, "isatty", lambda: width is not None)
        for name, value in {"TERM": "xterm", "COLUMNS": str(width or 40), **environment}.items():
            monkeypatch.setenv(name, value)
        capsys.readouterr()
        cli.main(words.split())
        return capsys.readouterr().out

    return printed


def test_a_closed_standard_output_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)  # as Python does for `headbench list presets >&-`
    assert cli.main(["list", "presets"]) == 0
    sys.stdout.close()


@pytest.mark.parametrize(
    "words",
    [
        "",
        "--help",
        *(f"list {what}" for what in ("methods", "presets", "metrics", "papers", "protocols", "commands")),
        "lint --list",
        "doctor",
        *(f"{command} {GALLERY}" for command in ("table", "status")),
        f"compare {GALLERY} --metrics psnr --against ga",
        f"protocols {GALLERY} --methods ga,ours",
    ],
)
def test_text_fits_a_terminal_and_is_plain_in_a_pipe(printed, words):
    narrow, piped = printed(words, 60), printed(words)
    assert max(len(STYLES.sub("", line)) for line in narrow.splitlines()) <= 60
    assert not re.search(r"\x1b|<ins>|<sup>|\| :?-", piped)
    assert {*NUMBERS.findall(STYLES.sub("", narrow))} == {*NUMBERS.findall(piped)}


def test_tables_show_the_means_of_the_rows(printed):
    rows = pd.read_parquet(GALLERY / "rows.parquet").query("region == 'full' and condition == ''")
    own = rows[(rows["task"] == "novel_view") & (rows["method"] == "ga") & (rows["metric"] == "psnr")]
    block = next(part for part in printed(f"table {GALLERY}").split("\n\n") if part.startswith("Novel view"))
    value = f"{own.groupby('sequence')['value'].mean().mean():.2f}"
    assert next(line.split()[1] for line in block.splitlines() if line.startswith("ga ")) == value


@pytest.mark.parametrize("environment", [{}, {"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_styles_can_be_turned_off(monkeypatch, environment):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for name, value in {"TERM": "xterm", "COLUMNS": "80", **environment}.items():
        monkeypatch.setenv(name, value)
    text = terminal.table(["name", "dB"], [["ga", "30.1 *"], ["ours", "29.0"]])
    assert ("\x1b[1m30.1 *\x1b[0m" in text) != bool(environment)
    assert "30.1 *" in text


cells = st.text(st.sampled_from("ab é0.,-"), max_size=50).map(lambda text: f"x{text}")


@settings(max_examples=25)
@given(st.integers(40, 120), st.lists(st.tuples(cells, cells, cells, cells), min_size=1, max_size=3))
def test_no_table_is_wider_than_its_terminal(width, rows):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(terminal, "width_of", lambda stream: width)
        text = STYLES.sub("", terminal.table(["a", "b", "c", "d"], [["A group"], *rows], title="Title"))
    assert text.count("A group") == text.count("Title")
    assert max(map(len, text.splitlines())) <= width
    for row in rows:
        assert all(word in re.sub(r"\s", "", text) for cell in row for word in cell.split() if len(word) < 4)
