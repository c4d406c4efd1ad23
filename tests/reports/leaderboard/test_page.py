"""A leaderboard shows the numbers of the bundles in a folder, a table for each set of frames."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit.definitions import known_metrics
from headbench.bench.contracts import FrameKey
from headbench.bench.engine.store import RunFolder
from headbench.bench.manifest import ProtocolRecord
from headbench.bench.protocol import Protocol
from headbench.bench.rows import FRAME
from headbench.reports.leaderboard.submissions import qualified


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


def sound(run, resolution="48x64"):
    """Give a run that was written by hand registered metrics, and protocols of its frames."""
    manifest, rows = RunFolder(run).read_manifest(), pd.read_parquet(run / "rows.parquet")
    frames = rows[rows["task"] != ""]
    keys = tuple(FrameKey(*key) for key in sorted(set(frames[FRAME].itertuples(index=False, name=None))))
    clips = tuple((subject, "f") for subject in sorted({key.subject for key in keys}))
    made = {task: Protocol(task, keys, (), clips, resolution) for task in manifest.protocols}
    rows["protocol"] = [made[task].hash if task else "" for task in rows["task"]]
    rows.to_parquet(run / "rows.parquet", index=False)
    records = {task: ProtocolRecord.of(protocol) for task, protocol in made.items()}
    metrics = tuple(known_metrics()[metric.name] for metric in manifest.metrics)
    replace(manifest, protocols=records, metrics=metrics).write(RunFolder(run).manifest)
    return run


def test_runs_on_the_same_frames_share_a_table(write_run, submit, build):
    submit(sound(write_run("one", {"mine": 30.0, "slow": 10.0})), "first")
    submit(sound(write_run("two", {"mine": 31.25})), "second", "--link", "https://example.org/m", by="B <b>")
    markdown, page = build()
    assert len(re.findall("^## ", markdown, flags=re.MULTILINE)) == 1
    html = Text(page)
    for text in ("31.25", "30.00", "mine [A. Person/first]", "mine [B <b>/second]"):
        assert text in markdown.replace("\\", "")
        assert text in html.texts
    assert "[B \\<b\\>](https://example.org/m)" in markdown
    assert [link for link in html.links if not link.startswith("#")] == ["https://example.org/m"]
    assert "<b>" not in page


def test_axe_finds_nothing_serious(write_run, submit, build, new_tab, serious):
    submit(sound(write_run("one", {"mine": 30.0, "slow": 10.0})), "first")
    _, page = build()
    tab = new_tab(390, 700)
    tab.set_content(page)
    assert serious(tab) == []
    assert tab.locator("th[aria-sort] button").count() == 1


def test_other_frames_make_another_table(write_run, submit, build):
    submit(sound(write_run("one", {"mine": 30.0})), "first")
    submit(sound(write_run("two", {"mine": 31.0}), "96x128"), "second")
    markdown, page = build()
    assert len(re.findall("^## ", markdown, flags=re.MULTILINE)) == 2
    assert page.count("<h2 ") == 2


def test_notes_of_two_tables_have_names_of_their_own(write_run, submit, build):
    for name, size in (("one", "48x64"), ("two", "96x128")):
        run = write_run(name, {"mine": 30.0, "theirs": 31.0})
        rows = pd.read_parquet(run / "rows.parquet")
        rows.loc[rows["method"] == "theirs", ["status", "reason"]] = ["missing", "not measured here"]
        rows.to_parquet(run / "rows.parquet", index=False)
        submit(sound(run, size), name)
    _, page = build()
    names = re.findall(r'id="([^"]+)"', page)
    assert len(names) == len(set(names))
    notes = {name for name in names if "note" in name}
    assert len(notes) == 2
    assert set(re.findall(r'href="#([^"]+note[^"]+)"', page)) == notes


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("a", "b"), ["m [A/a]", "m [A/b]"]),
        (("a", "A"), ["m [A/a] 00000000", "m [A/A] 11111111"]),
        (("a", "\uff41"), ["m [A/a] 00000000", "m [A/\uff41] 11111111"]),  # a wide letter a
    ],
)
def test_names_that_look_alike_have_a_digest(names, expected):
    made = [
        SimpleNamespace(
            bundle=SimpleNamespace(by="A"),
            file=Path(f"{name}.zip"),
            run=SimpleNamespace(methods=("m",)),
            digest=str(i) * 64,
        )
        for i, name in enumerate(names)
    ]
    assert [own["m"] for own in qualified(made)] == expected


def test_an_unsound_bundle_is_listed_in_no_table(write_run, submit, build, folder):
    submit(sound(write_run("one", {"mine": 30.0})), "first")
    (folder / "b.zip").write_bytes(b"text")
    markdown, page = build()
    for text in (markdown, page):
        assert re.search("In no table(.|\n)*b.zip: .*File is not a zip file", text)


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
