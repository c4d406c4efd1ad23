"""The manifest of a run: read back as it was written; whatever a stranger put there is refused by its key."""

import dataclasses
import json
from pathlib import Path

import pytest

from headbench.bench.errors import InputError
from headbench.bench.manifest import Manifest
from headbench.bench.runner.store import Cell
from headbench.methods.ga.spec import GA
from headbench.metrics.psnr import PSNR

GALLERY = Path(__file__).parents[2] / "reports" / "gallery" / "run.json"


@pytest.fixture(scope="module")
def published():
    return json.loads(GALLERY.read_text())


def test_the_published_manifest_is_written_as_it_was_read(published, tmp_path):
    Manifest.read(GALLERY).write(tmp_path / "run.json")
    assert json.loads((tmp_path / "run.json").read_text()) == published


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda m: m.update(format=2), "format"),
        (lambda m: m.pop("configuration"), "configuration"),
        (lambda m: m.update(more=1), "more"),
        (lambda m: m.update(status="ended"), "status"),
        (lambda m: m.update(machine=[]), "machine"),
        (lambda m: m["configuration"].update(seeds=[]), "configuration"),
        (lambda m: m["configuration"].update(seeds="0"), "configuration.seeds"),
        (lambda m: m["methods"][0].update(trivial="no"), "methods[0].trivial"),
        (lambda m: m["methods"][0].update(name="../up"), "methods"),
        (lambda m: m["methods"].append(m["methods"][0]), "methods"),
        (lambda m: m["metrics"][0].update(digits=10**9), "metrics[0]"),
        (lambda m: m["metrics"][0].update(label="\x1b[2J"), "metrics[0]"),
        (lambda m: m["machine"].update(processor="x" * 1000), "machine, processor"),
        (lambda m: m["metrics"][0].update(tables=["/etc/x"]), "metrics, tables"),
        (lambda m: m["clips"][0].pop("fingerprint"), "clips[0].fingerprint"),
        (lambda m: m["clips"][0].update(subject="a/b"), "clips"),
        (lambda m: m["protocols"].update(novel_view=None), "protocols.novel_view"),
        (lambda m: m["protocols"]["novel_view"].pop("hash"), "protocols.novel_view.hash"),
        (lambda m: m["protocols"]["novel_view"]["keys"][0].pop(), "protocols.novel_view.keys[0][3]"),
        (lambda m: m["protocols"]["novel_view"]["keys"][0].reverse(), "protocols.novel_view.keys[0][1]"),
        (
            lambda m: m["protocols"]["novel_view"]["keys"].append(["..", "E", 0, "c"]),
            "protocols.novel_view.keys",
        ),
    ],
)
def test_a_manifest_that_is_none_is_refused_by_its_key(published, tmp_path, change, key):
    record = json.loads(json.dumps(published))
    change(record)
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError) as caught:
        Manifest.read(tmp_path / "run.json")
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("spec", "changes"),
    [
        (PSNR, {"name": "\x1b[2J"}),
        (PSNR, {"label": "x" * 121}),
        (PSNR, {"unit": "d\nB"}),
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
        ({"status": "ended"}, "status"),
        ({"interruptions": []}, "interruptions"),
        ({"seconds": "long"}, "seconds"),
        ({"fingerprints": []}, "fingerprints"),
        ({"files": {"avatar/a.npz": 1}}, "files.avatar/a.npz"),
        ({"files": {"../../a.npz": "0"}}, "files"),
        ({"files": {"/etc/passwd": "0"}}, "files"),
        ({"second": 1.5}, "second"),
    ],
)
def test_a_record_of_a_stage_that_is_none_is_refused_by_its_key(tmp_path, change, key):
    cell = Cell(tmp_path)
    cell.finish("fit", "f", seconds=1.5, files={"avatar/a.npz": "0"})
    assert cell.step("fit")["seconds"] == 1.5
    record = json.loads((tmp_path / "fit.json").read_text())
    (tmp_path / "fit.json").write_text(json.dumps({**record, **change}))
    with pytest.raises(InputError) as caught:
        cell.step("fit")
    assert caught.value.key == key
