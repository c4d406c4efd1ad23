"""Cells worked on by several processes: the same rows as in one, whatever becomes of the processes."""

import os
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from headbench.bench import cli
from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine import run as runner
from headbench.bench.engine.run import _Run
from headbench.bench.engine.store import RunFolder, read_outcome, update_record
from headbench.bench.errors import InputError
from headbench.bench.executors.schedule import Processes, Schedule
from headbench.bench.executors.settings import Execution
from headbench.bench.executors.status import CellState, time_left
from headbench.bench.executors.task import Task
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import is_locked

from .cluster import wait_for

pytestmark = pytest.mark.commands

TWO = Execution("processes", workers=2, threads=1)
OPTIONS = ("--executor", "processes", "--workers", "1", "--set", "execution.threads=1")


def cell_of(config, subject, method):
    return RunFolder(Path(config.out)).cell(subject, method, 0).folder


def test_a_device_that_is_not_there_fails_each_task(tmp_path, monkeypatch):
    # A stand-in for torch, which takes a process longer to import than all else that it does.
    (tmp_path / "torch.py").write_text("class xpu:\n    is_available = staticmethod(lambda: False)\n")
    monkeypatch.syspath_prepend(tmp_path)
    tasks = [
        replace(Task.of(tmp_path, place, "math:sqrt"), device="xpu", restarts=0) for place in ("one", "two")
    ]
    for task in tasks:
        task.folder.mkdir()
    schedule = Schedule("tasks", lambda task: True, Execution("processes"))
    failures = schedule.run_all(tasks)
    assert set(failures) == {"one", "two"}
    for task in tasks:
        assert "device" in failures[task.place]
        assert "none that torch can use" in (task.folder / "job.log").read_text()
    processes = {read_outcome(task.folder)["process"] for task in tasks}
    assert len(processes) == 2, "a failure on a device may be that of its process"


DARK = Condition("dark", ("varying",), derive=Named("variant", {"name": "dark"}))


@pytest.mark.parametrize("subjects", [("subject1",)])
def test_rows_are_those_of_one_process_and_done_cells_are_kept(config, rows_of, capsys):
    config = replace(config, methods=("toy_plugin:VARYING", "toy_plugin:FAILING"), conditions=(DARK, PLAIN))
    inline = rows_of(replace(config, out=f"{config.out}-inline"))
    assert set(inline["status"]) == {"ok", "failed"}
    assert rows_of(config, TWO).equals(inline)
    capsys.readouterr()
    assert cli.main(["status", config.out]) == 1
    shown = capsys.readouterr().out
    assert "0 waiting, 0 running, 2 done, 1 failed" in shown
    assert "failing, subject subject1, seed 0: RuntimeError: the training diverged; see " in shown
    failing = cell_of(config, "subject1", "failing")
    outcome = read_outcome(failing)
    assert (outcome["status"], outcome["reason"]) == ("failed", "RuntimeError: the training diverged")
    assert "Traceback" in (failing / "job.log").read_text()
    assert outcome["process"] != os.getpid()
    paths = [cell_of(config, "subject1", name) / "cell.json" for name in ("varying", "failing")]
    before = [path.stat().st_mtime_ns for path in paths]
    assert rows_of(config, replace(TWO, workers=1)).equals(inline)
    assert [path.stat().st_mtime_ns == time for path, time in zip(paths, before)] == [True, False]
    assert rows_of(config).equals(inline)  # and inline afterwards
    assert read_outcome(paths[0].parent) is None  # inline leaves no outcomes, but rows


@pytest.mark.parametrize("subjects", [("subject1",)])
def test_a_killed_process_is_started_again_up_to_its_restarts(config, rows_of, capsys):
    config = replace(config, methods=("dying_plugin:DYING", "dying_plugin:ALWAYS"))
    by_method = dict(iter(rows_of(config, replace(TWO, restarts=1)).groupby("method")))
    kinds = {name: set(own["status"]) for name, own in by_method.items()}
    assert kinds == {"dying": {"ok"}, "always": {"failed"}}
    cell = cell_of(config, "subject1", "dying")
    assert (cell / "avatar" / "starts.log").read_text() == "xx"  # the second found what the first had left
    assert read_outcome(cell)["restarts"] == 1
    assert "about to be killed" in (cell / "job.log").read_text()
    assert by_method["always"]["reason"].str.contains("SIGKILL.*2 times").all()
    assert cli.main(["status", config.out]) == 1
    assert "0 waiting, 0 running, 1 done, 1 failed" in capsys.readouterr().out


def test_a_full_disk_ends_the_run_and_no_cell_is_failed(config):
    with pytest.raises(OSError, match="No space left"):
        runner.run(replace(config, methods=("dying_plugin:FULL",)), replace(TWO, workers=1))
    assert not RunFolder(Path(config.out)).rows.exists()


def test_kept_cells_are_named_and_changed_code_fails_others(config, rows_of, caplog):
    caplog.set_level("INFO", logger="headbench")
    config = replace(config, methods=("toy_plugin:METHOD",))
    rows_of(config, TWO)
    assert "kept: trained" not in caplog.text
    folder = RunFolder(Path(config.out))
    own = folder.read_manifest().machine
    for subject, processor in (("subject1", "A"), ("subject2", "B")):
        machine = {**own, "processor": processor}
        outcome = {"status": "done", "speed": False, "machine": machine}
        update_record(cell_of(config, subject, "toy"), task=outcome)
    runner.run(config, TWO)
    assert caplog.text.count("seed 0: kept: trained ") == 2
    assert folder.read_manifest().machine == {**own, "processor": "A and B"}
    assert "not comparable" in caplog.text
    assert _Run.read(folder.root).cells.keys() == {"toy"}
    record = read_json(folder.manifest)
    record["methods"][0]["code"] = "of another"
    write_json(folder.manifest, record)
    with pytest.raises(InputError, match="code of toy: expected of another"):
        _Run.read(folder.root)


def test_speed_is_measured_last_and_alone_also_after_an_end(config, rows_of, tmp_path, monkeypatch):
    methods = ("toy_plugin:METHOD", "dying_plugin:FAILING_ONCE")
    config = replace(config, methods=methods, metrics=("psnr", "fps"))
    with monkeypatch.context() as patch:
        patch.setattr("headbench.bench.executors.schedule.Processes", EndsAtSpeed)
        with pytest.raises(KeyboardInterrupt):
            runner.run(config, replace(TWO, workers=1))
    rows = rows_of(config, TWO)
    assert set(rows[rows["method"] == "toy"]["status"]) == {"ok"}
    assert set(rows[rows["method"] == "once"]["status"]) == {"ok"}  # trained again
    outcomes = [read_outcome(cell_of(config, subject, "toy")) for subject in ("subject1", "subject2")]
    assert [outcome["speed"] for outcome in outcomes] == [True, True]
    assert outcomes[0]["process"] == outcomes[1]["process"]  # one after another


class EndsAtSpeed(Processes):
    """Ends the run where it would begin to measure speed."""

    def submit(self, tasks):
        if tasks[0].speed:
            raise KeyboardInterrupt
        super().submit(tasks)


@pytest.mark.parametrize("subjects", [("subject1",)])
def test_with_the_parent_killed_workers_end(config, command, tmp_path, rows_of, capsys, monkeypatch):
    config = replace(config, methods=("dying_plugin:SLOW",))
    cell = cell_of(config, "subject1", "slow")
    first = command(config, *OPTIONS)
    wait_for((cell / "avatar" / "starts.log").exists)
    worker = read_outcome(cell)["process"]
    capsys.readouterr()
    assert cli.main(["status", config.out]) == 0
    assert "1 cell: 0 waiting, 1 running, 0 done, 0 failed" in capsys.readouterr().out
    first.kill()
    wait_for(lambda: not psutil.pid_exists(worker) and not is_locked(cell))
    assert cli.main(["status", config.out]) == 0
    assert "interrupted; start the run again" in capsys.readouterr().out
    (tmp_path / "go").touch()
    monkeypatch.chdir(tmp_path)
    rows_of(config, replace(TWO, workers=1))
    assert (cell / "avatar" / "starts.log").read_text() == "xx"
    assert cli.main(["status", config.out]) == 0
    assert "1 done" in capsys.readouterr().out


def test_time_left_is_by_method_and_shared_out():
    def cell(method, state, seconds=None):
        return CellState("s", method, 0, state, "", seconds)

    done = [cell("a", "done", 10.0), cell("a", "done", 20.0)]
    assert time_left(done) == (None, False)
    assert time_left([*done, cell("a", "waiting"), cell("a", "running", 5.0)]) == (25.0, False)
    two = [cell("a", "running", 5.0), cell("a", "running", 5.0), cell("b", "waiting")]
    assert time_left([*done, *two]) == (10.0, True)
    assert time_left([cell("b", "waiting")]) == (None, False)
    assert time_left([cell("a", "waiting", 8.0), cell("a", "waiting")]) == (8.0, True)  # one for its speed
