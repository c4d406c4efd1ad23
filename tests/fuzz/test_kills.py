"""Commands that do not go on after a kill are found, each as what it is; those that do are not."""

import os
from pathlib import Path

import pytest

from . import kills


def whole():
    """Writes each file whole, or keeps what is there, and removes what it left."""
    for left in Path(".").glob(".?.txt-*"):
        left.unlink()
    for name in ("a.txt", "b.txt"):
        partial = Path(f".{name}-partial")
        partial.write_text(name)
        partial.rename(name)


def leaves_a_file():
    partial = Path(f".a-{os.getpid():08}")
    partial.write_text("a")
    partial.rename("a.txt")


def refuses():
    if Path("a.txt").exists():
        os.write(2, b"headbench: a.txt is there\n")
        return 2
    Path("a.txt").write_text("a")
    Path("b.txt").write_text("b")
    return 0


def keeps_half():
    for name in ("a.txt", "b.txt"):
        if not Path(name).exists():
            with Path(name).open("w") as stream:
                stream.write("1")
                stream.flush()
                Path("c.txt").write_text("")
                stream.write("2")


def differs():
    Path("a.txt").write_bytes(os.urandom(8))


def fails():
    Path("a.txt").write_text("a")
    os.write(2, b"headbench: there is no capture\n")
    return 2


COMMANDS = {
    "whole": (whole, ""),
    "leaves a file": (leaves_a_file, "left behind: .a-"),
    "refuses": (refuses, "exit code 2 instead of 0: headbench: a.txt is there"),
    "keeps half": (keeps_half, "differs: a.txt"),
    "differs": (differs, "a second unbroken run: differs: a.txt"),
    "fails": (fails, "an unbroken run: exit code 2: headbench: there is no capture"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_command_leaves_is_found(name, tmp_path, monkeypatch):
    command, expected = COMMANDS[name]
    monkeypatch.setattr(kills, "call", lambda line: command() or 0)
    (tmp_path / "sample").mkdir()
    tried = kills.Kills(kills.Writer(name, "sample", ""), tmp_path, 0)
    while tried.waiting:
        tried.kill(tried.waiting.pop(0))
    assert tried.changes > 0
    assert tried.done == (0 if "unbroken" in expected else tried.changes)
    found = " ".join(text for _, text in tried.findings)
    assert bool(found) == bool(expected)
    assert expected in found
