"""The manifest of a run: read back as it was written; whatever a stranger put there is refused by its key."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from headbench.bench.engine.store import Cell
from headbench.bench.errors import InputError
from headbench.bench.manifest import PROTOCOLS, Manifest, protocol_path
from headbench.methods.ga.spec import GA
from headbench.metrics.psnr import PSNR

GALLERY = Path(__file__).parents[2] / "reports" / "gallery" / "run.json"


@pytest.fixture
def published(tmp_path):
    """A copy of the published run, with its protocols in its own folder."""
    shutil.copytree(GALLERY.parent / PROTOCOLS, tmp_path / "run" / PROTOCOLS)
    return Path(shutil.copy(GALLERY, tmp_path / "run"))


def change_json(path, change):
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def test_the_published_manifest_is_written_as_it_was_read(published, tmp_path):
    Manifest.read(published).write(tmp_path / "again" / "run.json")
    files = [path.relative_to(published.parent) for path in published.parent.rglob("*.json")]
    assert len(files) == 3
    for file in files:
        assert (tmp_path / "again" / file).read_bytes() == (published.parent / file).read_bytes()


def test_where_a_readers_files_lie_is_no_difference(published):
    def reading(**settings):
        configuration = dataclasses.replace(manifest.configuration, reader_settings=settings)
        return dataclasses.replace(manifest, configuration=configuration)

    manifest = dataclasses.replace(Manifest.read(published), methods=())
    reading(head="/there/head.npz").check_same(reading(head="/here/head.npz"), {}, published)
    with pytest.raises(InputError, match="reader_settings.exclude: expected 2, as in this run, found 3"):
        reading(exclude="3").check_same(reading(exclude="2"), {}, published)


def test_protocols_missing_or_of_another_run_are_refused(published):
    own = Manifest.read(published).protocols
    first, second = (protocol_path(published.parent, each.hash) for each in own.values())
    second.replace(first)
    with pytest.raises(InputError, match="task, hash: expected novel_view, .*found self_reenactment"):
        Manifest.read(published)
    first.unlink()
    with pytest.raises(InputError, match="the protocol of novel_view.*no such file") as caught:
        Manifest.read(published)
    assert caught.value.file == str(first)


def check_refused(manifest, file, change, key):
    """Reading a manifest refuses a change of it, or of a file beside it, by file and key."""
    change_json(file, change)
    with pytest.raises(InputError) as caught:
        Manifest.read(manifest)
    assert caught.value.key == key
    assert caught.value.file == str(file)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda m: m.pop("configuration"), "configuration"),
        (lambda m: m.update(more=1), "more"),
        (lambda m: m["configuration"].update(seeds=[]), "configuration"),
        (lambda m: m["methods"][0].update(trivial="no"), "methods[0].trivial"),
        (lambda m: m["metrics"][0].update(digits=10**9), "metrics[0]"),
        (lambda m: m["clips"][0].pop("fingerprint"), "clips[0].fingerprint"),
    ],
)
def test_a_manifest_that_is_none_is_refused_by_its_key(published, change, key):
    check_refused(published, published, change, key)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda p: p.pop("hash"), "hash"),
        (lambda p: p.update(hash="other"), "task, hash"),
        (lambda p: p["keys"][0].reverse(), "keys[0][1]"),
    ],
)
def test_a_protocol_that_is_none_is_refused_by_its_key(published, change, key):
    file = protocol_path(published.parent, Manifest.read(published).protocols["novel_view"].hash)
    check_refused(published, file, change, key)


@pytest.mark.parametrize(
    ("spec", "changes"),
    [
        (PSNR, {"name": "\x1b[2J"}),
        (PSNR, {"label": "x" * 121}),
        (GA, {"name": "x" * 121}),
        (GA, {"version": "1\0"}),
    ],
)
def test_a_spec_that_no_results_could_be_read_with_is_refused(spec, changes):
    with pytest.raises(ValueError, match="at most 120 printable characters"):
        dataclasses.replace(spec, **changes)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"fingerprint": 1}, "fingerprint"),
        ({"state": "done"}, "state"),
        ({"measured": ["psnr", 1]}, "measured[1]"),
        ({"second": 1.5}, "second"),
    ],
)
def test_a_record_of_a_cell_that_is_none_is_refused_by_its_key(tmp_path, change, key):
    cell = Cell(tmp_path)
    cell.update(state="trained", training={"seconds": 1.5})
    assert cell.record["training"]["seconds"] == 1.5
    cell.update(**change)
    with pytest.raises(InputError, match=f"Delete {tmp_path}; the same command makes it again") as caught:
        _ = cell.record
    assert caught.value.key == key
