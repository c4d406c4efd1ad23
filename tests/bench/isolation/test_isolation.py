"""Methods that try to change what others are given, or to read test images: in one process and in their own."""

import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Budget, Frame, FrameKey, SharingAvatar
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import ResolvedMethod, RunConfig
from headbench.bench.engine.guard import ChangedInputError, check_frame
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.isolation.landlock import landlock_version, without
from headbench.bench.isolation.parent import IsolatedMethod
from headbench.bench.rows import ALL
from headbench.reports.tables import METHODS_TITLE, SUSPECT_TITLE, build_table

restricted = pytest.mark.skipif(landlock_version() < 6, reason="this kernel has no Landlock of version 6")
EVERY = {"metric": ALL, "task": ALL, "region": ALL, "seeds": ALL}
IN_PROCESS = {
    "ScalesCamera": "read-only",
    "ZeroesExpression": "read-only",
    "EmptiesClip": "no attribute 'clear'",
    "PaintsTrainingImages": "read-only",
    "PaintsByForce": "cannot set WRITEABLE",
    "ReplacesClip": "no attribute '_clip'",
    "AsksForTestImage": "not a training frame",
    "NotANumber": "alpha of",
    "TooBright": "rgb of",
    "RaisesWordless": "Wordless without a readable message",
}
"""Attacks in the process of the run, and the reason why they fail."""
ISOLATED = {
    "ReadsClosure": "'NoneType' object is not iterable",
    "AsksForTestImage": "not a training frame",
    "SendsNonsense": "no valid message",
    "SendsPickle": "no valid message",
    "Ends": "ended with exit code 7",
    "RaisesWordless": "Wordless without a readable message",
    "NamesOutside": "expected files in the folder of the avatar",
}
RESTRICTED = dict.fromkeys(
    ["ReadsCapture", "ReadsByDefault", "ReadsDisk", "ReadsParentMemory", "OpensParentRoot", "WritesOutside"]
    + ["LinksCapture", "DrawsCapture", "Connects", "KillsParent"],
    "Permission denied|Operation not permitted",
)
"""Attacks in isolation, and the reason why they fail; those of the second list where the kernel has Landlock."""
LEFT = ("LeavesChild", "LeavesDaemon")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Settings of a run, and what attacks reach for: a file beside the capture's images, a server, a disk, a signal."""
    folder = tmp_path_factory.mktemp("isolation")
    capture = folder / "data" / "subject1"
    capture.mkdir(parents=True)
    (capture / "secret.txt").write_text("test picture")
    disks = [path for path in Path("/dev").glob("*") if path.is_block_device() and os.access(path, os.R_OK)]
    before = signal.signal(signal.SIGUSR1, lambda *signalled: RECEIVED.append(signalled))
    with pytest.MonkeyPatch.context() as patch, socket.create_server(("127.0.0.1", 0)) as server:
        patch.syspath_prepend(Path(__file__).parents[1])
        patch.syspath_prepend(Path(__file__).parent)
        patch.setattr(runner, "write_reports", lambda folder: [])
        patch.setenv("ATTACKED", str(capture))
        patch.setenv("ATTACKED_PORT", str(server.getsockname()[1]))
        patch.setenv("ATTACKED_DISK", str(disks[0] if disks else "/dev/kmsg"))
        yield RunConfig(
            data=str(folder / "data"),
            out=str(folder / "run"),
            preset="smoke",
            metrics=("psnr",),
            reader="toy_plugin:READER",
        )
    signal.signal(signal.SIGUSR1, before)


RECEIVED: list[object] = []
"""Signals that reached the process of the run."""


@pytest.fixture
def config(place, tmp_path):
    """The settings with a run folder of the test's own."""
    return replace(place, out=str(tmp_path / "run"))


def attacked(config, *names, **changes):
    """By attack: status and reasons of its rows and what it found; under "mirror" the values of a method that shows poses, after them."""
    methods = (*(f"attacks:{name.upper()}" for name in names), "toy_plugin:MIRROR")
    rows = runner.run(replace(config, methods=methods, **changes))
    results = {"mirror": rows.select(method="mirror", **EVERY)["value"].tolist()}
    for name in names:
        own = rows.select(method=name.lower(), **EVERY)
        file = Path(config.out, "subject1", name.lower(), "seed-0", "avatar", "found.txt")
        found = file.read_text() if file.exists() else None
        results[name] = set(own["status"]), " ".join(own["reason"]), found
    return results


@pytest.fixture(scope="module")
def alone(place):
    """The values of that method without attacks."""
    return attacked(replace(place, out=f"{place.out}-alone"))["mirror"]


@pytest.fixture(scope="module")
def inside(place):
    """One run of all attacks in its process."""
    return attacked(replace(place, out=f"{place.out}-inside"), *IN_PROCESS)


@pytest.fixture(scope="module")
def isolated(place):
    """One run of all attacks in processes of their own."""
    names = [*ISOLATED, *(RESTRICTED if landlock_version() >= 6 else ()), *LEFT]
    return attacked(replace(place, out=f"{place.out}-isolated"), *names, isolation="plugins")


@pytest.mark.parametrize("name", IN_PROCESS)
def test_a_method_cannot_change_what_others_get(inside, name):
    status, reason, _ = inside[name]
    assert status == {"failed"}
    assert IN_PROCESS[name] in reason


@pytest.mark.parametrize("name", [*ISOLATED, *(pytest.param(name, marks=restricted) for name in RESTRICTED)])
def test_an_isolated_method_reaches_nothing_else(isolated, name):
    status, reason, found = isolated[name]
    assert (status, found) == ({"failed"}, None)
    assert re.search((ISOLATED | RESTRICTED)[name], reason)


def test_attacks_leave_everything_as_it_was(inside, isolated, alone):
    assert inside["mirror"] == isolated["mirror"] == alone
    assert Path(os.environ["ATTACKED"], "secret.txt").read_text() == "test picture"
    assert RECEIVED == []


def test_arrays_changed_by_force_end_the_run(config, alone):
    with pytest.raises(ChangedInputError, match="scalescamerabyforce changed cameras"):
        attacked(config, "ScalesCameraByForce")
    cell = Path(config.out, "subject1", "scalescamerabyforce", "seed-0")
    assert not (cell / "rows.parquet").exists()  # nothing of it is kept
    results = attacked(config, "ScalesCameraByForce", isolation="plugins")
    assert results["ScalesCameraByForce"][0] == {"ok"}  # it changed its own copy
    assert results["mirror"] == alone


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="these calls are those of Linux")
@pytest.mark.parametrize("name", ["TakesProcessors", "TakesFiles"])
def test_changed_limits_of_the_process_end_the_run(config, name):
    processors, files = os.sched_getaffinity(0), resource.getrlimit(resource.RLIMIT_NOFILE)
    if name == "TakesProcessors" and len(processors) == 1:
        pytest.skip("there is one processor")
    try:
        with pytest.raises(ChangedInputError, match=f"{name.lower()} changed limits"):
            attacked(config, name, isolation="plugins")
    finally:
        os.sched_setaffinity(0, processors)
        resource.setrlimit(resource.RLIMIT_NOFILE, files)


def test_one_process_holds_test_images(config):
    """What isolation is for: nothing in one process can be hidden from Python code."""
    results = attacked(config, "ReadsClosure", "ReadsCapture", "Connects")
    assert [results[name][2] for name in ("ReadsClosure", "ReadsCapture", "Connects")] == [
        "41",
        "test picture",
        "connected",
    ]


def test_test_images_as_renders_are_suspect(config):
    methods = ("attacks:SHOWSTRUTH", "toy_plugin:METHOD")
    rows = runner.run(replace(config, methods=methods))
    marked = rows.select(method=ALL, **EVERY)
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


@pytest.mark.parametrize("name", LEFT)
def test_processes_that_an_isolated_method_leaves_end(isolated, name):
    found = isolated[name][2]
    assert found is not None
    for _ in range(100):
        state = Path(f"/proc/{found}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("a process was left")


def test_isolated_results_are_the_same(config):
    own = replace(config, methods=("toy_plugin:MIRROR",), metrics=("psnr", "toy_plugin:FILES"))
    every = {"method": "mirror", **EVERY}
    inside = runner.run(own).select(**every)["value"].tolist()
    isolated = (
        runner.run(replace(own, out=f"{config.out}-2", isolation="all")).select(**every)["value"].tolist()
    )
    assert len(inside) > 5
    assert isolated == inside


@pytest.mark.parametrize("name", ["TOOBRIGHT", "SHARES"])
def test_an_isolated_avatar_offers_what_it_does_itself(place, tmp_path, name):
    import attacks

    (tmp_path / "level.txt").write_text("0.5")
    resolved = ResolvedMethod(getattr(attacks, name), attacks.ToyConfig(), Budget())
    avatar = IsolatedMethod(resolved, tmp_path).load(tmp_path, device="cpu")
    try:
        assert isinstance(avatar, SharingAvatar) == (name == "SHARES")
        assert not isinstance(avatar, SharingAvatar) or avatar.shared_files() == (Path(np.__file__),)
    finally:
        avatar.close()


def test_a_single_file_can_be_named_as_writable(tmp_path):
    file = tmp_path / "x"
    file.touch()
    code = f"from headbench.bench.isolation.landlock import restrict; restrict(['/'], ['{file}']); open('{file}', 'w').write('1')"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert file.read_text() == "1"


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
