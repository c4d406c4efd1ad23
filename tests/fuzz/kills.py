"""``make kills``: every command that writes, ended before each change of the disk and started again.

A command runs in a forked process that kills itself, with all it started, just before its N-th change: a file opened to
be written, renamed or removed, a folder made. Started again it has to end as an unbroken run does: the same exit code,
no traceback, the same files with the same content, and none beside them. Where time does not suffice for every N, the
first and the last ten come first and then a sample over all; the table states how many of how many.
"""

from __future__ import annotations

import io
import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from headbench.bench import cli

from .samples import GA, OURS, PREPARE, SYNTH, prepare_samples
from .watch import Place, forked, in_shares, on_change, options_of


class Writer(NamedTuple):
    """A command that writes. ``measured`` are patterns of files whose content a machine's speed decides."""

    name: str
    sample: str
    line: str
    measured: tuple[str, ...] = ()


PAGE = "report.html"  # speeds stand on it
MEASURED_FILES = ("measure.json", "points.csv", "pareto.png", "cost.*", PAGE)
MEASURED_TABLES = ("measure.json", "tables/*", "contact_sheet.png", PAGE)
MEASURED_CURVE = ("fit.json", "measure.json", "curve.csv", "curve.png", PAGE)
PARITY = "run parity ga --checkout repository --python ./python --commit= --device cpu-shim --data capture"
SUBMISSION = f"submission render {GA} --method ga --data benchmark --participant 393 --out out"
PROCESSES = "run --config config.json --executor processes --workers 1"
WRITERS = [
    Writer("synth", "files", f"synth {SYNTH} --out out"),
    Writer("run", "unfinished", "run --config config.json", (PAGE,)),
    Writer("prepare", "recording", f"{PREPARE} --out out"),
    Writer("record", "synthetic", "export nersemble synthetic/UNION2_900 --out out"),
    Writer("refit", "heads", "prepare refit capture --target head.npz --out out"),
    Writer("evaluate", "run", "evaluate images --like run --out out --label theirs", (PAGE,)),
    Writer("evaluate avatar", "run", f"evaluate {GA} --avatar --like run --out out", MEASURED_FILES),
    Writer("render", "run", f"render {GA} --capture capture --out out --video", ("*.webm",)),
    Writer("sweep", "run", "run sweep run --methods ga --variants half", MEASURED_FILES),
    Writer("curve", "run", "run curve run --methods ga --fractions 1/2 1 --frames 1", MEASURED_CURVE),
    Writer("report", "run", "report run --out report.html"),
    Writer("report split", "run", "report run --split"),
    Writer("bundle", "run", "bundle run --out out.zip --by Somebody --renders"),
    Writer("leaderboard", "run", "report leaderboard bundles --out out"),
    Writer("extremes", "run", "run extremes run --views 1 --samples 1 --path 0 --methods ga ours"),
    Writer("reenact", "two_subjects", "run reenact run --frames 1"),
    Writer("pareto", "run", "report pareto run --out out"),
    Writer("speed", "timed", "run speed run", MEASURED_TABLES),
    Writer("gate", "run", "compare run --baseline baseline.json --junit a.xml --markdown a.md"),
    Writer("gate update", "run", "compare run --baseline baseline.json --update"),
    Writer(
        "parity",
        "official",
        f"{PARITY} --iterations 3 --orders 1 --frames 1 --tolerance 100 --out out",
        ("*.log", PAGE),
    ),
    Writer("compact", "run", f"export compact {OURS} --out out --compare capture"),
    *(Writer(f"export {x}", "run", f"export {x} {GA} --out out.{x}") for x in ("html", "glb", "sog", "ply")),
    Writer("export colmap", "capture", "export colmap capture --out out"),
    Writer("import ga", "run", f"import ga {GA}/point_cloud.ply --capture capture --out out"),
    Writer("submission render", "run", SUBMISSION),
    Writer("tongue", "heads", "prepare tongue capture --out reviewed"),
    *(Writer(name, "capture", f"{name} capture --out out") for name in ("inspect", "inspect steps")),
    Writer("lint", "capture", "lint capture"),
    Writer("verify", "run", "verify run"),
    Writer("verify out", "run", "verify run --out out"),
    Writer("processes", "unfinished", PROCESSES, (PAGE, "outcome.json")),
]


def call(line: str) -> int:
    """Run a command line; its exit code."""
    try:
        return int(cli.main(line.split()))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def start(writer: Writer, place: Place, kill_at: int | None = None) -> tuple[int, int]:
    """Run the command in a forked process; how it ended (minus a signal), and how many changes it made.

    ``kill_at`` is the change before which the process kills itself and what it started.
    """
    place.output.seek(0)
    place.output.truncate()

    def work(tell: Callable[[Any], None]) -> None:
        place.isolate()
        changes = 0

        def change(path: Path) -> None:
            nonlocal changes
            if path.is_relative_to(place.work):
                changes += 1
                if changes == kill_at:
                    os.killpg(0, signal.SIGKILL)

        on_change(change)
        code = call(writer.line)
        tell((code, changes))

    ended, values = forked(work)
    return values[0] if values else (ended, 0)


TIMES = re.compile(
    "(?i)seconds|interruptions|memory|since|started|finished|time|fingerprint|load|training.json"
)
"""Keys of what depends on the clock and on the machine, and of digests of that."""
MEASURED = "fps|latency_|processor_time|throughput|stage_|training_"
"""Metrics of speed and of what training took, by how their names begin."""


def tree(place: Place, writer: Writer) -> dict[str, Any]:
    """Content of every file under the folder, of logs and of what is measured only that they are there."""
    found: dict[str, Any] = {}
    for path in sorted(place.work.rglob("*")):
        name = str(path.relative_to(place.work))
        if path.is_symlink() or path.is_dir():
            found[name] = os.readlink(path) if path.is_symlink() else "folder"
        elif path.suffix == ".log" or any(path.match(pattern) for pattern in writer.measured):
            found[name] = "file"
        else:
            found[name] = _content(path, str(place.work))
    return found


def _content(path: Path, work: str) -> Any:
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
    common = [name for name in expected if name in found]
    return lines + [f"differs: {name}" for name in common if found[name] != expected[name]]


class Kills:
    """The kills of one command: what an unbroken run leaves, and the changes still to be tried."""

    def __init__(self, writer: Writer, samples: Path, seed: int):
        self.writer, self.place, self.done = writer, Place(samples / writer.sample), 0
        self.findings: list[tuple[int, str]] = []
        self.waiting: list[int] = []
        self.expected: dict[str, Any] | None = None
        self.place.restore()
        self.code, self.changes = start(writer, self.place)
        self.traced = "Traceback" in self.place.text()
        self.expected = tree(self.place, writer)
        if self.code not in (0, 1):
            self.findings.append((0, f"an unbroken run: exit code {self.code}: {_last(self.place.text())}"))
        self.place.restore()
        if self.findings or not self._ends_alike(0):
            return  # kills have nothing to be compared with
        every = [*range(1, self.changes + 1)]
        edges = [*dict.fromkeys(every[:10] + every[-10:])]
        rest = [n for n in every if n not in edges]
        self.waiting = [*edges, *np.random.default_rng(seed).permutation(rest).tolist()]

    def kill(self, number: int) -> None:
        """Kill the command before a change, start it again, and compare."""
        self.place.restore()
        self.done += 1
        code, _ = start(self.writer, self.place, number)
        if code == -signal.SIGKILL:
            self._ends_alike(number)
        elif code != self.code:
            self.findings.append((number, f"not killed, exit code {code}: {_last(self.place.text())}"))

    def _ends_alike(self, number: int) -> bool:
        """Whether the command, started now, ends as the unbroken run did."""
        code, _ = start(self.writer, self.place)
        text = self.place.text()
        faults = differences(self.expected or {}, tree(self.place, self.writer))[:3]
        if code != self.code:
            faults = [f"exit code {code} instead of {self.code}: {_last(text)}"]
        elif "Traceback (most recent call last)" in text and not self.traced:
            faults = [f"a traceback: {_last(text)}"]
        if faults:
            self.findings.append((number, ("" if number else "a second unbroken run: ") + "; ".join(faults)))
        return not faults


def _last(text: str) -> str:
    return text.strip().splitlines()[-1][:300] if text.strip() else ""


def kill_all(
    names: Sequence[str], samples: Path, seed: int, end: float, at: int | None = None
) -> list[tuple]:
    """Kill commands in rounds, one change of each, until all are done or ``end``; those that were not begun are left out.

    Returns
    -------
    list
        For each command its name, the number of its changes, how many were tried, and the findings by change.
    """
    kills: list[Kills] = []
    began = time.monotonic()
    for writer in (writer for writer in WRITERS if writer.name in names):
        if not kills or time.monotonic() - began < (end - began) / 2:
            kills.append(Kills(writer, samples, seed))
            kills[-1].waiting = kills[-1].waiting if at is None else [at]
    while any(k.waiting for k in kills) and time.monotonic() < end:
        for k in kills:
            if k.waiting and time.monotonic() < end:
                k.kill(k.waiting.pop(0))
    for k in kills:
        k.place.remove()
    return [(k.writer.name, k.changes, k.done, k.findings) for k in kills]


def main() -> int:
    parser = options_of(__doc__)
    parser.add_argument("--command", action="append", default=[], help="the start of names; default: all")
    parser.add_argument("--at", type=int, help="kill the command before this change only")
    options = parser.parse_args()
    samples = prepare_samples()
    chosen = [w.name for w in WRITERS if not options.command or w.name.startswith(tuple(options.command))]
    end = time.monotonic() + options.seconds
    results = in_shares(chosen, options.workers, kill_all, samples, options.seed, end, options.at)
    found = {outcome[0]: outcome for outcomes in results for outcome in outcomes}
    print(f"{'command':<20}{'changes':>9}{'killed':>8}{'findings':>10}")
    for name, changes, done, findings in found.values():
        print(f"{name:<20}{changes:>9}{done:>8}{len(findings):>10}")
        kinds = {re.sub(r"-\w{8}\b", "-*", text): number for number, text in reversed(findings)}
        for text, number in kinds.items():
            again = f"python -m headbench.tests.fuzz.kills --command '{name}' --at {number}"
            print(f"  killed before {number}: {text}\n    {again}")
    if left := [name for name in chosen if name not in found]:
        print(f"no time for: {', '.join(left)}")
    return 1 if any(outcome[3] for outcome in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
