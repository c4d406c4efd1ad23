"""What keeps an executor from working: each is told in one paragraph that says what to do."""

import errno
import os
import tempfile
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from submitit.helpers import DelayedSubmission

from headbench.bench import cli
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.executors import slurm
from headbench.bench.executors.settings import Execution
from headbench.bench.executors.task import Task
from headbench.bench.executors.worker import run_job
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import locked


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


@contextmanager
def no_slurm(out, programs, monkeypatch):
    monkeypatch.setenv("PATH", "")
    yield


@contextmanager
def no_partition(out, programs, monkeypatch):
    refusal = "sbatch: error: invalid partition specified: nowhere"
    programs(sbatch=f"echo '{refusal}' >&2; exit 1")
    yield


@contextmanager
def no_space_to_submit(out, programs, monkeypatch):
    programs()

    def dump(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as the system reports it, without a name

    monkeypatch.setattr("submitit.core.utils.DelayedSubmission.dump", dump)
    yield


@contextmanager
def no_space_in_a_job(out, programs, monkeypatch):
    programs(
        sbatch="echo Submitted batch job 7",
        scontrol=f"echo JobState=FAILED Reason=NonZeroExitCode ExitCode={errno.ENOSPC}:0",
    )
    yield


@contextmanager
def no_space_for_a_log(out, programs, monkeypatch):
    programs(sbatch="echo Submitted batch job 7", scontrol="echo JobState=FAILED ExitCode=1:0")

    make = tempfile.TemporaryFile

    def temporary_file(**arguments):
        if slurm.submitted_path(out).exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return make(**arguments)

    monkeypatch.setattr("tempfile.TemporaryFile", temporary_file)
    yield


@contextmanager
def two_at_once(out, programs, monkeypatch):
    with locked(out):
        yield


SLURM = ("--executor", "slurm", "--set", "execution.poll_s=0.01")
PROCESSES = ("--executor", "processes", "--workers", "1")
CASES = {
    "no slurm": (no_slurm, SLURM, "there is no sbatch", "choose --executor processes"),
    "no partition": (no_partition, SLURM, "invalid partition specified: nowhere", "`sinfo` lists partitions"),
    "disk full, submitting": (no_space_to_submit, SLURM, "{out}/jobs: No space left", "Free disk space"),
    "disk full, job": (
        no_space_in_a_job,
        SLURM,
        "{out}/subject1/toy/seed-0: No space left on device (job 7)",
        "Free disk space",
    ),
    "disk full, no log": (no_space_for_a_log, SLURM, "{out}: No space left", "Free disk space"),
    "disk full, process": (
        None,
        PROCESSES,
        "{out}/subject1/full/seed-0/avatar/level.txt: No space",
        "Free disk space",
    ),
    "two attachments": (two_at_once, PROCESSES, "that no other process works in", "Wait for it to end"),
}


@pytest.mark.parametrize("name", CASES)
def test_each_is_one_paragraph_with_a_remedy(name, config, programs, tmp_path, monkeypatch, capsys):
    harm, options, expected, remedy = CASES[name]
    method = "dying_plugin:FULL" if harm is None else "toy_plugin:METHOD"
    data = tmp_path / "one"
    (data / "subject1").mkdir(parents=True)
    config = replace(config, data=str(data), methods=(method,))
    write_json(tmp_path / "config.json", asdict(config))
    out = Path(config.out)
    words = ["run", "--config", str(tmp_path / "config.json"), *options]
    if harm is None:
        code = cli.main(words)
    else:
        with harm(out, programs, monkeypatch):
            code = cli.main(words)
    assert code == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("headbench: ")]
    assert len(told) == 1
    assert expected.format(out=out) in told[0]
    assert remedy in told[0]
    assert not (out / "rows.parquet").exists()


def test_jobs_of_a_killed_process_are_cancelled_first(tmp_path, programs):
    own, others = slurm.job_name(tmp_path), slurm.job_name(tmp_path / "other")
    cancelled = tmp_path / "cancelled"
    listed = f"echo '3|RUNNING|None|{own}'; echo '5|PENDING|None|{others}'"
    programs(
        squeue=f"[ -e {cancelled} ] || echo '4_1|RUNNING|None|{own}'; {listed}",
        scancel=f"echo $* > {cancelled}",
        sbatch=f"[ -e {cancelled} ] && echo Submitted batch job 7",
    )
    write_json(slurm.submitted_path(tmp_path), {"speed": False, "jobs": {"a": "3"}})
    executor = slurm.Slurm(tmp_path, Execution("slurm"), speed=False)
    executor.submit([Task.of(tmp_path, place, "builtins:print") for place in ("a", "b")])
    assert cancelled.read_text().split() == ["4_1"]  # 3 is listed, 5 another folder's
    assert slurm.read_submitted(tmp_path)["jobs"] == {"a": "3", "b": "7"}


ENDED = {
    "disk full": f"FAILED ExitCode={errno.ENOSPC}:0",
    "cancelled before it ran": "CANCELLED ExitCode=0:0",
}


@pytest.mark.parametrize("state", ENDED.values(), ids=[*ENDED])
def test_jobs_of_an_earlier_start_are_tried_again(tmp_path, programs, state):
    programs(scontrol=f"echo JobState={state}")
    write_json(slurm.submitted_path(tmp_path), {"speed": False, "jobs": {"a": "3"}})
    executor = slurm.Slurm(tmp_path, Execution("slurm"), speed=False)
    executor.submit([Task.of(tmp_path, "a", "builtins:print")])  # whose folder no job has made yet
    (ended,) = [ended for _ in range(slurm.POLLS) for ended in executor.poll(0.0)]
    assert ended.again
    assert state.split()[0] in ended.lost


def test_a_job_that_was_cancelled_meanwhile_is_not_tried_again(tmp_path, programs):
    programs(scontrol="echo JobState=CANCELLED ExitCode=0:0", sbatch="echo Submitted batch job 7")
    executor = slurm.Slurm(tmp_path, Execution("slurm"), speed=False)
    executor.submit([Task.of(tmp_path, "a", "builtins:print")])
    (ended,) = [ended for _ in range(slurm.POLLS) for ended in executor.poll(0.0)]
    assert not ended.again
    assert ended.lost == "job 7 was cancelled"


def test_jobs_that_do_not_end_are_not_submitted_twice(tmp_path, programs, monkeypatch):
    programs(squeue=f"echo '4|RUNNING|None|{slurm.job_name(tmp_path)}'", sbatch="echo Submitted batch job 7")
    monkeypatch.setattr(slurm, "CANCEL_S", 0.0)
    executor = slurm.Slurm(tmp_path, Execution("slurm"), speed=False)
    with pytest.raises(UnavailableError, match="Jobs 4 of an earlier start do not end.*scancel"):
        executor.submit([Task.of(tmp_path, "a", "builtins:print")])
    assert not slurm.submitted_path(tmp_path).exists()


def test_a_list_of_jobs_from_elsewhere_is_refused(tmp_path):
    write_json(slurm.submitted_path(tmp_path), {"speed": False, "jobs": {"s/m/seed-0": "--help"}})
    with pytest.raises(InputError, match="the number of a job"):
        slurm.read_submitted(tmp_path)


def test_a_job_that_runs_out_of_time_is_submitted_again(tmp_path):
    task = Task.of(tmp_path, "cell", "module:function", seed=3)
    again = DelayedSubmission(run_job, task)._checkpoint_function()
    assert (again.function, again.args) == (run_job, (task,))
    assert hasattr(run_job, "checkpoint")  # which submitit asks for before it submits again
