"""``make kills``: every command that writes, ended before each change of the disk and started again.

A command runs in a forked process that kills itself, with all it started, just before its N-th change: a file opened to
be written, renamed or removed, a folder made. Started again it has to end as an unbroken run does: the same exit code,
no traceback, the same files with the same content, and none beside them. Where time does not suffice for every N, the
first and the last ten come first and then a sample over all; the table states how many of how many.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .cases import Place, changed, load_everything
from .samples import AVATAR, PREPARE, SYNTH, prepare_samples


@dataclass(frozen=True)
class Writer:
    """A command that writes. ``measured`` are patterns of files whose content a machine's speed decides."""

    name: str
    sample: str
    line: str
    measured: tuple[str, ...] = ()


PAGE = "report.html"  # speeds stand on it
MEASURED_FILES = ("measure.json", "points.csv", "pareto.png", "cost.*", PAGE)
MEASURED_TABLES = ("measure.json", "tables/*", "contact_sheet.png", PAGE)
MEASURED_CURVE = ("fit.json", "measure.json", "curve.csv", "curve.png", PAGE)
WRITERS = [
    Writer("synth", "settings", f"synth {SYNTH} --out out"),
    Writer("run", "unfinished", "run --config config.json", (PAGE,)),
    Writer("prepare", "recording", f"{PREPARE} --out out"),
    Writer("record", "synthetic", "record nersemble synthetic/UNION2_900 --out out"),
    Writer("refit", "heads", "refit capture --target head.npz --out out"),
    Writer("evaluate", "images", "evaluate images --like run --out out --label theirs", (PAGE,)),
    Writer(
        "evaluate avatar",
        "run",
        f"evaluate {AVATAR.format('ga')} --avatar --like run --out out",
        MEASURED_FILES,
    ),
    Writer("render", "run", f"render {AVATAR.format('ga')} --capture capture --out out --video", ("*.webm",)),
    Writer("sweep", "run", "sweep run --methods ga --variants half", MEASURED_FILES),
    Writer("curve", "run", "curve run --methods ga --fractions 1/2 1 --frames 1", MEASURED_CURVE),
    Writer("report", "run", "report run --out report.html"),
    Writer("report split", "run", "report run --split"),
    Writer("bundle", "run", "bundle run --out out.zip --by Somebody --renders"),
    Writer("leaderboard", "bundles", "leaderboard build . --out out"),
    Writer("extremes", "run", "extremes run --views 1 --dimensions 1 --methods ga ours"),
    Writer("reenact", "two_subjects", "reenact run --frames 1"),
    Writer("pareto", "run", "pareto run --out out"),
    Writer("speed", "timed", "speed run", MEASURED_TABLES),
    Writer("gate", "baseline", "gate run --baseline baseline.json --junit a.xml --markdown a.md"),
    Writer("gate update", "baseline", "gate run --baseline baseline.json --update"),
    Writer(
        "parity",
        "official",
        "parity ga --checkout repository --python ./python --commit= --device cpu-shim --data capture "
        "--iterations 3 --orders 1 --frames 1 --tolerance 100 --out out",
        ("*.log", PAGE),
    ),
    Writer("compact", "run", f"compact {AVATAR.format('ours')} --out out --compare capture"),
    Writer("export html", "run", f"export html {AVATAR.format('ga')} --out out.html"),
    *(
        Writer(f"export {form}", "run", f"export {form} {AVATAR.format('ga')} --out out.{form}")
        for form in ("glb", "sog")
    ),
    Writer("export ply", "run", f"export ply {AVATAR.format('ga')} --out out.ply"),
    Writer("export colmap", "capture", "export colmap capture --out out"),
    Writer("import ga", "ply", "import ga point_cloud.ply --capture capture --out out"),
    Writer(
        "submission render",
        "benchmark",
        "submission render avatar --method ga --data benchmark --participant 393 --out out",
    ),
    Writer("tongue", "exclusions", "tongue capture --out reviewed"),
    Writer("inspect", "capture", "inspect capture --out out"),
    Writer("steps", "capture", "steps capture --out out"),
    Writer("lint", "capture", "lint capture"),
    Writer("verify", "run", "verify run"),
    Writer(
        "processes",
        "unfinished",
        "run --config config.json --executor processes --workers 1",
        (PAGE, "outcome.json"),
    ),
]


# One command, in the process that runs it.


def start(writer: Writer, place: Place, kill_at: int | None) -> tuple[int | None, int, str]:
    """Run the command in a forked process; its exit code (None: killed), how many changes it made, what it printed.

    ``kill_at`` is the change before which the process kills itself and what it started.
    """
    read, write = os.pipe()
    place.output.seek(0)
    place.output.truncate()
    process = os.fork()
    if process == 0:
        code = 70
        try:
            os.setsid()
            os.chdir(place.work)
            place.isolate(audit=False)
            count = _count(place.work, write, kill_at)
            code = _call(writer.line)
            next(count)  # no change that comes after this is one of the command's
        except BaseException:  # noqa: BLE001 - this process must end here
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        changes = len(pipe.read())
    status = os.waitpid(process, 0)[1]
    place.output.seek(0)
    text = place.output.read().decode(errors="replace")
    return None if os.WIFSIGNALED(status) else os.WEXITSTATUS(status), changes, text


def _call(line: str) -> int:
    from headbench.bench import cli

    try:
        return int(cli.main(line.split()))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def _count(work: Path, pipe: int, kill_at: int | None) -> Iterator[None]:
    """Write a byte for each change under ``work`` from now on until the iterator goes on; kill before ``kill_at``."""
    state = {"count": 0, "watched": True}

    def audit(event: str, arguments: tuple) -> None:
        if not state["watched"]:
            return
        state["watched"] = False
        if any(path.is_relative_to(work) for path in changed(event, arguments)):
            state["count"] += 1
            if state["count"] == kill_at:
                os.killpg(0, signal.SIGKILL)
            os.write(pipe, b".")
        state["watched"] = True

    sys.addaudithook(audit)

    def stop() -> Iterator[None]:
        state["watched"] = False
        yield

    return stop()


# What a command leaves.


TIMES = re.compile(
    "(?i)seconds|interruptions|memory|since|started|finished|time|fingerprint|load|training.json"
)
"""Keys of what depends on the clock and on the machine, and of digests of that."""
MEASURED = "fps|latency_|processor_time|throughput|stage_"
"""Metrics of speed, by how their names begin."""


def tree(place: Place, writer: Writer) -> dict[str, Any]:
    """Content of every file under the folder, of logs and of what is measured only that they are there."""
    found: dict[str, Any] = {}
    for path in sorted(place.work.rglob("*")):
        name = str(path.relative_to(place.work))
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_dir():
            found[name] = "folder"
        elif path.suffix == ".log" or any(path.match(pattern) for pattern in writer.measured):
            found[name] = "file"
        else:
            found[name] = content(path, str(place.work))
    return found


def content(path: Path, work: str) -> Any:
    """What a file holds, without times."""
    data = path.read_bytes()
    try:
        if path.suffix == ".json":
            return json.dumps(_timeless(json.loads(data))).replace(work, "")
        if path.suffix == ".parquet":
            rows = pd.read_parquet(io.BytesIO(data))
            return rows[~rows["metric"].str.match(MEASURED)].to_json()
    except ValueError:
        pass
    return data.replace(work.encode(), b"")


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if not TIMES.search(key)}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def differences(expected: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """Files left behind, missing or of other content."""
    lines = [f"left behind: {name}" for name in found if name not in expected]
    lines += [f"missing: {name}" for name in expected if name not in found]
    return lines + [
        f"differs: {name}" for name in expected if found.get(name, expected[name]) != expected[name]
    ]


# All commands.


class Kills:
    """The kills of one command: what an unbroken run leaves, and the changes still to be tried."""

    def __init__(self, writer: Writer, samples: Path, seed: int, skip: int = 0):
        self.writer, self.place = writer, Place(samples / writer.sample)
        self.findings: list[tuple[int, str]] = []
        self.done = 0
        self.place.restore()
        self.code, self.changes, self.text = start(writer, self.place, None)
        self.expected = tree(self.place, writer)
        self.place.restore()
        code, _, text = start(writer, self.place, None)
        faults = differences(self.expected, tree(self.place, writer))
        if code not in (0, 1) or code != self.code or faults:
            why = "; ".join([*faults[:3], _last(text)])
            self.findings.append((0, f"two unbroken runs: {self.code} and {code}; {why}"))
            self.waiting: list[int] = []  # kills have nothing to be compared with
            return
        every = [*range(1, self.changes + 1)]
        edges = every[:10] + every[-10:]
        rest = [n for n in every if n not in edges]
        order = [*dict.fromkeys(edges), *np.random.default_rng(seed).permutation(rest).tolist()]
        self.waiting = order[skip:]

    def kill(self, number: int) -> None:
        """Kill the command before a change, start it again, and compare."""
        self.place.restore()
        killed, _, text = start(self.writer, self.place, number)
        self.done += 1
        if killed is not None:
            if killed != self.code:
                self.findings.append((number, f"not killed, exit code {killed}: {_last(text)}"))
            return
        code, _, text = start(self.writer, self.place, None)
        faults = differences(self.expected, tree(self.place, self.writer))
        if code != self.code:
            self.findings.append((number, f"exit code {code} instead of {self.code}: {_last(text)}"))
        elif "Traceback (most recent call last)" in text and "Traceback" not in self.text:
            self.findings.append((number, f"a traceback: {_last(text)}"))
        elif faults:
            self.findings.append((number, "; ".join(faults[:3])))


def _last(text: str) -> str:
    return text.strip().splitlines()[-1][:300] if text.strip() else ""


@dataclass(frozen=True)
class Outcome:
    """What became of a command's kills: a finding is the change and what went wrong after it."""

    name: str
    changes: int
    done: int
    findings: list[tuple[int, str]]


def kill_all(
    writers: Sequence[Writer], samples: Path, seed: int, end: float, at: int | None = None, skip: int = 0
) -> list[Outcome]:
    """Kill commands in rounds, one change of each, until all are done or ``end``; those that were not begun are left out."""
    kills: list[Kills] = []
    began = time.monotonic()
    for writer in writers:
        if not kills or time.monotonic() - began < (end - began) / 2:
            kills.append(Kills(writer, samples, seed, skip))
    if at and kills[0].waiting:
        kills[0].kill(at)
    while at is None and any(k.waiting for k in kills) and time.monotonic() < end:
        for k in kills:
            if k.waiting and time.monotonic() < end:
                k.kill(k.waiting.pop(0))
    for k in kills:
        shutil.rmtree(k.place.root)
    return [Outcome(k.writer.name, k.changes, k.done, k.findings) for k in kills]


def describe(outcomes: Sequence[Outcome], left_out: Sequence[str]) -> str:
    """How many changes of how many were tried, then each kind of finding."""
    lines = [f"{'command':<16}{'changes':>9}{'killed':>8}{'findings':>10}"]
    counts = [(o.name, o.changes, o.done, len(o.findings)) for o in outcomes]
    counts.append(("all", *(sum(column) for column in zip(*(count[1:] for count in counts)))))
    lines += [f"{name:<16}{changes:>9}{done:>8}{findings:>10}" for name, changes, done, findings in counts]
    if left_out:
        lines.append(f"no time for: {', '.join(left_out)}")
    for outcome in outcomes:
        kinds: dict[str, list[int]] = {}
        for number, text in outcome.findings:
            kinds.setdefault(re.sub(r"-\w{8}\b", "-*", text), []).append(number)
        for text, numbers in kinds.items():
            shown = ", ".join(map(str, numbers[:10])) + (", ..." if len(numbers) > 10 else "")
            command = f"python -m headbench.tests.fuzz.kills --command '{outcome.name}' --at {numbers[0]}"
            killed = f", killed before {shown}" if numbers[0] else ""
            lines.append(f"\n{outcome.name}{killed}: {text}\n  {command}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--command", action="append", default=[], help="the start of names; default: all")
    parser.add_argument("--at", type=int, help="kill the command before this change only")
    parser.add_argument(
        "--skip", type=int, default=0, help="so many of each command were tried with this seed before"
    )
    parser.add_argument("--samples", type=Path, default=Path("build/fuzz"))
    options = parser.parse_args()
    samples = prepare_samples(options.samples)
    load_everything()
    chosen = [w for w in WRITERS if not options.command or any(w.name.startswith(n) for n in options.command)]
    end = time.monotonic() + options.seconds
    shares = [chosen[index :: options.workers] for index in range(options.workers)]
    shares = [share for share in shares if share]
    with ProcessPoolExecutor(len(shares), multiprocessing.get_context("fork")) as pool:
        jobs = [
            pool.submit(kill_all, share, samples, options.seed, end, options.at, options.skip)
            for share in shares
        ]
        found = {outcome.name: outcome for job in jobs for outcome in job.result()}
    outcomes = [found[writer.name] for writer in chosen if writer.name in found]
    print(describe(outcomes, [writer.name for writer in chosen if writer.name not in found]))
    return 1 if any(outcome.findings for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
