"""Signals at every stage of a command: one line, the exit code of the signal, and another start continues."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from headbench.bench.listing import ListSettings
from headbench.bench.registry import discover

CONSOLE_SCRIPT = "import sys\nfrom headbench.bench.start import main\nsys.exit(main())\n"
LINES = {
    signal.SIGINT: "headbench: interrupted; start it again to continue",
    signal.SIGTERM: "headbench: ended by SIGTERM; start it again to continue",
    signal.SIGHUP: "headbench: ended by SIGHUP; start it again to continue",
}

METHOD = """
import time
from pathlib import Path
import numpy as np
from headbench.bench import start
from headbench.bench.specs import MethodSpec
from toy_plugin import ToyAvatar, ToyConfig

class Slow:
    def __init__(self, config):
        self.config = config

    def fit(self, clip, out, budget, *, device, seed, progress):
        if not (out / "half").exists():
            out.mkdir(parents=True, exist_ok=True)
            (out / "half").touch()
            train()
        (out / "level.txt").write_text("0.5")
        return self.load(out, device=device)

    def load(self, path, *, device):
        return ToyAvatar(path)

def multiply():
    values = np.ones((300, 300))
    print("training", flush=True)
    while True:
        values = values @ values / 300

def train_deaf():
    while True:
        try:
            multiply()
        except BaseException:
            pass

train = multiply
if Path("deaf").exists():
    start.GRACE_S, train = 0.1, train_deaf

SPEC = MethodSpec("slow", "trains until it is interrupted", "slow_plugin:Slow", config="toy_plugin:ToyConfig")
"""


def restore_signals():
    """Whatever ran the tests, for example in the background of a shell, the command starts without ignored signals."""
    for number in LINES:
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def start(tmp_path):
    """Start headbench with some words in an empty folder, in a process group of its own."""
    (tmp_path / "slow_plugin.py").write_text(METHOD)
    processes = []

    def start(*words, flags=(), preexec_fn=restore_signals, **settings):
        path = os.pathsep.join([str(tmp_path), str(Path(__file__).parent)])
        process = subprocess.Popen(
            [sys.executable, *flags, "-c", CONSOLE_SCRIPT, *map(str, words)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=preexec_fn,  # noqa: PLW1509 - nothing runs in another thread here
            **settings,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_ctrl_c_while_modules_are_imported_is_a_line(start):
    process = start("run", "--help", flags=("-X", "importtime"))
    imported = re.compile(r"\| +csv$")
    while not imported.search(process.stderr.readline().rstrip()):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate()
    # A line of importtime may be cut in two.
    assert (process.returncode, output, errors.splitlines()[-1]) == (130, "", LINES[signal.SIGINT])
    assert "Traceback" not in errors


@pytest.fixture
def run_words(tmp_path):
    (tmp_path / "data" / "subject1").mkdir(parents=True)
    return [
        *("run", "--data", "data", "--out", "out", "--methods", "slow_plugin:SPEC"),
        *("--set", "reader=toy_plugin:READER", "--set", "metrics=psnr"),
    ]


@pytest.mark.commands
def test_a_signal_in_training_is_a_line_and_the_run_goes_on(start, run_words, tmp_path):
    process = start(*run_words)
    assert process.stdout.readline() == "training\n"
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 143
    assert errors.splitlines()[-1] == LINES[signal.SIGTERM]
    assert "Traceback" not in errors
    assert not (tmp_path / "out" / "run.lock").exists()
    again = start(*run_words)
    _, errors = again.communicate()
    assert again.returncode == 0, errors


def test_ignored_signals_stay_so_and_a_swallowed_end_comes(start, run_words, tmp_path):
    def ignore():
        restore_signals()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    (tmp_path / "deaf").touch()
    process = start(*run_words, preexec_fn=ignore)
    assert process.stdout.readline() == "training\n"
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert (process.returncode, errors.splitlines()[-1]) == (130, LINES[signal.SIGINT])


LISTS = [f"list {what}" for what in get_args(get_type_hints(ListSettings)["what"])]
LISTS_OF_FILES = ["list papers", "list protocols"]
PARSER = {"numpy", "tyro", "yaml"}
PARSER |= {f"headbench.{name}" for name in ("bench.comparison", "reports.page.settings")}
"""What a call of one command needs, and settings of two."""
HEAVY = "cv2 matplotlib nlopt pandas PIL psutil pyarrow pycolmap pydantic pymeshlab rich safetensors scipy skimage"
USED_BY_COMMANDS = {*HEAVY.split(), "sklearn", "torch", "torchmetrics"}

HELPS = [
    f"{name} --help"
    for name, command in sorted(discover("commands").items())
    if command.spec.function.startswith(("headbench.bench.", "headbench.reports."))
]

UNUSED = [
    (["--version", "--help", "prepare --help"], USED_BY_COMMANDS | PARSER),
    (
        ["demo --help", "prepare nersemble --help", "runn", *sorted({*LISTS} - {*LISTS_OF_FILES})],
        USED_BY_COMMANDS,
    ),
    (LISTS_OF_FILES, USED_BY_COMMANDS - {"pydantic"}),
    (HELPS, USED_BY_COMMANDS - {"pydantic", "cv2", "PIL"}),
]
"""Command lines, and what none of them nor an earlier one imports."""


def test_what_calls_no_command_imports_nothing_heavy():
    code = (
        "import sys\n"
        "from headbench.bench.start import main\n"
        f"for lines, unused in {UNUSED}:\n"
        "  for line in lines:\n"
        "    sys.argv[1:] = line.split()\n"
        "    try: main()\n"
        "    except SystemExit: pass\n"
        "    print('imported', *sorted(unused & set(sys.modules)), 'after', line)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    told = ended.stdout.splitlines()
    every = [line for lines, _ in UNUSED for line in lines]
    assert [line for line in told if line.startswith("imported ")] == [f"imported after {x}" for x in every]
    assert len(told) > 2 * len(every)
    assert "a command of headbench" in ended.stderr
