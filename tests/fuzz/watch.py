"""What `make fuzz` and `make kills` share: a copy of a sample to work in, processes that may end, and writes that are seen."""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import shutil
import stat
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

EVENTS = {
    "open": (0,),
    **dict.fromkeys(("os.mkdir", "os.rmdir", "os.remove", "os.truncate", "os.chmod"), (0,)),
    **dict.fromkeys(("os.rename", "os.link"), (0, 1)),
    "os.symlink": (1,),
}
"""Events of Python's audit that change the disk, and which of their arguments are paths."""
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def changed(event: str, arguments: tuple) -> list[Path]:
    """Where an event of Python's audit is about to change the disk, links followed; nowhere, for most."""
    if event not in EVENTS or (event == "open" and not (arguments[2] or 0) & WRITES):
        return []
    paths = []
    for name in (arguments[position] for position in EVENTS[event]):
        if isinstance(name, (str, bytes, os.PathLike)):
            path = Path(os.fsdecode(name))
            follows = event == "open" and not arguments[2] & os.O_NOFOLLOW
            paths.append(
                Path(os.path.realpath(path if follows else path.parent)) / ("" if follows else path.name)
            )
    return paths


def on_change(act: Callable[[Path], None]) -> None:
    """Call ``act`` with each place of this process's disk changes, before they happen, for the rest of its life."""
    busy = False

    def audit(event: str, arguments: tuple) -> None:
        nonlocal busy
        if not busy and event in EVENTS:
            busy = True  # what `act` does is not seen
            for path in changed(event, arguments):
                act(path)
            busy = False

    sys.addaudithook(audit)


class Place:
    """A copy of a sample (``work``) beside a folder that nothing may be written to (``outside``), and what is printed."""

    def __init__(self, sample: Path):
        self.sample = sample
        self.root = Path(tempfile.mkdtemp(prefix="headbench-fuzz-")).resolve()
        self.work, self.outside, self.own = (self.root / name for name in ("work", "outside", "own"))
        self.own.mkdir()
        self.output = (self.root / "output").open("w+b", buffering=0)
        self.content = sorted(sample.rglob("*"))
        self.known: dict[str, tuple] = {}
        self.watching, self.wrote = False, ""

    def restore(self) -> None:
        """Bring the copy back to what the sample is, and what is printed to nothing."""
        os.chdir(self.root)
        self.output.seek(0)
        self.output.truncate()
        shutil.rmtree(self.outside, ignore_errors=True)
        self.outside.mkdir()
        self.work.mkdir(exist_ok=True)
        found = set()
        for folder, folders, files in os.walk(self.work, topdown=False):
            for path in (os.path.join(folder, name) for name in (*files, *folders)):
                if self.known.get(path) == _state(path):
                    found.add(path)
                elif os.path.isdir(path) and not os.path.islink(path):
                    shutil.rmtree(path)
                else:
                    os.unlink(path)
        for source in self.content:
            path = str(self.work / source.relative_to(self.sample))
            if path not in found:
                os.mkdir(path) if source.is_dir() else shutil.copy2(source, path)
                self.known[path] = _state(path)

    def isolate(self) -> None:
        """Make this process print and cache here, for the rest of its life."""
        os.environ["XDG_CACHE_HOME"] = os.environ["TMPDIR"] = str(self.own)
        tempfile.tempdir = None
        for number in (1, 2):
            os.dup2(self.output.fileno(), number)
        os.chdir(self.work)

    def note(self, path: Path) -> None:
        """Note a change of the disk that is not here, while this place is watched."""
        places = (self.work, self.own, Path("/proc"), Path(os.devnull))
        if self.watching and not any(path.is_relative_to(place) for place in places):
            self.wrote = str(path)

    def text(self) -> str:
        """What was printed since the last `restore`."""
        sys.stdout.flush()
        sys.stderr.flush()
        self.output.seek(0)
        return self.output.read().decode(errors="replace")

    def remove(self) -> None:
        """Remove all of it."""
        os.chdir("/")
        self.output.close()
        shutil.rmtree(self.root, ignore_errors=True)


def _state(path: str) -> tuple:
    found = os.lstat(path)
    if stat.S_ISDIR(found.st_mode):
        return (found.st_mode,)
    return (found.st_mode, found.st_size, found.st_mtime_ns, found.st_ino)


def forked(work: Callable[[Callable[[Any], None]], None]) -> tuple[int, list[Any]]:
    """Run a function in a forked process and group of its own.

    Returns
    -------
    tuple
        How the process ended (an exit code, 70 after an exception, or minus the signal), and the values of JSON that the
        function gave to its argument.
    """
    read, write = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            os.setsid()
            work(lambda value: _ignored(os.write(write, json.dumps(value).encode() + b"\n")))
            os._exit(0)
        except BaseException:  # noqa: BLE001 - this process must end here
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(70)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        values = [json.loads(line) for line in pipe]
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), values


def _ignored(_: Any) -> None: ...


def load_everything() -> None:
    """Import what the commands import, once for all processes that are forked from this one; no threads may start."""
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    root = Path(__file__).parents[2]
    for package in ("bench", "datasets", "methods", "metrics", "reports"):
        for path in sorted((root / package).rglob("*.py")):
            importlib.import_module(".".join(("headbench", *path.relative_to(root).with_suffix("").parts)))


def options_of(description: str) -> argparse.ArgumentParser:
    """The options that both targets have."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    return parser


def in_shares(names: Sequence[str], workers: int, work: Callable[..., Any], *arguments: Any) -> list[Any]:
    """Call ``work`` in each of the forked workers with its share of the names; the results."""
    load_everything()
    shares = [share for share in (names[index::workers] for index in range(workers)) if share]
    with ProcessPoolExecutor(len(shares), multiprocessing.get_context("fork")) as pool:
        jobs = [pool.submit(work, share, *arguments) for share in shares]
        return [job.result() for job in jobs]
