"""The live display: under a real terminal it appears and leaves nothing behind, however the work ends."""

import os
import pty
import select
import signal
import subprocess
import sys
import time

import pytest

PROGRAM = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell in the background has ignored
from headbench.bench import progress, live
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
