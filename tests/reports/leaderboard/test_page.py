"""A leaderboard shows the numbers of the bundles in a folder, a table for each set of frames."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from headbench.bench import cli
from headbench.bench.engine.store import RunFolder


class Text(HTMLParser):
    """The texts of a page, and its links."""

    def __init__(self, page):
        super().__init__()
        self.texts, self.links = [], []
        self.feed(page)

    def handle_data(self, data):
        self.texts.append(data.strip())

    def handle_starttag(self, tag, attributes):
        self.links += [value for name, value in attributes if name == "href"]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "bundles").mkdir()
    return tmp_path / "bundles"


@pytest.fixture
def submit(folder):
    def submit(run, name, *options, by="A. Person"):
        words = ["bundle", str(run), "--out", str(folder / f"{name}.zip"), "--by", by, *options]
        assert cli.main(words) == 0

    return submit


@pytest.fixture
def build(folder, tmp_path):
    def build():
        assert cli.main(["report", "leaderboard", str(folder), "--out", str(tmp_path / "out")]) == 0
        return [(tmp_path / "out" / f"leaderboard.{suffix}").read_text() for suffix in ("md", "html")]

    return build


def test_runs_on_the_same_frames_share_a_table(write_run, submit, build):
    submit(write_run("one", {"ga": 30.0, "mean-image": 10.0}), "first")
    submit(write_run("two", {"ours": 31.25}), "second", "--link", "https://example.org/ours", by="B <b>")
    markdown, page = build()
    assert len(re.findall("^## ", markdown, flags=re.MULTILINE)) == 1
    html = Text(page)
    for text in ("31.2500", "30.0000"):
        assert text in markdown
        assert text in html.texts
    assert "[B \\<b\\>](https://example.org/ours)" in markdown
    assert html.links == ["https://example.org/ours"]
    assert "<b>" not in page


def test_other_frames_make_another_table(write_run, submit, build):
    submit(write_run("one", {"ga": 30.0}), "first")
    other = write_run("two", {"ga": 31.0})
    measured_by(other, "other")
    submit(other, "second")
    markdown, page = build()
    assert len(re.findall("^## ", markdown, flags=re.MULTILINE)) == 2
    assert page.count("<h2>") == 2


def measured_by(run, protocol):
    """Give a run and its rows other protocols."""
    import pandas as pd

    rows = pd.read_parquet(run / "rows.parquet")
    rows["protocol"] = rows["task"].where(rows["task"] == "", f"{protocol}-" + rows["task"])
    rows.to_parquet(run / "rows.parquet", index=False)
    manifest = RunFolder(run).read_manifest()
    others = {task: replace(each, hash=f"{protocol}-{task}") for task, each in manifest.protocols.items()}
    replace(manifest, protocols=others).write(RunFolder(run).manifest)


def test_notes_of_two_tables_have_names_of_their_own(write_run, submit, build):
    for name, protocol in (("one", "first"), ("two", "other")):
        run = write_run(name, {"ga": 30.0, "ours": 31.0})
        import pandas as pd

        rows = pd.read_parquet(run / "rows.parquet")
        rows.loc[rows["method"] == "ours", ["status", "reason"]] = ["missing", "not measured here"]
        rows.to_parquet(run / "rows.parquet", index=False)
        measured_by(run, protocol)
        submit(run, name)
    _, page = build()
    names = re.findall(r'id="([^"]+)"', page)
    assert len(names) == len(set(names)) == 2
    assert set(re.findall(r'href="#([^"]+)"', page)) == set(names)


@pytest.mark.parametrize(
    ("content", "words"),
    [({}, "bundles (*.zip) of `headbench bundle`"), ({"a.zip": b"text"}, "File is not a zip file")],
)
def test_a_folder_without_sound_bundles_is_refused(folder, tmp_path, content, words, capsys):
    for name, data in content.items():
        (folder / name).write_bytes(data)
    assert cli.main(["report", "leaderboard", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*"))
