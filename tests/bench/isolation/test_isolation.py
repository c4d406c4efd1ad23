"""Methods that try to change what others are given, or to read test images: in one process and in their own."""

import os
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Frame, FrameKey
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import RunConfig
from headbench.bench.engine.guard import ChangedInputError, check_frame
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.isolation.landlock import landlock_version, without
from headbench.bench.rows import ALL
from headbench.reports.tables import METHODS_TITLE, SUSPECT_TITLE, build_table

restricted = pytest.mark.skipif(landlock_version() < 6, reason="this kernel has no Landlock of version 6")


@pytest.fixture
def config(tmp_path, monkeypatch):
    """A run of an attack and of the toy method after it."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1])
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    capture = tmp_path / "data" / "subject1"
    capture.mkdir(parents=True)
    (capture / "secret.txt").write_text("test picture")
    monkeypatch.setenv("ATTACKED", str(capture))
    return RunConfig(
        data=str(tmp_path / "data"),
        out=str(tmp_path / "run"),
        preset="smoke",
        metrics=("psnr",),
        reader="toy_plugin:READER",
    )


def attacked(config, name, **changes):
    """Status and reasons of the attack's rows, the values of the toy method after it, and what the attack found."""
    methods = (f"attacks:{name.upper()}", "toy_plugin:METHOD")
    rows = runner.run(replace(config, methods=methods, **changes))
    every = {"metric": ALL, "task": ALL, "region": ALL, "seeds": ALL}
    own, honest = (rows.select(method=method, **every) for method in (name.lower(), "toy"))
    file = Path(config.out, "subject1", name.lower(), "seed-0", "avatar", "found.txt")
    found = file.read_text() if file.exists() else None
    return set(own["status"]), " ".join(own["reason"]), honest["value"].tolist(), found


def alone(config):
    """The values of the toy method without an attack."""
    rows = runner.run(replace(config, methods=("toy_plugin:METHOD",), out=f"{config.out}-alone"))
    return rows.select(method="toy", metric=ALL, task=ALL, region=ALL, seeds=ALL)["value"].tolist()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("ScalesCamera", "read-only"),
        ("ZeroesExpression", "read-only"),
        ("EmptiesClip", "no attribute 'clear'"),
        ("PaintsTrainingImages", "read-only"),
        ("PaintsByForce", "cannot set WRITEABLE"),
        ("ReplacesClip", "no attribute '_clip'"),
        ("AsksForTestImage", "not a training frame"),
        ("NotANumber", "alpha of"),
        ("TooBright", "rgb of"),
    ],
)
def test_a_method_cannot_change_what_others_get(config, name, reason):
    status, found, honest, _ = attacked(config, name)
    assert status == {"failed"}
    assert reason in found
    assert honest == alone(config)


def test_arrays_changed_by_force_end_the_run(config):
    with pytest.raises(ChangedInputError, match="scalescamerabyforce changed cameras"):
        attacked(config, "ScalesCameraByForce")
    cell = Path(config.out, "subject1", "scalescamerabyforce", "seed-0")
    assert not (cell / "rows.parquet").exists()  # nothing of it is kept
    status, _, honest, _ = attacked(config, "ScalesCameraByForce", isolation="plugins")
    assert status == {"ok"}  # it changed its own copy
    assert honest == alone(config)


def test_one_process_holds_test_images(config):
    """What isolation is for: nothing in one process can be hidden from Python code."""
    assert attacked(config, "ReadsClosure")[3] == "41"


def test_test_images_as_renders_are_suspect(config):
    methods = ("attacks:SHOWSTRUTH", "toy_plugin:METHOD")
    rows = runner.run(replace(config, methods=methods))
    marked = rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    marked = marked[marked["reason"] != ""]
    assert set(marked["reason"]) == {"suspect: above 50 dB"}
    assert len(marked) == 5  # every frame of the one method, none of the other
    assert set(marked["method"]) == {"showstruth"}
    psnr = [metric for metric in RunFolder(Path(config.out)).read_manifest().metrics if metric.name == "psnr"]
    table = build_table(
        rows, psnr, ("showstruth", "toy"), ("novel_view", "self_reenactment"), protocol_ids={}
    )
    groups = {title: [line.method for line in lines] for title, lines in table.groups}
    assert groups == {METHODS_TITLE: ["toy"], SUSPECT_TITLE: ["showstruth"]}
    assert "5 frames" not in " ".join(table.notes)
    assert "3 frames are above 50 dB" in table.notes[0]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("ReadsClosure", "'NoneType' object is not iterable"),
        ("AsksForTestImage", "not a training frame"),
        ("SendsNonsense", "no valid message"),
        ("SendsPickle", "no valid message"),
        ("Ends", "ended with exit code 7"),
        pytest.param("ReadsCapture", "Permission denied", marks=restricted),
        pytest.param("ReadsParentMemory", "Permission denied", marks=restricted),
        pytest.param("OpensParentRoot", "Permission denied", marks=restricted),
        pytest.param("WritesOutside", "Permission denied", marks=restricted),
        pytest.param("LinksCapture", "Permission denied", marks=restricted),
        pytest.param("DrawsCapture", "Permission denied", marks=restricted),
    ],
)
def test_an_isolated_method_reaches_nothing_else(config, name, reason):
    status, why, honest, found = attacked(config, name, isolation="plugins")
    assert (status, found) == ({"failed"}, None)
    assert reason in why
    assert honest == alone(config)
    assert Path(os.environ["ATTACKED"], "secret.txt").read_text() == "test picture"


@restricted
def test_an_isolated_method_has_no_network(config, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("ATTACKED_PORT", str(server.getsockname()[1]))
        assert attacked(config, "Connects")[3] == "connected"
        assert attacked(replace(config, out=f"{config.out}-2"), "Connects", isolation="plugins")[3] is None


@restricted
def test_an_isolated_method_sends_the_run_no_signal(config, monkeypatch):
    received = []
    before = signal.signal(signal.SIGUSR1, lambda *signalled: received.append(signalled))
    try:
        assert attacked(config, "KillsParent", isolation="plugins")[3] is None
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert received == []


def test_processes_that_an_isolated_method_leaves_end(config):
    found = attacked(config, "LeavesChild", isolation="plugins")[3]
    assert found is not None
    for _ in range(100):
        state = Path(f"/proc/{found}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("a process was left")


def test_isolated_results_are_the_same(config):
    own = replace(config, methods=("toy_plugin:MIRROR",), metrics=("psnr", "toy_plugin:FILES"))
    every = {"method": "mirror", "metric": ALL, "task": ALL, "region": ALL, "seeds": ALL}
    inside = runner.run(own).select(**every)["value"].tolist()
    isolated = (
        runner.run(replace(own, out=f"{config.out}-2", isolation="all")).select(**every)["value"].tolist()
    )
    assert len(inside) > 5
    assert isolated == inside


@pytest.mark.parametrize(
    ("rgb", "alpha", "match"),
    [
        (np.zeros((2, 3, 3)), np.zeros((2, 3)), None),
        (np.full((2, 3, 3), 1.0005), np.zeros((2, 3)), None),
        (np.full((2, 3, 3), 1.002), np.zeros((2, 3)), "rgb of .*from 1.002"),
        (np.full((2, 3, 3), -np.inf), np.zeros((2, 3)), "rgb"),
        (np.zeros((2, 3, 3)), np.full((2, 3), np.nan), "alpha of .*nan"),
        (np.zeros((3, 2, 3)), np.zeros((2, 3)), "rgb of .*shape"),
        (np.zeros((2, 3, 3)), np.zeros((2, 3, 1)), "alpha of .*shape"),
    ],
)
def test_values_of_a_frame_are_checked(rgb, alpha, match):
    key = FrameKey("s", "EMO", 0, "a")
    if match is None:
        check_frame(Frame(rgb, alpha), (2, 3), "cell", key)
    else:
        with pytest.raises(InputError, match=match):
            check_frame(Frame(rgb, alpha), (2, 3), "cell", key)


def test_hidden_folders_are_left_out_of_readable_ones(tmp_path):
    for place in ("a/b/hidden", "a/c", "d"):
        (tmp_path / place).mkdir(parents=True)
    hidden = [tmp_path / "a/b/hidden", tmp_path / "elsewhere"]
    assert sorted(without([tmp_path, tmp_path / "a/b/hidden"], hidden)) == [tmp_path / "a/c", tmp_path / "d"]
