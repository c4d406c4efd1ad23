"""The blocks of code of the tutorials run, in the order of the pages, in one folder, with smaller settings.

In ``bash`` blocks every line is a command of headbench; ``# exit code N`` behind it says how it ends, 0 if nothing does.
``python`` blocks of a page share their names; one that begins with the name of a file is written to it.
"""

import importlib
import re
import shlex
import sys
from pathlib import Path

import pytest

from headbench.bench import cli

TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"
PAGES = re.search(r"(?s):maxdepth: 1\n\n(.*?)\n```", (TUTORIALS / "index.md").read_text("utf-8"))[1].split()
SMALLER = {
    "--cameras 6 --timesteps 24 --size 96x136": "--cameras 4 --timesteps 6 --size 48x64",
    "--preset demo": "--preset smoke",
    "--methods mean-image,ga --preset smoke": "--methods mean-image --preset smoke",
    "--methods ga --preset smoke --seeds 0,1": "--methods mean-image --preset smoke --seeds 0,1",
}
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page):
    """Language and text of the blocks of a page."""
    return BLOCK.findall((TUTORIALS / f"{page}.md").read_text("utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder that a reader works in, which later pages find as earlier ones left it."""
    return tmp_path_factory.mktemp("tutorials")


@pytest.fixture
def working(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    importlib.invalidate_caches()
    return folder


def call(line):
    """Run a command line in this process, and compare its exit code with the one that its comment names."""
    for large, small in SMALLER.items():
        line = line.replace(large, small)
    expected = re.search(r"# exit code (\d+)$", line)
    words = shlex.split(line, comments=True)
    if words[0] == "PYTHONPATH=.":  # the fixture has added it
        words = words[1:]
    assert words[0] == "headbench", line
    assert cli.main(words[1:]) == int(expected[1] if expected else 0), line


@pytest.mark.commands
@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_tutorial_runs(page, working):
    names = {"__name__": page}
    for language, text in blocks(page):
        named = re.match(r"# (\w+\.py)\n", text)
        if language == "bash":
            for line in text.replace("\\\n", " ").strip().splitlines():
                call(line)
        elif named:
            Path(named[1]).write_text(text, encoding="utf-8")
        else:
            exec(compile(text, f"{page}.md", "exec"), names)  # noqa: S102 - of our own pages
    sys.modules.pop("camera_mean", None)


def test_every_tutorial_has_code_and_is_listed():
    found = {path.stem for path in TUTORIALS.glob("*.md")} - {"index"}
    assert found == set(PAGES)
    assert all(blocks(page) for page in PAGES)


def test_the_smaller_settings_are_those_of_the_pages():
    text = "".join(text for page in PAGES for _, text in blocks(page))
    assert all(large in text for large in SMALLER)
