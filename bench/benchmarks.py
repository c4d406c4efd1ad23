"""``headbench doctor bench`` and ``headbench doctor stress``, and shared functions: interleaved timing, tables of rows."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro

from . import terminal
from .contracts import Progress
from .errors import InputError
from .io.files import check_writable, write_json
from .registry import get, resolve
from .specs import CommandResult, command

Key = TypeVar("Key", bound=Hashable)
Row = Mapping[str, Any]
"""A row of a table: text, whole numbers, floats or None by column."""


def take_turns(
    runs: Mapping[Key, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Key, list[float]]:
    """Time several functions in turn, so that other load on the machine affects all of them equally.

    The first round is a warm-up and is not counted.

    Returns
    -------
    dict[Key, list[float]]
        The seconds of ``rounds`` runs of each, by key.
    """
    seconds: dict[Key, list[float]] = {key: [] for key in runs}
    for _ in range(rounds + 1):
        for key, run in runs.items():
            start = clock()
            run()
            seconds[key].append(clock() - start)
    return {key: each[1:] for key, each in seconds.items()}


def findings(tables: Mapping[str, Sequence[Row]], note: str, faults: Sequence[str] = ()) -> CommandResult:
    """Result of a benchmark: tables by title, a note on how to read them, and violated bounds."""
    parts = [f"{title}\n\n{table(rows)}" for title, rows in tables.items() if rows]
    data = {title: [dict(row) for row in rows] for title, rows in tables.items()}
    return CommandResult("\n\n".join([*parts, note, *faults]), data, passed=not faults)


def table(rows: Sequence[Row]) -> str:
    """Align rows under their column names, floats with three significant digits; text columns at the beginning are names."""
    heads = list(dict.fromkeys(name for row in rows for name in row))
    texts = [any(isinstance(row.get(name), str) for row in rows) for name in heads]
    lines = [[_cell(row.get(name)) for name in heads] for row in rows]
    return terminal.table(heads, lines, names=max(1, [*texts, False].index(False)))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


@dataclass(frozen=True, kw_only=True)
class StressSettings:
    """Exit code 1 if a case does not behave as expected."""

    part: tyro.conf.Positional[str]
    """What to measure: splats, or what `headbench list benchmarks` shows."""
    quick: bool = False
    """Measure fewer sizes, runs and cases."""
    out: str | None = None
    """Also write the results to this JSON file."""


@dataclass(frozen=True, kw_only=True)
class BenchSettings(StressSettings):
    """Compared variants are timed alternately. Each table states whether times are processor time or wall-clock time, and the number
    of threads. Between machines compare ratios, not milliseconds.
    """

    tradeoffs: bool = False
    """Measure speed and accuracy of approximate settings instead of only speed."""


@command("doctor bench", group="validate")
def bench(settings: BenchSettings, progress: Progress) -> CommandResult:
    """Benchmark a part of headbench itself on this machine."""
    return _measure(settings, "tradeoffs" if settings.tradeoffs else "speed", progress)


@command("doctor stress", group="validate")
def stress(settings: StressSettings, progress: Progress) -> CommandResult:
    """Test a part of headbench at numerical extremes."""
    return _measure(settings, "stress", progress)


def _measure(settings: StressSettings, kind: str, progress: Progress) -> CommandResult:
    function = getattr(get("benchmarks", settings.part), kind)
    if not function:
        found = f"{settings.part}, which has none"
        raise InputError("command line", "part", f"a benchmark with {kind}", found)
    if settings.out is not None:
        check_writable(Path(settings.out), "--out")
    findings: CommandResult = resolve(function)(settings.quick, progress)
    if settings.out is not None:
        write_json(Path(settings.out), findings.data)
    return findings
