"""Small files of every format with damage, and faults of readers that the fuzz target has to find."""

import itertools
import json
import os
import signal
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given
from hypothesis import strategies as st

from headbench.bench.errors import InputError

from ..memory import memory_below
from . import __main__ as target
from . import samples
from .readers import SMALL, Exit, Reader
from .watch import Place, forked

CUT, DRAWN = 20_000_000, 300_000_000
"""Bytes that reading a file of some kilobytes may take, Python's and numpy's: one that is cut, and any, which may be packed."""


def replace_by(make):
    def damage(path):
        path.unlink()
        make(path)

    return damage


def cut_to(part):
    return lambda path: os.truncate(path, int(path.stat().st_size * part))


DAMAGE = {
    "missing": lambda path: path.unlink(),
    "a folder": replace_by(Path.mkdir),
    "a pipe": replace_by(os.mkfifo),
    "a link to itself": replace_by(lambda path: path.symlink_to(path)),
    "of another format": lambda path: path.write_bytes(b"solid \xff\xfe\x00 mesh\n" * 20),
    "empty": cut_to(0.0),
    "cut in its first tenth": cut_to(0.1),
    "cut in its middle": cut_to(0.5),
    "cut near its end": cut_to(0.95),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("samples")
    samples.files(folder, folder)
    return folder


@pytest.fixture
def place(files):
    before, place = Path.cwd(), Place(files)
    place.restore()
    os.chdir(place.work)
    yield place
    place.remove()
    os.chdir(before)


def in_a_fork(work):
    """Call in a process of its own, where no other thread disturbs tracemalloc and a crash of a library is a failure."""
    ended, _ = forked(lambda tell: work())
    assert ended == 0, "the process of the test failed, see its messages, or was ended by a signal"


def bounded(read, most):
    """Call a reader; its outcome."""
    with memory_below(most):
        return read()


@pytest.mark.parametrize(
    ("reader", "damage"), [*itertools.product(SMALL, DAMAGE)], ids=lambda x: getattr(x, "name", x)
)
def test_a_damaged_file_is_refused_by_its_name(place, reader, damage):
    path = place.work / reader.file
    reader.read()
    if reader.text and damage.startswith(("empty", "cut")):
        return  # a part of a text, which is sound
    DAMAGE[damage](path)

    def refused():
        with pytest.raises(InputError) as caught, memory_below(CUT):
            reader.read()
        # A model of COLMAP without one of its files is none: the folder is named.
        assert caught.value.file in (reader.file, str(Path(reader.file).parent))
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 2000

    in_a_fork(refused)


@pytest.mark.filterwarnings("ignore")  # of the libraries, about what they refuse
@pytest.mark.parametrize("reader", SMALL, ids=lambda reader: reader.name)
def test_drawn_damage_is_refused_or_harmless(place, reader):
    @hypothesis.settings(max_examples=15, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
    @given(st.data())
    def case(data):
        place.restore()
        hypothesis.note("; ".join(target.damage_sample(reader, place, data.draw)))
        os.chdir(place.work)
        assert bounded(lambda: target.call(reader, place), DRAWN) in ("accepted", "refused")

    in_a_fork(case)


def read():
    try:
        return json.loads(Path("a.json").read_bytes())
    except (ValueError, RecursionError, FileNotFoundError) as error:
        raise InputError("a.json", "", "valid JSON", "none") from error


def refuse(file):
    raise InputError(file, "", "another", "this")


def follow_a_link():
    for path in Path(".").iterdir():
        with path.open("a"):
            pass


def end(code):
    raise Exit(code)


FAULTS = {
    "accepts": (lambda: None, ""),
    "reads": (read, ""),
    "refuses": (lambda: refuse("a.json"), ""),
    "ends with 1": (lambda: end(1), ""),
    "writes inside": (lambda: Path("x").write_text(""), ""),
    "names another file": (lambda: refuse("/etc/passwd"), "names no file of the sample"),
    "fails": (lambda: {}["a"], "KeyError"),
    "crashes": (lambda: end(70), "exit code 70"),
    "prints": (lambda: os.write(1, b"a" * 3000), "3000 characters"),
    "reports": (lambda: os.write(2, b"Traceback (most recent call last)\nKeyError: 1\n"), "KeyError: 1"),
    "fills memory": (lambda: np.ones(4 * 10**7, np.uint8).sum(), "MB of memory"),
    "spins": (lambda: any(itertools.repeat(0)), "ended with -14"),
    "spins in Python": (lambda: [None for _ in iter(int, 1)], "TooSlow"),
    "dies": (lambda: os.kill(os.getpid(), signal.SIGKILL), "ended with -9"),
    "exits": (lambda: sys.exit(3), "SystemExit"),
    "writes outside": (lambda: Path("../outside/x").write_text(""), "a write outside"),
    "makes a folder": (lambda: Path("../outside/x").mkdir(), "a write outside"),
    "follows a link": (follow_a_link, "a write outside"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_reader_is_found(name, tmp_path, monkeypatch):
    for key, value in {"MEMORY": 10**7, "SECONDS": 0.2, "OUTPUT": 2000}.items():
        monkeypatch.setattr(target, key, value)
    (tmp_path / "a.json").write_text(json.dumps({"a": [1, 2.5, "text"], "b": {"c": None}}))
    read, expected = FAULTS[name]
    cases = 200 if name == "follows a link" else 3
    outcomes, finding = target.fuzz(Reader(name, "", read, cases=cases), tmp_path, 0)
    assert bool(finding) == bool(expected)
    assert expected in finding
    assert expected or sum(outcomes.values()) >= 3


def test_a_seed_draws_the_same_cases(files):
    reader = Reader("npz", "files", SMALL[0].read, ("plain.npz",), cases=20)
    assert target.fuzz(reader, files, 5) == target.fuzz(reader, files, 5)
