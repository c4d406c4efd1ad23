"""``headbench doctor``: requirements of methods, metrics and readers, and whether this machine meets them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import tyro

from . import terminal
from .configuration import parse_assignments
from .contracts import Progress
from .engine.config import RunConfig, resolve_method
from .errors import ExitCode, HeadbenchError, InputError, install_extra
from .io.files import check_writable, write_json
from .machine import check_device, machine_record
from .registry import discover, get, resolve, unknown
from .specs import CommandResult, MethodSpec, Need, command

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
    result: CommandResult = resolve(function)(settings.quick, progress)
    if settings.out is not None:
        write_json(Path(settings.out), result.data)
    return result


State = Literal["ready", "partly", "missing"]


@dataclass(frozen=True)
class DoctorSettings:
    """Report what is missing on this machine for every method, metric, reader and tracker, and how to install it.

    Exit code 0: all default methods, or the named ones, can run here; 3: at least one cannot. Nothing is
    downloaded or written.
    """

    methods: tyro.conf.Positional[tuple[str, ...]] = ()
    """Methods to check, which also decide the exit code: names or "module:SPEC". By default all are checked, and the default
    methods decide the exit code. Official repositories are checked if settings name their checkout."""

    device: str = "cpu"
    """Device that the methods run on: cpu, cuda, cuda:1, ..."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """A setting of a method, as for `headbench run`: `settings.ga-official.checkout=DIR`; or checkout and python of a tracker of other
    authors, such as `settings.vhap.checkout=DIR`; repeatable."""


class PluginStatus(NamedTuple):
    """A plug-in that was checked."""

    group: str
    name: str
    counts: bool
    """Whether the exit code depends on it."""
    needs: tuple[Need, ...]

    @property
    def missing(self) -> list[Need]:
        return [need for need in self.needs if not need.found]

    @property
    def state(self) -> State:
        if any(need.required for need in self.missing):
            return "missing"
        return "partly" if self.missing else "ready"


@command("doctor", group="validate")
def doctor(settings: DoctorSettings, progress: Progress) -> CommandResult:
    """Report what methods, metrics and readers lack here, and how to install it."""
    assigned = parse_assignments(settings.set)
    stray = set(assigned) - {"settings"}
    if stray:
        raise unknown("command line", "--set", min(stray), ["settings"])
    chosen: Mapping[str, Mapping[str, Any]] = assigned.get("settings", {})
    RunConfig("", "", device=settings.device)  # refuses invalid devices
    named = {get("methods", name).name: name for name in settings.methods}
    names = [*named] if named else [*discover("methods")]
    programs = {} if named else _programs()
    if unfit := sorted(set(chosen) - {*names, *programs}):
        raise unknown("command line", "--set settings", unfit[0], [*names, *programs])
    if not all(isinstance(values, Mapping) for values in chosen.values()):
        raise InputError("command line", "--set settings", "settings.METHOD.KEY=VALUE", "another")
    statuses = [PluginStatus("machine", settings.device, True, tuple(_device(settings.device)))]
    for name in names:
        statuses.append(_method(named.get(name, name), name in named, not named, settings.device, chosen))
        progress(len(statuses), len(names) + 1, name)
    for group in ("metrics", "datasets") if not named else ():
        for name, plugin in discover(group).items():  # type: ignore[arg-type]
            if plugin.spec is None:
                statuses.append(PluginStatus(group, name, False, (_broken(plugin.error),)))
            elif plugin.spec.needs:
                needs = tuple(_asked(plugin.spec.needs, None, settings.device))
                statuses.append(PluginStatus(group, name, False, needs))
    for name, needs_of in programs.items():
        places = chosen.get(name, {})
        found = tuple(_asked(needs_of, places, settings.device, given=bool(places)))
        statuses.append(PluginStatus("programs", name, False, found))
    if not named:
        statuses.append(PluginStatus("executors", "slurm", False, tuple(_slurm())))
    unavailable = [status for status in statuses if status.counts and status.state == "missing"]
    machine = machine_record(settings.device)
    head = (
        f"{machine['processor']}, {machine['cores']} core{'s' * (machine['cores'] != 1)}, {machine['memory_bytes'] / 1e9:.0f} GB; "
        f"Python {machine['python']}, torch {machine['packages']['torch']}"
    )
    what = "The methods named" if named else "All default methods"
    verdict = (
        f"{what} can run here."
        if not unavailable
        else f"Cannot run here: {', '.join(status.name for status in unavailable)}."
    )
    data = {
        "machine": machine,
        "plugins": [
            {
                "group": status.group,
                "name": status.name,
                "state": status.state,
                "counts": status.counts,
                "needs": [need._asdict() for need in status.needs],
            }
            for status in statuses
        ],
    }
    text = "\n".join([head, *_lines(statuses), verdict])
    return CommandResult(text, data, not unavailable, ExitCode.NO_VERDICT if unavailable else ExitCode.OK)


def _device(device: str) -> Iterator[Need]:

    try:
        check_device(device)
    except HeadbenchError as error:
        yield Need(f"device {device}", "", str(error))
    else:
        yield Need(f"device {device}", "there")


def _programs() -> dict[str, str]:
    """Functions that yield the needs of the programs that commands run, by name of the program."""

    specs = [plugin.spec for plugin in discover("commands").values()]
    return {name: needs for spec in specs if spec is not None for name, needs in spec.programs.items()}  # type: ignore[attr-defined]


def _slurm() -> Iterator[Need]:

    try:
        installed = version("submitit")
    except PackageNotFoundError:
        installed = ""
    yield Need("submitit", installed, install_extra("slurm"))
    remedy = "Commands of the cluster; without one, `--executor processes` uses the cores of this machine."
    yield Need("sbatch", shutil.which("sbatch") or "", remedy)


def _method(
    name: str, named: bool, all_defaults: bool, device: str, chosen: Mapping[str, Mapping[str, Any]]
) -> PluginStatus:

    plugin = discover("methods").get(name)
    if plugin is not None and plugin.spec is None:
        return PluginStatus("methods", name, named, (_broken(plugin.error),))
    spec: MethodSpec = get("methods", name)
    counts = named or (all_defaults and spec.default)
    try:
        resolve(spec.implementation)
        preset = "fast" if "fast" in spec.presets or not spec.presets else next(iter(spec.presets))
        method = resolve_method(spec, preset, chosen.get(spec.name, {}))
    except HeadbenchError as error:
        if chosen.get(spec.name):
            raise
        return PluginStatus("methods", spec.name, counts, (_broken(str(error)),))
    needs = [*_asked(spec.needs, method.config, device)] if spec.needs else []
    if not spec.native and not needs:
        remedy = "See methods/official/README.md; its settings are checked when it is run."
        needs = [Need("checkout and environment", "", remedy)]
    return PluginStatus("methods", spec.name, counts, tuple(needs))


def _asked(needs: str, config: Any, device: str, given: bool = False) -> Iterator[Need]:
    """The requirements that a plug-in declares; an exception is reported as a missing
    requirement.
    """

    try:
        yield from resolve(needs)(config, device)
    except InputError as error:
        if given:
            raise
        yield _broken(f"{type(error).__name__}: {error}")
    except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way; the others must still be asked
        yield _broken(f"{type(error).__name__}: {error}")


def _broken(error: str | None) -> Need:
    return Need("its code", "", f"It cannot be used: {error or 'it does not load'}")


def _lines(statuses: list[PluginStatus]) -> Iterator[str]:
    group, width = "", max([17, *(len(status.name) for status in statuses)]) + 1
    for status in statuses:
        if status.group != group:
            group = status.group
            yield f"\n{group}"
        present = "; ".join(f"{need.what}: {need.found}" for need in status.needs if need.found)
        yield f"  {status.name:<{width}}{status.state:<9}{present}".rstrip()
        for need in status.missing:
            effect = "" if need.required else " (works without)"
            yield f"    no {need.what}{effect}. {need.remedy}".rstrip()
    yield ""
