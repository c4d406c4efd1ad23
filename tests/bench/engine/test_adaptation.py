"""The harness brings clips into the form a method declares, and its renders back; other methods see no change."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.contracts import Camera
from headbench.bench.engine import adaptation
from headbench.bench.engine import run as runner
from headbench.bench.engine.adaptation import MethodNeeds, plan
from headbench.bench.engine.captures import open_clips
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.plan import trained
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest, write_text
from headbench.bench.io.images import read_png
from headbench.bench.specs import ResolutionRule

TWICE = ResolutionRule(size=(16, 12), speed_size=(32, 24))


@pytest.fixture
def config(toy, config, monkeypatch):
    monkeypatch.setattr(adaptation, "adapter", lambda: toy.adapt)
    metrics = ("toy_plugin:ERROR", "toy_plugin:FILES")
    return dataclasses.replace(config, methods=("toy_plugin:MIRROR",), metrics=metrics)


@pytest.fixture
def cell(config):
    return RunFolder(Path(config.out)).cell("subject1", "mirror", 0)


def manifest_of(config):
    return read_json(Path(config.out) / "run.json")


def declare(monkeypatch, toy, name="MIRROR", **needs):
    monkeypatch.setattr(toy, name, dataclasses.replace(getattr(toy, name), **needs))


def test_a_method_without_needs_gets_the_clip_itself(config, toy, cell):
    clip = toy.ToyClip("subject1")
    assert plan(clip, MethodNeeds(), {}) is None
    runner.run(config)
    assert toy.ADAPTED == []
    record = manifest_of(config)
    assert record["adapted"] == []
    assert "needs" not in record["methods"][0]
    # The formula before methods had needs: avatars trained then stay valid.
    method = {name: value for name, value in record["methods"][0].items() if name != "codec"}
    expected = digest(1, method, 0, "cpu", "toy-subject1")
    assert cell.record["fingerprint"] == expected


def test_renders_of_the_adapted_clip_are_brought_back(config, toy, monkeypatch, cell):
    for name in ("MIRROR", "METHOD"):
        declare(monkeypatch, toy, name, resolution=TWICE)
    methods = ("toy_plugin:MIRROR", "toy_plugin:METHOD")
    run = dataclasses.replace(config, methods=methods, heads={"flame2020": "/somewhere"}, seeds=(0, 1))
    assert runner.run(run).rows.failed == []
    assert toy.ADAPTED == ["subject1"]  # once for both, whose needs are equal
    assert toy.WORKLOAD_SIZES == {(32, 24)}  # at which speed is measured
    for key in toy.ToyClip("subject1").splits["novel_view"]:
        image = read_png(cell.render("novel_view", key))
        assert image.shape == (6, 8, 3)  # the protocol's size, not the method's 16x12
        assert (image == round(255 * (0.5 + key.timestep / 10))).all()  # the adapted pose of the same frame
    record = manifest_of(config)
    adapted = record["adapted"][0]
    assert adapted["subject"] == "subject1"
    assert {each["method"] for each in record["adapted"]} == {"mirror", "toy"}
    assert adapted["fingerprint"] == "toy-subject1-adapted"
    assert [step["name"] for step in adapted["steps"]] == ["adapt"]
    assert adapted["steps"][0]["parameters"] == {"heads": {"flame2020": "/somewhere"}}
    assert record["methods"][0]["needs"]["resolution"]["size"] == [16, 12]


@pytest.mark.parametrize(
    "look",
    [
        lambda run, out: cli.main(["verify", str(run), "--trust"]) == 0,
        lambda run, out: trained(run, (), RunOptions(trust=True), out),
    ],
    ids=["verify", "sweep, extremes, reenact"],
)
def test_looking_at_a_run_writes_nothing_there(config, toy, tmp_path, monkeypatch, look):
    declare(monkeypatch, toy, resolution=TWICE)
    adapt, found = toy.adapt, []

    def keeping(clip, needs, heads):
        def work(folder, progress):
            found.append((folder / "kept").exists())
            write_text(folder / "kept", "kept")
            return adapt(clip, needs, heads)(folder, progress)

        return work

    monkeypatch.setattr(toy, "adapt", keeping)
    config = dataclasses.replace(config, divide=2)
    runner.run(config)
    run, out = Path(config.out), tmp_path / "looked"
    # Reduction needs a folder, too: that of the run itself, where it is made.
    kept = [run / "adapted" / "subject1" / "kept", run / "kept"]
    assert found == [False, False]
    times = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    assert look(run, out)
    assert found[2:] == [False, True]
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == times
    for path in kept:
        path.unlink()
    assert look(run, tmp_path / "again")
    assert found[4:] == [False, False]
    assert not kept[1].exists()


def test_needs_that_cannot_be_or_are_not_met_are_refused(config, toy, monkeypatch):
    monkeypatch.setattr(toy.ToyClip, "head", dataclasses.make_dataclass("Head", ["version"])("toy"))
    declare(monkeypatch, toy, "METHOD", head_models=("impossible",))
    with pytest.raises(InputError, match="head_models"):
        runner.run(dataclasses.replace(config, methods=("toy_plugin:MIRROR", "toy_plugin:METHOD")))
    assert toy.ADAPTED == []
    declare(monkeypatch, toy, head_models=("wanted",))
    monkeypatch.setattr(toy, "SimpleNamespace", lambda version: toy.ToyClip.head)
    with pytest.raises(InputError, match="expected a capture tracked with wanted, found toy"):
        runner.run(config)
    assert toy.FITS == []


def test_a_reduced_comparison_has_another_size_and_another_hash(config, toy):
    record = {}
    for divide in (1, 2):
        chosen = dataclasses.replace(config, divide=divide, out=f"{config.out}{divide}")
        assert runner.run(chosen).rows.failed == []
        manifest = manifest_of(chosen)
        record[divide] = RunFolder(Path(chosen.out)).read_manifest().protocols["novel_view"]
        # Whoever opens the captures of a run again, as reports do, sees what was measured.
        (clip,) = open_clips(chosen)
        assert clip.fingerprint == manifest["clips"][0]["fingerprint"]
    assert record[1].resolution == "8x6"
    assert record[2].resolution == "4x3"
    assert record[1].hash != record[2].hash


@pytest.mark.parametrize(
    "settings",
    [{"divide": 0}, {"multiply": -1}, {"size": (0, 5)}, {"square": "trim"}, {"size": (8, 8), "multiply": 2}],
)
def test_a_rule_without_meaning_is_refused(settings):
    with pytest.raises(ValueError, match="ResolutionRule"):
        ResolutionRule(**settings)


def test_intrinsics_follow_the_image():
    rng = np.random.default_rng(0)
    K = np.array([[900.0, 0, 270.3], [0, 910, 401.9], [0, 0, 1]])
    camera = Camera("c", 550, 802, K, np.eye(4))
    point = np.append(rng.normal(size=2) * 0.05, 1.0)
    x, y = (K @ point)[:2]
    resized = camera.resized(1100, 401)
    assert (resized.K @ point)[:2] == pytest.approx([2 * x, y / 2])
    assert (resized.width, resized.height) == (1100, 401)
    boxed = camera.boxed(-126, 10, 802, 700)
    assert (boxed.K @ point)[:2] == pytest.approx([x + 126, y - 10])
    assert camera.K[0, 2] == 270.3
