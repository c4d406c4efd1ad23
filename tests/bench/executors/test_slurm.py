"""Cells as jobs of a real Slurm, of this machine: the same rows, whatever becomes of the jobs."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.executors.outcome import read_outcome
from headbench.bench.executors.settings import Execution, SlurmSettings
from headbench.bench.executors.slurm import queue, read_submitted, submitted_path
from headbench.tests.bench.executors import cluster

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


def wait_for(condition, seconds=90):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


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
    wait_for(lambda: any(starts(config, f"subject{n}", "slow") for n in (1, 2, 3)))
    os.kill(first.pid, signal.SIGINT)  # detach
    assert first.wait(30) == 130
    assert "jobs continue on the cluster" in first.stdout.read()
    running = next(n for n in (1, 2, 3) if starts(config, f"subject{n}", "slow"))
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
    assert all(read_outcome(cell_of(config, f"subject{n}", "toy"))["speed"] for n in (1, 2, 3))


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
