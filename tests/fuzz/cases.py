"""Cases: a sample with damaged files is given to a reader, in a process of its own that is watched.

A reader has to accept an input or to refuse it with an `InputError` or an exit code that is documented. Findings are
all else: another exception, a traceback on standard error, more than 1 GB, more than 20 s, a write outside the folder
that the reader works in, an end by a signal, pages of output.

Cases run in forked processes, a batch in each. A case is drawn from the seed, its target's name and its number alone.
"""

from __future__ import annotations

import ctypes
import itertools
import json
import os
import re
import resource
import select
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from headbench.bench.errors import HeadbenchError

from .mutations import mutate

SECONDS = 20.0
"""Processor time that a case may take."""
HANGS_AFTER = 120.0
"""Seconds by the clock after which a case is ended."""
MEMORY = 10**9
"""Bytes that a case may take on top of what the process has before."""
OUTPUT = 100_000
"""Characters that a case may print."""
BATCH = 100
TOTAL = 20_000


@dataclass
class Tally:
    """Outcomes of a target's cases."""

    outcomes: Counter = field(default_factory=Counter)
    seconds: float = 0.0
    memory: int = 0
    took: float = 0.0


@dataclass
class Result:
    """What became of a case: ``took`` in seconds, ``memory`` in bytes, ``text`` is what it printed."""

    case: int
    outcome: str
    detail: str = ""
    how: list[str] = field(default_factory=list)
    took: float = 0.0
    memory: int = 0
    text: str = ""


class ExitCode(Exception):
    """A command ended with a code other than 0."""


class TooSlow(BaseException):
    """A case took too much processor time."""


# One case, in the process that runs it.


def damage(work: Path, outside: Path, target: Any, seed: int, case: int) -> list[str]:
    """Damage the files of a case; return which and how."""
    rng = np.random.default_rng([seed, zlib.crc32(target.name.encode()), case])
    groups = defaultdict(list)
    for path in sorted({path for pattern in target.files for path in work.glob(pattern) if path.is_file()}):
        # Of many files of a kind, such as images, no more are drawn than of one that is alone.
        groups[re.sub(r"\d+", "#", f"{path.parent.name}/{path.name}")].append(path)
    kinds = [groups[name] for name in sorted(groups)]
    done = []
    for _ in range(1 if rng.random() < 0.8 else int(rng.integers(2, 4))):
        files = kinds[rng.integers(len(kinds))]
        path = files[rng.integers(len(files))]
        if path.is_file() and not path.is_symlink() and path.parent.resolve().is_relative_to(work):
            done.append(f"{path.relative_to(work)}: {mutate(path, outside, rng)}")
    return done


def run_case(target: Any, place: Place, seed: int, case: int) -> dict[str, Any]:
    """Run a case; return its outcome."""
    place.restore()
    how = damage(place.work, place.outside, target, seed, case)
    os.chdir(place.work)
    place.output.seek(0)
    place.output.truncate()
    getattr(ctypes.CDLL(None), "malloc_trim", int)(
        0
    )  # what is free would be used again without being counted
    Path("/proc/self/clear_refs").write_text("5")  # start the peak of memory afresh
    before, start = _status("VmRSS"), time.process_time()
    outcome, detail, code = "accepted", "", 0
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    place.watched = True
    try:
        target.read()
    except ExitCode as end:
        code = end.args[0]
        outcome = {1: "exit 1", 2: "refused", 3: "refused"}.get(code, "finding")
    except HeadbenchError:
        outcome = "refused"
    except OSError as error:  # which the command line reports in one line
        outcome, detail = ("refused", "") if error.errno else ("finding", f"{_where(error)} {error}"[:300])
    except BaseException as error:  # noqa: BLE001 - whatever it is, it is what is looked for
        outcome, detail = "finding", f"{_where(error)} {type(error).__name__}: {error}"[:300]
        traceback.print_exc()
    finally:
        place.watched = False
        signal.setitimer(signal.ITIMER_PROF, 0)
    took, memory = time.process_time() - start, _status("VmHWM") - before
    sys.stdout.flush()
    sys.stderr.flush()
    place.output.seek(0)
    text = place.output.read().decode(errors="replace")
    if not detail:
        if "Traceback (most recent call last)" in text:
            detail = f"traceback printed: {_last_error(text)}"
        elif outcome == "finding":
            detail = f"exit code {code}"
        elif len(text) > OUTPUT:
            detail = f"printed {len(text)} characters"
        elif memory > MEMORY:
            detail = f"memory: {memory / 1e6:.0f} MB"
        elif place.wrote:
            detail = f"wrote outside: {place.wrote}"
    if detail:
        outcome = "finding"
    place.wrote = ""
    return asdict(Result(case, outcome, detail, how, took, memory, text))


def _where(error: BaseException) -> str:
    """The innermost place of ours that an exception passed."""
    others = ("/tests/fuzz/", "site-packages", "/lib/python")
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if not any(part in frame.filename for part in others)]
    return f"{'/'.join(Path(ours[-1].filename).parts[-2:])}:{ours[-1].lineno}" if ours else ""


def _last_error(text: str) -> str:
    """Place and message at the end of the last traceback in what was printed."""
    lines = text[text.rindex("Traceback (most recent call last)") :].splitlines()[1:]
    stack = list(itertools.takewhile(lambda line: line.startswith(" "), lines))
    ours = "\n".join(line for line in stack if "/lib/python" not in line)
    place = (["", *map(":".join, re.findall(r'(\w+/\w+\.py)", line (\d+)', ours))])[-1]
    return f"{place} {''.join(lines[len(stack) : len(stack) + 1])}"[:300]


def _status(name: str) -> int:
    """A size from the kernel's record of this process, bytes."""
    with open("/proc/self/status") as stream:
        return next(int(line.split()[1]) * 1024 for line in stream if line.startswith(f"{name}:"))


class Place:
    """Where the cases of a worker run: a copy of the sample, a folder outside, and what is printed."""

    def __init__(self, sample: Path):
        self.sample = sample
        self.root = Path(tempfile.mkdtemp(prefix="headbench-fuzz-")).resolve()
        self.work, self.outside, self.own = (self.root / name for name in ("work", "outside", "own"))
        self.own.mkdir()
        self.output = (self.root / "output").open("w+b", buffering=0)
        self.content = sorted(sample.rglob("*"))
        self.known: dict[str, tuple] = {}
        self.watched, self.wrote = False, ""

    def restore(self) -> None:
        """Bring the copy back to what the sample is."""
        os.chdir(self.root)
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

    def isolate(self, *, audit: bool = True) -> None:
        """Make this process print and cache here and, by default, note what it writes elsewhere."""
        os.environ["XDG_CACHE_HOME"] = os.environ["TMPDIR"] = str(self.own)
        tempfile.tempdir = None
        for number in (1, 2):
            os.dup2(self.output.fileno(), number)
        if audit:
            sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple) -> None:
        if not self.watched or event not in EVENTS:
            return
        self.watched = False  # what follows opens nothing, and must not end here again
        for path in changed(event, arguments):
            places = (self.work, self.own, Path("/proc"), Path(os.devnull))
            if not any(path.is_relative_to(place) for place in places):
                self.wrote = f"{event} {path}"
        self.watched = True


def changed(event: str, arguments: tuple) -> list[Path]:
    """Where an event of Python's audit is about to change the disk, links followed; nowhere, for most."""
    if event not in EVENTS or (event == "open" and not (arguments[2] or 0) & WRITES):
        return []
    paths = []
    for position in EVENTS[event]:
        name = arguments[position]
        if isinstance(name, (str, bytes, os.PathLike)):
            path = Path(os.fsdecode(name))
            follows = event == "open" and not arguments[2] & os.O_NOFOLLOW
            real = os.path.realpath(path if follows else path.parent)
            paths.append(Path(real) if follows else Path(real) / path.name)
    return paths


EVENTS = {
    "open": (0,),
    **dict.fromkeys(("os.mkdir", "os.rmdir", "os.remove", "os.truncate", "os.chmod"), (0,)),
    **dict.fromkeys(("os.rename", "os.link"), (0, 1)),
    "os.symlink": (1,),
}
"""Events that change the disk, and which of their arguments are paths."""
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def _state(path: str) -> tuple:
    found = os.lstat(path)
    if stat.S_ISDIR(found.st_mode):
        return (found.st_mode,)
    return (found.st_mode, found.st_size, found.st_mtime_ns, found.st_ino)


# Batches of cases in forked processes.


def load_everything() -> None:
    """Import what the readers import, once for all processes that are forked from this one; no threads may start."""
    import functools
    import importlib
    import importlib.metadata

    import cv2
    import torch

    from headbench.bench import registry

    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    # The entry points do not change while this runs, and reading them takes longer than most cases.
    registry.entry_points = functools.cache(importlib.metadata.entry_points)  # type: ignore[attr-defined]
    registry._origin = functools.cache(registry._origin)  # type: ignore[attr-defined]
    root = Path(__file__).parents[2]
    for package in ("bench", "datasets", "methods", "metrics", "reports"):
        for path in sorted((root / package).rglob("*.py")):
            importlib.import_module(".".join(("headbench", *path.relative_to(root).with_suffix("").parts)))
    from . import targets  # noqa: F401


class Batch:
    """Some cases of a target in a forked process."""

    def __init__(self, target: Any, cases: Sequence[int], samples: Path, seed: int):
        self.target, self.cases = target, list(cases)
        self.place = Place(samples / target.sample)
        self.started = time.monotonic()
        self.buffer = b""
        read, write = os.pipe()
        self.process = os.fork()
        if self.process == 0:
            os.close(read)
            try:
                self._run(write, seed)
            except BaseException:  # noqa: BLE001 - this process must end here
                traceback.print_exc()
            os._exit(0)
        os.close(write)
        self.pipe = read

    def _run(self, pipe: int, seed: int) -> None:
        signal.signal(signal.SIGPROF, _too_slow)
        limit = _status("VmSize") + 8 * MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.dont_write_bytecode = True
        self.place.isolate()
        self.place.restore()
        os.chdir(self.place.work)
        for case in self.cases:
            os.write(pipe, json.dumps(run_case(self.target, self.place, seed, case)).encode() + b"\n")

    def results(self) -> list[dict[str, Any]]:
        """What has ended since the last call."""
        self.buffer += os.read(self.pipe, 1 << 20)
        *lines, self.buffer = self.buffer.split(b"\n")
        found = [json.loads(line) for line in lines]
        for result in found:
            self.cases.remove(result["case"])
            self.started = time.monotonic()
        return found

    def stop(self, why: str) -> dict[str, Any] | None:
        """End the process; the outcome of the case that it was in, if it was in one."""
        with suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        status = os.waitpid(self.process, 0)[1]
        os.close(self.pipe)
        text = (self.place.root / "output").read_text(errors="replace")
        self.place.output.close()
        shutil.rmtree(self.place.root, ignore_errors=True)
        if not self.cases:
            return None
        if not why:
            ended = f"ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else "ended"
            why = f"{ended}: {_last_error(text)}" if "Traceback (most" in text else ended
        return asdict(Result(self.cases.pop(0), "finding", why, text=text))


def _too_slow(*_: Any) -> None:
    raise TooSlow(f"more than {SECONDS:g} s of processor time")


def plan(targets: Sequence[Any], total: int) -> Iterator[tuple[Any, range]]:
    """Batches in rounds over all targets, so that a run that is short meets each of them."""
    whole = sum(target.share for target in targets)
    left = {target.name: max(1, round(target.share * total / whole)) for target in targets}
    rounds = max(1, -(-max(left.values()) // BATCH))
    done = dict.fromkeys(left, 0)
    for index in range(1, rounds + 1):
        for target in targets:
            end = -(-left[target.name] * index // rounds)
            if end > done[target.name]:
                yield target, range(done[target.name], end)
                done[target.name] = end


def run(
    targets: Sequence[Any], samples: Path, seed: int, total: int, seconds: float, workers: int
) -> tuple[dict[str, Tally], list[tuple[str, dict[str, Any]]]]:
    """Run cases until all are done or time is up; tallies by target, and findings."""
    tallies: dict[str, Tally] = {target.name: Tally() for target in targets}
    findings: list[tuple[str, dict[str, Any]]] = []
    waiting, running = plan(targets, total), list[Batch]()
    retry: list[tuple[Any, list[int]]] = []
    end = time.monotonic() + seconds

    def note(batch: Batch, result: dict[str, Any]) -> None:
        tally = tallies[batch.target.name]
        tally.outcomes[result["outcome"]] += 1
        tally.took = max(tally.took, result["took"])
        tally.seconds += result["took"]
        tally.memory = max(tally.memory, result["memory"])
        if result["outcome"] == "finding":
            findings.append((batch.target.name, result))

    while True:
        while len(running) < workers and time.monotonic() < end:
            target, cases = retry.pop() if retry else next(waiting, (None, []))
            if target is None:
                break
            running.append(Batch(target, cases, samples, seed))
        if not running:
            return tallies, findings
        ready = select.select([batch.pipe for batch in running], [], [], 1.0)[0]
        for batch in list(running):
            closed, why = False, ""
            if batch.pipe in ready:
                size = len(batch.buffer)
                found = batch.results()
                closed = not found and len(batch.buffer) == size
                for result in found:
                    note(batch, result)
            elif time.monotonic() - batch.started > HANGS_AFTER:
                closed, why = True, f"no end after {HANGS_AFTER:g} s"
            if time.monotonic() > end and not closed and batch.cases:
                batch.cases.clear()
                closed = True
            if closed:
                last = batch.stop(why)
                running.remove(batch)
                if last is not None:
                    note(batch, last)
                if batch.cases:
                    retry.append((batch.target, batch.cases))
