"""Faults that are put into readers on purpose are found, each as what it is; sound ones are not."""

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.errors import InputError

from . import cases
from .mutations import change_tree
from .targets import Target

MEMORY = 10**7


def read():
    try:
        return json.loads(Path("a.json").read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError("a.json", "", "valid JSON", "none") from error


def refuse():
    raise InputError("a.json", "", "another", "this")


def fill_memory():
    np.ones(4 * MEMORY, np.uint8).sum()


def spin():
    while True:
        pass


def follow_a_link():
    for path in Path(".").iterdir():
        with path.open("a"):
            pass


READERS = {
    "accepts": (lambda: None, {"accepted"}, ""),
    "reads": (read, {"accepted", "refused"}, ""),
    "refuses": (refuse, {"refused"}, ""),
    "fails": (lambda: {}["a"], {"finding"}, "KeyError"),
    "prints": (lambda: os.write(1, b"a" * 3000), {"finding"}, "printed 3000 characters"),
    "reports": (
        lambda: os.write(2, b"Traceback (most recent call last)\nKeyError: 1\n"),
        {"finding"},
        "KeyError: 1",
    ),
    "fills memory": (fill_memory, {"finding"}, "memory"),
    "spins": (spin, {"finding"}, "TooSlow"),
    "dies": (lambda: os.kill(os.getpid(), signal.SIGKILL), {"finding"}, "signal 9"),
    "exits": (lambda: sys.exit(3), {"finding"}, "SystemExit"),
    "writes outside": (lambda: Path("../outside/x").write_text(""), {"finding"}, "wrote outside: open /"),
    "makes a folder": (lambda: Path("../outside/x").mkdir(), {"finding"}, "wrote outside: os.mkdir"),
    "writes inside": (lambda: Path("x").write_text(""), {"accepted"}, ""),
}


@pytest.fixture
def samples(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "MEMORY", MEMORY)
    monkeypatch.setattr(cases, "SECONDS", 0.2)
    monkeypatch.setattr(cases, "OUTPUT", 2000)
    (tmp_path / "sample").mkdir()
    (tmp_path / "sample" / "a.json").write_text(json.dumps({"a": [1, 2.5, "text"], "b": {"c": None}}))
    return tmp_path


@pytest.mark.parametrize("name", READERS)
def test_an_outcome_is_what_the_reader_does(name, samples):
    reader, outcomes, detail = READERS[name]
    tallies, findings = cases.run([Target(name, "sample", reader)], samples, 0, 3, 60.0, 2)
    assert set(tallies[name].outcomes) <= outcomes
    assert tallies[name].outcomes.total() == 3
    assert all(detail in finding["detail"] for _, finding in findings)


def test_writing_through_a_link_is_found(samples):
    findings = cases.run([Target("link", "sample", follow_a_link)], samples, 0, 400, 60.0, 2)[1]
    assert findings
    assert all(finding["detail"].startswith("wrote outside: open /") for _, finding in findings)


def test_a_case_is_the_same_each_time(samples):
    def damaged(root):
        work, outside = root / "work", root / "outside"
        outside.mkdir(parents=True)
        work.mkdir()
        (work / "a.json").write_bytes((samples / "sample" / "a.json").read_bytes())
        how = cases.damage(work, outside, Target("x", "sample", read), 1, 7)
        return how, (work / "a.json").read_bytes()

    assert damaged(samples / "one") == damaged(samples / "other")


def test_every_change_of_a_tree_is_one_that_json_can_write():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        json.dumps(change_tree({"a": [1, 2.5, "text"], "b": {"c": None, "d": True}}, rng), default=repr)
