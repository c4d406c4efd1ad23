"""``headbench run`` and ``headbench demo``: settings, and the comparison that both start."""

from __future__ import annotations

import json
import logging
import os
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro

from .condition import PLAIN
from .configuration import build, merge, parse_assignments, with_homes
from .contracts import Progress
from .engine.captures import PROGRAMS, check_trusted, open_clips, programs, reader_of, run_configuration
from .engine.config import (
    RunConfig,
    RunOptions,
    build_run_config,
    coded_conditions,
    default_names,
    parse_size,
    resolve_methods,
    resolve_metrics,
    with_methods,
)
from .engine.store import FinishedRun, RunFolder
from .errors import HeadbenchError, InputError
from .executors.settings import Execution, ExecutorName, chosen_execution
from .io.documents import read_yaml
from .io.files import (
    check_kind,
    check_output_folder,
    removed_if_empty,
)
from .io.lock import locked
from .machine import check_device
from .progress import counted, log_to_file
from .progress import progress as show_progress
from .protocol import check_capture, needed
from .registry import discover, get, resolve
from .rows import Rows
from .specs import CommandResult, command

log = logging.getLogger(__name__)
Preset = Literal["quick", "smoke", "demo", "fast", "paper"]
QUICK: Final = "quick"
"""Preset of the demo: about 3 minutes on two cores, with fewer scored frames, without coded avatars and speeds."""
QUICK_FRAMES = 23
"""Number of scored frames of a task: a prime, so that evenly spaced ones are of all 8 cameras."""
DEMO_SIZES: Mapping[str, Mapping[str, Any]] = {
    "smoke": {"cameras": 3, "timesteps": 8, "size": "48x64"},
    QUICK: {"cameras": 8, "timesteps": 16, "size": "120x174"},
    "demo": {"cameras": 12, "timesteps": 28, "size": "144x208"},
}
"""Sizes of the demo's capture by preset; other presets have those of "demo"."""


@dataclass(frozen=True)
class DemoConfig:
    """Settings of ``headbench demo``. Sizes that are None are those of the preset, see `DEMO_SIZES`."""

    out: str = "demo-output"
    preset: str = QUICK
    seed: int = 0  # of the training
    subject_seed: int = 14  # of the capture: determines the subject and the performance
    cameras: int | None = None
    timesteps: int | None = None
    size: str | None = None
    head: str = "procedural"
    tracking_noise: float = 0.0

    def capture_arguments(self) -> dict[str, Any]:
        """Arguments of the synthesiser."""
        sizes = dict(DEMO_SIZES.get(self.preset, DEMO_SIZES["demo"]))
        sizes |= {name: value for name in sizes if (value := getattr(self, name)) is not None}
        return {
            "out": self.capture_folder,
            "subjects": 1,
            **sizes,
            "size": parse_size(sizes["size"]),
            "head": self.head,
            "seed": self.subject_seed,
            "tracking_noise": self.tracking_noise,
            "performance": "full",  # which shows most in few timesteps
        }

    @property
    def capture_folder(self) -> Path:
        return Path(self.out) / "capture"


def demo_run_config(config: DemoConfig, device: str) -> dict[str, Any]:
    """`RunConfig` fields of the comparison, with the methods that have the preset and support ``device``."""
    is_quick = config.preset == QUICK
    specs = {name: plugin.spec for name, plugin in discover("methods").items() if plugin.spec}
    methods = tuple(
        name
        for name, spec in specs.items()
        if spec.demo and spec.computes_on(device) and (not spec.presets or config.preset in spec.presets)
    )
    return {
        "data": str(config.capture_folder),
        "out": config.out,
        "methods": methods,
        "preset": config.preset,
        "seeds": (config.seed,),
        "frames_per_task": QUICK_FRAMES if is_quick else None,
        "metrics": tuple(
            name for name in default_names("metrics") if not (is_quick and get("metrics", name).is_speed)
        ),
    }


Assignments = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")]


@dataclass(frozen=True)
class DemoSettings:
    """Renders images of a synthetic head from several cameras, trains an avatar with each method on a part of them, and compares
    the avatars on the others: a camera and expressions that no method was trained on. Takes about 3 minutes on two cores.
    Everything is written to OUT; report.html shows it in a browser. If it is interrupted, the same command continues it.
    """

    out: str = "demo-output"
    """Output folder."""
    preset: Preset = QUICK
    """Length of the training. quick: about 3 minutes in all; demo: about 16 minutes, with more and larger images, the
    speed of the avatars, and compressed ones; smoke: about a minute, for a test of the installation, too short for good images; fast
    and paper: longer, see `headbench list presets`."""
    seed: int = 0
    """Seed of the training."""
    set: Assignments = ()
    """Change a setting of the run, as for `headbench run`; repeatable. `capture.size=96x136` (pixels), `capture.subject_seed=3`
    (another head), `capture.cameras=12` and `capture.timesteps=40` change the capture, `methods=ga,ours` the methods."""


DURATIONS = {"smoke": "about a minute", QUICK: "about 3 minutes", "demo": "about 16 minutes"}
"""How long the demo takes on two cores, by preset."""
ONE_SUBJECT = (
    "One subject ranks nobody: the order of the methods changes with the subject, the seed and the length of the training. "
    "`headbench run suite` compares them on ten."
)


@command("demo", group="compare")
def demo(settings: DemoSettings, progress: Progress) -> CommandResult:
    """Compare all methods on a synthetic capture; needs no data, GPU or network."""
    from .engine.run import run as run_comparison  # slow to import

    values = parse_assignments(settings.set)
    if "preset" in values:
        raise InputError("command line", "--set preset", "--preset of the demo", str(values["preset"]))
    capture = {"preset": settings.preset, "seed": settings.seed, "out": settings.out}
    given = merge({"capture": capture}, {"capture": values.pop("capture", {})})
    config = build(DemoConfig, given["capture"], "--set", "capture.")
    device = str(values.get("device", RunConfig.device))
    comparison = build_run_config(merge(demo_run_config(config, device), values), "--set")
    is_quick = comparison.preset == QUICK
    if "conditions" not in values and not is_quick:
        comparison = replace(comparison, conditions=(PLAIN, *coded_conditions(comparison.methods)))
    # Report errors before making the capture, which takes minutes.
    methods = resolve_methods(comparison)
    resolve_metrics(comparison)
    check_device(comparison.device)
    arguments, out = config.capture_arguments(), Path(settings.out)
    check_kind(out, "a run")
    check_output_folder(out)
    with _log_file(out):
        log.info(
            "Renders images of a synthetic head, trains %s on a part of them, and compares their renders with the other images. Takes %s on "
            "two cores. Everything is written to %s.",
            f"{counted(sum(not m.spec.trivial for m in methods), 'method')} and "
            f"{counted(sum(m.spec.trivial for m in methods), 'trivial baseline')}",
            DURATIONS.get(comparison.preset, "more than 16 minutes"),
            out,
        )
        start = time.perf_counter()
        with locked(out), show_progress("images of the capture") as report:
            make = resolve(get("datasets", "synthetic").implementation)
            make(**arguments, progress=report)
        seconds = round(time.perf_counter() - start, 3)
        result = _result(run_comparison(comparison, Execution("auto"), capture_seconds=seconds))
    return result._replace(text=f"{result.text}\n{ONE_SUBJECT}")


def presets_of_methods() -> str:
    """A sentence for the help: the presets of every registered method."""
    methods_by_presets: dict[str, list[str]] = {}
    for name, plugin in discover("methods").items():
        if plugin.spec is not None and plugin.spec.presets:
            methods_by_presets.setdefault(", ".join(plugin.spec.presets), []).append(name)
    each = (f"{', '.join(methods)}: {presets}" for presets, methods in methods_by_presets.items())
    return f"Presets by method: {'; '.join(each)}. `headbench list presets` prints their settings."


@dataclass(frozen=True)
class RunSettings:
    """Settings come from --config, then from the options here, then from --set. The same command continues a run that was
    killed. Exit code 0: all done; 1: some method failed (the table shows which and why); 2: bad input, found before any
    training.
    """

    data: str | None = None
    """Capture, such as one in the GaussianAvatars/VHAP layout: a UNION folder, a sequence folder, or a folder of them."""
    out: str | None = None
    """Output folder. The same configuration continues the run in it; another one needs a folder of its own. `headbench table`,
    `compare` and `report` take several runs."""
    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Folder of a finished run: render and measure its avatars in --out instead of training, with its configuration except for
    the options given here, such as --metrics."""
    methods: str | None = None
    """Names, separated by commas; see `headbench list methods`. Default:
    mean-image,nearest-camera,ga,ours."""
    metrics: str | None = None
    """Names, separated by commas; see `headbench list metrics`."""
    preset: str | None = None
    """Length of the training: smoke (seconds), demo (minutes), fast, paper (the published schedule), or another preset that all
    methods of the run have, as listed above. Default: fast."""
    config: str | None = None
    """YAML file with any settings of a run."""
    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""
    protocol: tuple[str, ...] = ()
    """Published protocols (`headbench list protocols`) whose tasks, metrics and regions are also measured. `headbench table
    --protocol NAME` prints the table of one."""
    seeds: str | None = None
    """Seeds of the training, separated by commas: an avatar is trained for each. Default: 0."""
    executor: ExecutorName | None = None
    """How cells (a subject, a method, a seed) are executed: inline, one after another; processes, several at once on this
    machine; slurm, one job for each; auto, processes for several trainings on a CPU with several cores and 2 GB of free memory
    for each, otherwise inline. Default: auto."""
    workers: int | None = None
    """Number of processes, with which `--executor auto` is `processes`. Default: one for each core."""
    unchecked: bool = False
    """Do not search the captures for errors of `headbench lint`, which stop a run; the record of the run says so."""
    dry_run: bool = False
    """Check everything and list the cells; train nothing."""
    set: Assignments = ()
    """Any setting, for example `frames_per_task=50`, `settings.ga.budget.iterations=5000`, `execution.slurm.hours=8`;
    repeatable."""

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()


@command("run", group="compare")
def run(settings: RunSettings, progress: Progress) -> CommandResult:
    """Train methods on a capture, render, measure, and write tables and pictures."""
    values: dict[str, Any] = read_yaml(Path(settings.config)) if settings.config else {}
    values = with_homes(values, settings.config or "")
    given = {n: getattr(settings, n) for n in ("data", "out", "methods", "metrics", "preset", "seeds")}
    values = merge(values, {key: value for key, value in given.items() if value is not None})
    if settings.head is not None:
        values = merge(values, {"reader_settings": {"head": settings.head}})
    source = settings.config or "command line"
    assigned = parse_assignments(settings.set)
    values = merge(values, assigned)
    if settings.protocol:
        values = merge(values, needed(settings.protocol, values))
    if settings.source is not None:
        values = merge(_configuration_of(Path(settings.source), values, settings), values)
    for key in ("data", "out"):
        if key not in values:
            raise InputError(source, key, f"--{key} or the key {key} in --config", "neither")
    if "reader" not in values and isinstance(values["data"], str):
        values["reader"] = reader_of(values["data"])
    execution = chosen_execution(
        values.pop("execution", {}),
        assigned.get("execution", {}),
        settings.executor,
        settings.workers,
        source,
    )
    config = build_run_config(values, source)
    if settings.source is not None:
        config = with_methods(config, [get("methods", name).name for name in config.methods])
    check_kind(Path(config.out), "a run")  # before the log is written there
    if settings.protocol:
        for clip in open_clips(config):
            check_capture(settings.protocol, clip)
    if settings.dry_run:
        from .engine.run import planned_cells

        cells = planned_cells(config)
        lines = [f"{name:<40} {state}" for name, state in cells.items()]
        return CommandResult(
            "\n".join(lines), {"cells": [{"cell": name, "state": state} for name, state in cells.items()]}
        )
    from .engine.run import run as run_comparison

    with _log_file(Path(config.out)):
        return _result(run_comparison(config, execution, unchecked=settings.unchecked))


def _configuration_of(run: Path, values: Mapping[str, Any], settings: RunSettings) -> dict[str, Any]:
    """Configuration of a run whose avatars are used."""
    used: Any = tuple(group for group in ("methods", "metrics") if group not in values)
    lists = [value.split(",") if isinstance(value, str) else value for value in values.values()]
    given = {name for names in lists if isinstance(names, (list, tuple)) for name in names}
    config = run_configuration(run, RunOptions(data=settings.data, head=settings.head), used, given)
    started = programs(config.methods) if "methods" in used else ()
    check_trusted(run, {"metric_profiles": config.metric_profiles, PROGRAMS: started}, given, trust=False)
    configuration = {**asdict(config), "source": str(run)}
    del configuration["out"]
    return configuration


def _result(run: FinishedRun) -> CommandResult:
    text = f"{_table([run], fit=True)}\n{closing(run.folder.root, run.rows)}"
    data = {"out": str(run.folder.root), "failed": run.rows.failed, "means": means(run)}
    return CommandResult(text, data, not run.rows.failed)


def closing(run: Path, rows: Rows) -> str:
    """Three lines at the end of a run: path of the report, its content, and suggested commands."""
    folder, page = shlex.quote(str(run)), RunFolder(run).page
    first = f"Report: {page} (for a browser; it needs no network)"
    if not page.is_file():
        first = f"Report: none was written, see {run / 'run.log'}; `headbench report {folder} --out {folder}/{page.name}` tries again"
    subjects, methods = len(rows.subjects), len(rows.methods)
    frames = ", every method beside the captured images frame by frame, error maps, curves, worst frames"
    contents = f"tables{frames if rows.tasks else ''}"
    failed = "; a training or measurement failed, and the tables say which" if rows.failed else ""
    second = f"It shows {counted(methods, 'method')} on {counted(subjects, 'subject')}: {contents}{failed}."
    why = [f"`headbench status {folder}` (why something failed)"] if rows.failed else []
    tried = f"`headbench table {folder} --format latex` (the table for a paper)"
    tested = f"`headbench compare {folder}` (differences with intervals and tests)"
    return "\n".join([first, second, f"Next: {'; '.join([*why, tried, tested])}"])


def _table(runs: Sequence[FinishedRun], **options: Any) -> str:
    text: str = resolve(get("reports", "table-text").implementation)(runs, **options)
    return text


def means(run: FinishedRun) -> list[dict[str, Any]]:
    """Values of the comparison table for JSON output; None if there is no table."""
    table = json.loads(_table([run], format="json"))
    return [
        {
            **{name: column[name] for name in ("task", "metric")},
            "method": row["method"],
            **{name: cell[name] for name in ("value", "status")},
        }
        for _, rows in table["groups"]
        for row in rows
        for column, cell in zip(table["columns"], row["cells"])
    ]


@contextmanager
def _log_file(out: Path) -> Iterator[None]:
    """Log to a run's file, unless the folder cannot be created, which the run reports.

    A run that is refused before it has written anything leaves neither the file nor a new folder.
    """
    log = out / "run.log"
    is_new = is_writable = False
    with ExitStack() as stack:
        with suppress(OSError, ValueError):
            stack.enter_context(removed_if_empty(out))
            out.mkdir(parents=True, exist_ok=True)
            is_new, is_writable = not log.exists(), os.access(out, os.W_OK)
        if is_writable:
            stack.enter_context(log_to_file(log))
        try:
            yield
        except HeadbenchError:
            with suppress(OSError):
                if is_new and [*out.iterdir()] == [log]:
                    log.unlink()
            raise
