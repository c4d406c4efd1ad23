"""Programs that leave processes or never end."""

import os
import signal
import sys
import time

import psutil
import pytest

from headbench.bench.machine import environment_variable
from headbench.bench.process import ProgramError, run_program

LEAVES = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"])
open("child", "w").write(str(child.pid))
print("the last line")
"""


def run(tmp_path, code, **options):
    lines = []
    ended = run_program([sys.executable, "-c", code], tmp_path, tmp_path / "log", lines.append, **options)
    return ended, lines


def is_running(process):
    """Whether a process that was left still runs; it may be nobody's child yet."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_child_that_holds_the_output_is_ended(tmp_path):
    began = time.monotonic()
    ended, lines = run(tmp_path, LEAVES)
    assert time.monotonic() - began < 60  # it sleeps for 300
    assert (ended.code, ended.lines, lines) == (0, ("the last line",), ["the last line"])
    assert (tmp_path / "log").read_text().endswith("the last line\n")
    child = int((tmp_path / "child").read_text())
    until = time.monotonic() + 10
    while is_running(child) and time.monotonic() < until:
        time.sleep(0.02)
    assert not is_running(child)


@pytest.fixture
def endless(tmp_path):
    """Code of a program that starts `yes` in a session of its own, which is no part of the program."""
    yield "import subprocess; print(subprocess.Popen(['yes'], start_new_session=True).pid, file=open('yes', 'w'))"
    os.kill(int((tmp_path / "yes").read_text()), signal.SIGKILL)


def test_a_child_that_writes_without_end_is_not_followed(tmp_path, endless):
    ended, _ = run(tmp_path, endless)
    assert ended.code == 0


def test_a_program_over_its_time_limit_is_ended(tmp_path):
    with pytest.raises(ProgramError, match=r"ended after 0.0003 hours.*time_limit_hours.*begun"):
        run(tmp_path, "import time; print('begun', flush=True); time.sleep(300)", hours=0.0003)


@pytest.mark.parametrize(
    ("code", "end"),
    [
        ("os.close(1); os.close(2); import time; time.sleep(0.5); os._exit(5)", 5),
        ("os.kill(os.getpid(), 9)", -9),
    ],
)
def test_a_program_that_closes_its_output_is_waited_for(tmp_path, code, end):
    assert run(tmp_path, f"import os; {code}")[0].code == end


@pytest.mark.parametrize("before", [None, "old"])
@pytest.mark.parametrize("value", [None, "new"])
def test_a_variable_is_set_within_the_block_alone(monkeypatch, before, value):
    name = "HEADBENCH_TEST_VARIABLE"
    if before is not None:
        monkeypatch.setenv(name, before)
    with environment_variable(name, value):
        assert os.environ.get(name) == (value or before)
    assert os.environ.get(name) == before
