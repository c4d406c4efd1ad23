"""Cells as jobs of a real Slurm, of this machine: the same rows, whatever becomes of the jobs."""

import errno
import os
import re
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pandas as pd
import pytest
from submitit.helpers import DelayedSubmission

from headbench.bench import cli
from headbench.bench.engine.store import RunFolder, read_outcome
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.executors import slurm as module
from headbench.bench.executors.settings import Execution, SlurmSettings
from headbench.bench.executors.slurm import queue, read_submitted, run_job, submitted_path
from headbench.bench.executors.task import Task
from headbench.bench.io.files import write_json
from headbench.tests.bench.executors import cluster
from headbench.tests.bench.executors.cluster import wait_for

ABSENT = cluster.missing()
needs_slurm = pytest.mark.skipif(bool(ABSENT), reason=f"Slurm is not installed: no {', '.join(ABSENT)}")
JOBS = SlurmSettings(cpus=1, memory_gb=1.5, hours=0.25, exclusive=True)
SLURM = Execution("slurm", poll_s=0.5, slurm=JOBS)
OPTIONS = (
    "--executor=slurm",
    *(
        f"--set=execution.{s}"
        for s in ("poll_s=0.5", "slurm.cpus=1", "slurm.memory_gb=1.5", "slurm.hours=0.25")
    ),
)


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A cluster, found by SLURM_CONF."""
    folder = tmp_path_factory.mktemp("slurm")
    before = os.environ.get("SLURM_CONF")
    cluster.start(folder)
    yield
    cluster.stop(folder)
    os.environ.pop("SLURM_CONF")
    if before is not None:
        os.environ["SLURM_CONF"] = before


def cell_of(config, subject, method):
    return RunFolder(Path(config.out)).cell(subject, method, 0).folder


def starts(config, subject, method):
    path = cell_of(config, subject, method) / "avatar" / "starts.log"
    return path.read_text() if path.exists() else ""


@needs_slurm
@pytest.mark.slurm
def test_rows_equal_inline_through_kill_preemption_failure(
    config, slurm, command, tmp_path, rows_of, monkeypatch
):
    methods = ("toy_plugin:FAILING", "dying_plugin:DYING", "dying_plugin:SLOW")
    config = replace(config, methods=methods, metrics=(*config.metrics, "storage"))
    first = command(config, *OPTIONS)
    wait_for(lambda: any(starts(config, f"subject{n}", "slow") for n in (1, 2)))
    os.kill(first.pid, signal.SIGINT)  # detach
    assert first.wait(30) == 130
    assert "jobs continue on the cluster" in first.stdout.read()
    running = next(n for n in (1, 2) if starts(config, f"subject{n}", "slow"))
    hog = ["sbatch", "--wait", "-p", "urgent", f"-c{os.cpu_count()}", "-o/dev/null", "--wrap=true"]
    subprocess.run(hog, check=True, capture_output=True, timeout=90)  # which has preempted all others
    (tmp_path / "go").touch()
    second = command(config, *OPTIONS)  # attach
    assert second.wait(150) == 1
    assert re.search(r"following \d+ jobs", second.stdout.read())
    assert not submitted_path(Path(config.out)).exists()
    assert starts(config, f"subject{running}", "slow") == starts(config, "subject1", "dying") == "xx"
    assert read_outcome(cell_of(config, f"subject{running}", "slow"))["restarts"] == 1
    assert read_outcome(cell_of(config, "subject1", "dying"))["restarts"] == 1
    log = cell_of(config, "subject2", "failing") / "job.log"
    assert "the training diverged" in log.read_text()
    monkeypatch.chdir(tmp_path)
    found = pd.read_parquet(RunFolder(Path(config.out)).rows)
    kinds = {method: set(rows["status"]) for method, rows in found.groupby("method")}
    assert kinds == {"failing": {"failed"}, "dying": {"ok"}, "slow": {"ok"}}
    unharmed = replace(config, out=f"{config.out}-inline", methods=(methods[0], methods[2]))
    assert found[found["method"] != "dying"].reset_index(drop=True).equals(rows_of(unharmed))


@needs_slurm
@pytest.mark.slurm
def test_speed_and_settings_that_slurm_refuses(config, slurm, rows_of):
    config = replace(config, methods=("toy_plugin:METHOD",), metrics=("psnr", "fps"))
    unknown = replace(SLURM, slurm=replace(JOBS, partition="nowhere"))
    with pytest.raises(InputError, match="jobs that sbatch takes, found .*partition.*nowhere"):
        rows_of(config, unknown)
    with pytest.raises(InputError, match="jobs that sbatch takes"):
        rows_of(config, replace(SLURM, slurm=replace(JOBS, memory_gb=1e6)))
    assert set(rows_of(config, SLURM)["status"]) == {"ok"}
    assert all(read_outcome(cell_of(config, f"subject{n}", "toy"))["speed"] for n in (1, 2))


@needs_slurm
@pytest.mark.slurm
def test_a_cancelled_job_is_a_failed_cell_until_resubmitted(config, slurm, command, tmp_path):
    config = replace(config, methods=("dying_plugin:SLOW",))
    first = command(config, *OPTIONS)
    wait_for(lambda: starts(config, "subject1", "slow"))
    jobs = read_submitted(Path(config.out))["jobs"]
    job, late = (jobs[f"subject{n}/slow/seed-0"] for n in (1, 2))
    subprocess.run(["scancel", job], check=True)
    wait_for(lambda: job not in queue() and starts(config, "subject2", "slow"))
    subprocess.run(["scancel", "-s", "USR2", late], check=True)  # what Slurm sends before time is out
    wait_for(lambda: late not in queue() or queue()[late].state != "RUNNING")
    (tmp_path / "go").touch()
    assert first.wait(90) == 1
    assert "was cancelled" in first.stdout.read()
    assert starts(config, "subject2", "slow") == "xx"
    assert command(config, *OPTIONS).wait(90) == 0


def test_without_slurm_it_says_what_is_missing(config, monkeypatch, rows_of):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UnavailableError, match="no sbatch, srun.*choose --executor processes"):
        rows_of(config, SLURM)
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "submitit", None)
    monkeypatch.setattr("shutil.which", lambda name: name)
    with pytest.raises(UnavailableError, match=r"pip install -e '.\[slurm\]'"):
        rows_of(config, SLURM)


@pytest.fixture
def programs(tmp_path, monkeypatch):
    """Make programs of Slurm that answer as told: shell scripts by name, alone on PATH."""

    def programs(**scripts):
        folder = tmp_path / "bin"
        folder.mkdir(exist_ok=True)
        for name in ("sbatch", "srun", "squeue", "scontrol", "scancel"):
            (folder / name).write_text(f"#!/bin/sh\n{scripts.get(name, 'true')}\n")
            (folder / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
        return folder

    return programs


REFUSED = {
    "no partition": (
        "echo 'invalid partition specified: nowhere' >&2; exit 1",
        "",
        "invalid partition specified: nowhere.*`sinfo` lists partitions",
    ),
    "disk full": (
        "echo Submitted batch job 7",
        f"echo JobState=FAILED ExitCode={errno.ENOSPC}:0",
        r"subject1/toy/seed-0: No space left on device \(job 7_0\).*Free disk space",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_stops_all_jobs_ends_the_run(config, programs, tmp_path, capsys, case):
    sbatch, scontrol, message = REFUSED[case]
    programs(sbatch=sbatch, scontrol=scontrol or "true")
    write_json(tmp_path / "config.json", asdict(replace(config, methods=("toy_plugin:METHOD",))))
    words = ["run", "--config", str(tmp_path / "config.json"), "--executor", "slurm"]
    assert cli.main([*words, "--set", "execution.poll_s=0.01"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("headbench: ")]
    assert re.search(message, line)
    assert not (Path(config.out) / "rows.parquet").exists()


def test_jobs_of_a_killed_process_are_cancelled_first(tmp_path, programs):
    own, others = module.job_name(tmp_path), module.job_name(tmp_path / "other")
    cancelled = tmp_path / "cancelled"
    listed = f"echo '3|RUNNING|None|{own}'; echo '5|PENDING|None|{others}'"
    programs(
        squeue=f"[ -e {cancelled} ] || echo '4_1|RUNNING|None|{own}'; {listed}",
        scancel=f"echo $* > {cancelled}",
        sbatch=f"[ -e {cancelled} ] && echo Submitted batch job 7",
    )
    write_json(submitted_path(tmp_path), {"speed": False, "jobs": {"a": "3"}})
    executor = module.Slurm(tmp_path, Execution("slurm"), speed=False)
    executor.submit([Task.of(tmp_path, place, "builtins:print") for place in ("a", "b")])
    assert cancelled.read_text().split() == ["4_1"]  # 3 is listed, 5 another folder's
    assert read_submitted(tmp_path)["jobs"] == {"a": "3", "b": "7"}


@pytest.fixture
def ended(tmp_path, programs):
    """Job a as the executor sees its end, in some state; submitted by an earlier start or by this one."""

    def ended(state, earlier):
        programs(scontrol=f"echo JobState={state}", sbatch="echo Submitted batch job 7")
        if earlier:
            write_json(submitted_path(tmp_path), {"speed": False, "jobs": {"a": "3"}})
        executor = module.Slurm(tmp_path, Execution("slurm"), speed=False)
        executor.submit([Task.of(tmp_path, "a", "builtins:print")])  # whose folder no job has made yet
        (ended,) = [ended for _ in range(module.POLLS) for ended in executor.poll(0.0)]
        return ended

    return ended


@pytest.mark.parametrize("state", [f"FAILED ExitCode={errno.ENOSPC}:0", "CANCELLED ExitCode=0:0"])
def test_jobs_of_an_earlier_start_are_tried_again(ended, state):
    found = ended(state, earlier=True)
    assert found.again
    assert state.split()[0] in found.lost


def test_a_job_that_was_cancelled_meanwhile_is_not_tried_again(ended):
    found = ended("CANCELLED ExitCode=0:0", earlier=False)
    assert (found.again, found.lost) == (False, "job 7 was cancelled")


def test_jobs_that_do_not_end_are_not_submitted_twice(tmp_path, programs, monkeypatch):
    programs(squeue=f"echo '4|RUNNING|None|{module.job_name(tmp_path)}'", sbatch="echo Submitted batch job 7")
    monkeypatch.setattr(module, "CANCEL_S", 0.0)
    executor = module.Slurm(tmp_path, Execution("slurm"), speed=False)
    with pytest.raises(UnavailableError, match="Jobs 4 of an earlier start do not end.*scancel"):
        executor.submit([Task.of(tmp_path, "a", "builtins:print")])
    assert not submitted_path(tmp_path).exists()


def test_a_job_that_runs_out_of_time_is_submitted_again(tmp_path):
    task = Task.of(tmp_path, "cell", "module:function", seed=3)
    again = DelayedSubmission(run_job, task)._checkpoint_function()
    assert (again.function, again.args) == (run_job, (task,))
    assert hasattr(run_job, "checkpoint")  # which submitit asks for before it submits again
