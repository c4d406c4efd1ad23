"""The lock of a folder against real processes: held, released, and freed by a kill."""

import json
import os
import signal
import subprocess
import sys

import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.files import TEMPORARY, check_output_folder
from headbench.bench.io.lock import LOCK_FILE, is_locked, locked

HOLDER = """
import sys, time
from pathlib import Path
from headbench.bench.io.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_folder_in_use_by_another_process_is_refused(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "held\n"
        owner = rf"run\.lock.*process {process.pid} on .*, since 20"
        with pytest.raises(InputError, match=owner), locked(tmp_path):
            pytest.fail("entered a folder that was taken")
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert (tmp_path / LOCK_FILE).exists()
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK_FILE).read_text())["process"] == os.getpid()


def test_one_process_enters_once_and_a_damaged_lock_is_ignored(tmp_path):
    (tmp_path / LOCK_FILE).write_text("[1, 2")
    with locked(tmp_path):
        for content, owner in ((None, f"process {os.getpid()}"), ("[1, 2", "of unknown number")):
            if content is not None:
                (tmp_path / LOCK_FILE).write_text(content)
            with pytest.raises(InputError, match=owner), locked(tmp_path):
                pytest.fail("entered twice")
        assert is_locked(tmp_path)
    assert not is_locked(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    (tmp_path / "below").mkdir()
    left = tmp_path / "below" / f"{TEMPORARY}x.png"
    left.touch()
    with locked(left.parent):
        left.touch()
        with locked(tmp_path):
            assert left.exists()
    with locked(tmp_path):
        assert not left.exists()


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("there", [False, True])
def test_new_folders_in_which_nothing_was_written_are_removed(tmp_path, there, beside):
    folder = tmp_path / "above" / "out"
    if there:
        folder.mkdir(parents=True)
    check_output_folder(folder)
    assert (tmp_path / "above").exists() == folder.exists() == there
    with pytest.raises(RuntimeError), locked(folder, beside=beside):
        raise RuntimeError
    assert (tmp_path / "above").exists() == folder.exists() == there
