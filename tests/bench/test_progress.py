"""What a waiting person reads: where the work is, and time left only where something is known of it."""

import logging
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time

import pytest

from headbench.bench import progress as module
from headbench.bench.engine import run as runner
from headbench.bench.progress import RunProgress, TasksLeft, TimeLeft, duration

PROGRAM = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell in the background has ignored
from headbench.bench import progress
from headbench.bench.progress import log, log_to_terminal, progress as counted, run_progress
progress.SHOW_EVERY_S = 0
cells = {"s1 ga": {"training": "ga"}, "s2 ga": {"training": "ga"}}
with log_to_terminal(), run_progress(cells) as run, run.step("s1 ga", "training") as report:
    for done in range(1, 9):
        report(done, 8, f"loss {1 / done:.4f}")
    with counted("cells") as cells_done:
        for loss in (2.0, 1.0):
            cells_done(1, 3, "2 running", lambda: {"s3/ga": f"training 5 of 9 (loss {loss})", "s3/gbs": "starting"})
    log.info("a message")
    report(8, 8)
    if sys.argv[1] == "interrupt":
        print("waiting", flush=True)
        time.sleep(60)
print("result")
"""


def on_terminal(end):
    """What a terminal of 100 columns gets from the program, standard output included, and the exit code."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, end], stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    got, until, interrupted = b"", time.monotonic() + 60, False
    while time.monotonic() < until:
        if not select.select([ours], [], [], 1.0)[0]:
            continue
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        got += part
        if b"waiting" in got and not interrupted:
            interrupted = True
            process.send_signal(signal.SIGINT)
    os.close(ours)
    return got.decode(), process.wait(60)


def screen(text):
    """The lines that a terminal shows in the end; follows the few sequences that the display uses."""
    lines, row = [""], 0
    for part in text.replace("\x1b", "\0\x1b").split("\0"):
        rest = part
        if part.startswith("\x1b["):
            length = next(i for i, c in enumerate(part[2:], 2) if c.isalpha()) + 1
            code, rest = part[2:length], part[length:]
            if code.endswith("A"):
                row -= int(code[:-1] or 1)
            elif code == "2K":
                lines[row] = ""
            else:
                raise AssertionError(code)
        for char in rest:
            if char == "\n":
                row += 1
                lines += [""] * (row + 1 - len(lines))
            elif char != "\r":
                lines[row] += char
    return [line for line in lines if line]


@pytest.mark.parametrize(
    ("end", "code", "left"), [("well", 0, ["a message", "result"]), ("interrupt", -2, None)]
)
def test_a_terminal_has_one_display_that_goes(end, code, left):
    text, ended = on_terminal(end)
    assert ended == code
    assert "avatar 1 of 2" in text
    assert "s1 ga: training 8 of 8" in text
    assert "cells: 1 of 3 (2 running)\r\n  s3/ga: training 5 of 9 (loss 1.0)\r\n" in text
    assert "\x1b[?25" not in text  # the cursor is never hidden, so none has to be shown again
    shown = screen(text)
    assert shown[0] == "a message"
    assert left in (None, shown)
    assert not [line for line in shown if "avatar 1 of 2" in line]


def test_a_pipe_gets_no_control_characters():
    ended = subprocess.run([sys.executable, "-c", PROGRAM, "well"], check=True, capture_output=True)
    assert (ended.stderr, ended.stdout) == (b"a message\n", b"result\n")


class Clock:
    """Seconds that pass when they are told to."""

    now = 1000.0

    def __call__(self):
        return self.now

    def passes(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(module.time, "monotonic", made)
    return made


@pytest.fixture
def lines(monkeypatch):
    """The lines logged, each as soon as there is something to show."""
    monkeypatch.setattr(module, "LOG_EVERY_S", 0.0)
    logged = []
    handler = logging.Handler()
    handler.emit = lambda record: logged.append(record.getMessage())
    root = logging.getLogger("headbench")
    monkeypatch.setattr(root, "level", logging.INFO)
    monkeypatch.setattr(root, "handlers", [handler])
    return logged


def progress_of(cells, lines):
    return RunProgress(cells, lambda position: lines.append(position().text))


def work(clock, report, total, seconds, start=0, note=""):
    for done in range(start + 1, total + 1):
        clock.passes(seconds)
        report(done, total, note)


@pytest.mark.parametrize(
    ("waits", "steps", "left"),
    [
        ([], 1500, None),
        ([100.0], 1500, None),  # a long preparation before the first step says nothing of the steps
        ([100.0, 0.1], 1500, None),
        ([0.0, 10.0], 1500, 1498 * 10.0),
        ([100.0, *[2.0] * 9], 1500, 1490 * 2.0),
        ([*[1.0] * 100, *[5.0] * 100], 1000, 800 * 5.0),  # the last while counts
    ],
)
def test_time_left_follows_from_steps_alone(clock, waits, steps, left):
    found = TimeLeft()
    for done, wait in enumerate(waits, start=1):
        clock.passes(wait)
        found.step(done, steps)
    assert found.seconds == (None if left is None else pytest.approx(left))


def test_time_left_of_tasks_follows_from_those_that_ended(clock):
    left = TasksLeft({"baseline": 0.5, "a": 1.0, "b": 1.0, "c": 1.0, "d": 0.5})
    left.running(["baseline", "a"])
    clock.passes(5.0)
    left.end("baseline")
    left.running(["a", "b"])
    assert left.seconds is None  # baselines say little
    clock.passes(5.0)
    left.end("a")  # so that a whole task takes 10 seconds
    left.running(["b", "c"])
    assert left.seconds == pytest.approx((5 + 10 + 5) / 2)
    clock.passes(5.0)
    left.end("b")
    left.running(["c"])
    assert left.seconds == pytest.approx(5 + 5)
    clock.passes(100.0)
    assert left.seconds == 5.0


def cells(*names, stages=("training", "rendering")):
    return {f"{subject} {method}": dict.fromkeys(stages, method) for subject, method in names}


def test_a_run_has_a_bound_until_all_of_it_has_a_basis(clock, lines):
    run = progress_of(cells(("s1", "ga"), ("s1", "ours"), ("s2", "ga"), ("s2", "ours")), lines)
    seconds = {"training": {"ga": 10.0, "ours": 20.0}, "rendering": {"ga": 1.0, "ours": 2.0}}
    for cell in ("s1 ga", "s1 ours", "s2 ga", "s2 ours"):
        for stage in ("training", "rendering"):
            with run.step(cell, stage) as report:
                work(clock, report, 10, seconds[stage][cell[3:]])
    assert [line for line in lines if re.search("ing 5 of", line)] == [
        "avatar 1 of 4 (s1 ga): training 5 of 10, more than 50 s left",
        "avatar 1 of 4 (s1 ga): rendering 5 of 10, more than 1 min 40 s left",
        "avatar 2 of 4 (s1 ours): training 5 of 10, more than 3 min 30 s left",
        "avatar 2 of 4 (s1 ours): rendering 5 of 10, more than 5 min 20 s left",
        "avatar 3 of 4 (s2 ga): training 5 of 10, 4 min 40 s left",
        "avatar 3 of 4 (s2 ga): rendering 5 of 10, 3 min 45 s left",
        "avatar 4 of 4 (s2 ours): training 5 of 10, 2 min 00 s left",
        "avatar 4 of 4 (s2 ours): rendering 5 of 10, 10 s left",
    ]
    assert lines[0] == "avatar 1 of 4 (s1 ga): training"


@pytest.mark.parametrize("subjects", [("subject1", "subject2")])
def test_a_run_names_its_cells_in_order(config, lines):
    runner.run(config)
    steps = ("training 2 of 2", "rendering 5 of 5", "measuring novel_view 3 of 3", "measuring the avatar")
    for step in steps:
        assert any(
            line.startswith(f"avatar 2 of 2 (toy, subject subject2, seed 0): {step}") for line in lines
        ), step
    lines.clear()
    runner.run(config)
    assert not [line for line in lines if line.startswith("avatar")]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (190, "3 min 10 s"), (7500, "2 h 05 min")]
)
def test_durations_are_written_as_people_read_them(seconds, text):
    assert duration(seconds) == text
