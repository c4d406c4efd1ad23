"""The commands that every other package's work is composed by: demo, synth, run, table, list, bench, stress."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .configuration import build, merge, parse_assignments, with_homes
from .contracts import Progress
from .errors import HeadbenchError, InputError
from .executors.command import ExecutionOptions, chosen_execution
from .executors.settings import Execution, ExecutorName, check_executor
from .io.documents import read_yaml
from .io.files import (
    check_kind,
    check_output_folder,
    check_writable,
    removed_if_empty,
    write_json,
    write_text,
)
from .io.lock import locked
from .machine import check_device
from .progress import log_to_file
from .progress import progress as show_progress
from .registry import Group, discover, get, resolve
from .runner.config import (
    DemoConfig,
    RunConfig,
    build_run_config,
    demo_run_config,
    parse_size,
    resolve_methods,
    resolve_metrics,
)
from .specs import Findings

Preset = Literal["smoke", "demo", "fast", "paper"]
Assignments = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")]


@dataclass(frozen=True)
class DemoSettings:
    """Needs no data, no accelerator and no network. Everything is written to OUT: the capture, the avatars, the renders,
    tables (Markdown, CSV, LaTeX) and contact_sheet.png. Started again after a kill it continues.
    """

    out: str = "demo-output"
    """Folder for everything the demo makes."""
    preset: Preset = "demo"
    """How much effort: smoke takes seconds and proves nothing about quality; demo takes minutes."""
    seed: int = 0
    """Seeds the training."""
    set: Assignments = ()
    """Change a setting of the run, as for `headbench run`; repeatable. `capture.size=96x136`, `capture.subject_seed=3`
    and the like change the capture."""


def demo(settings: DemoSettings, progress: Progress) -> Findings:
    """Run a complete comparison on a synthetic capture: render it, train, measure, print the table."""
    values = parse_assignments(settings.set)
    capture = {"preset": settings.preset, "seed": settings.seed, "out": settings.out}
    given = merge({"capture": capture}, {"capture": values.pop("capture", {})})
    config = build(DemoConfig, given["capture"], "--set", "capture.")
    device = str(values.get("device", RunConfig.device))
    comparison = build_run_config(merge(demo_run_config(config, device), values), "--set")
    # Errors before the capture is made, which takes minutes.
    resolve_methods(comparison)
    resolve_metrics(comparison)
    check_device(comparison.device)
    out = Path(settings.out)
    check_kind(out, "a run")
    check_output_folder(out)
    with _log_file(out):
        start = time.perf_counter()
        with locked(out):
            _synthesise(config.capture_arguments())
        return _run(comparison, capture_seconds=round(time.perf_counter() - start, 3))


@dataclass(frozen=True)
class SynthSettings(ExecutionOptions):
    """Ray-traced heads of people of all ages, lit by eight large panels, on NeRSemble's camera rig, with sequences named as
    there. Skin folds and blushes with expressions, with hysteresis and delay. The same settings give the same bytes on
    every processor; frames that exist are kept. Needs the compiled kernel.
    """

    out: str
    """Folder to write."""
    subjects: int = 1
    """How many heads; each differs in shape, skin, hair."""
    cameras: int = 16
    """2 to 16 views; the frontal one is always there and is held out as the novel view."""
    timesteps: int = 60
    """Frames per camera, shared out over the sequences; FREE is held out for self-reenactment."""
    size: str = "275x401"
    """Width x height of the images in pixels, for example 550x802 (NeRSemble at a quarter)."""
    head: str = "procedural"
    """`procedural`, or the path of a head model (ICT-FaceKit npz)."""
    seed: int = 0
    """Decides subjects and performances."""
    tracking_noise: float = 0.0
    """Noise on the tracked parameters, as a fraction of their standard deviation."""
    performance: Literal["full", "parts", "expressions", "still"] = "full"
    """`parts` plays every sequence and holds out three parts of FREE, each scored as a sequence: seen, recombined and
    beyond the range of training. `expressions` leaves out jaw and tongue, `still` moves only head, neck and eyes."""
    dynamics: float = 1.0
    """Scales what expressions do to skin beyond moving it (wrinkles, blush), 0 to 3."""
    tracking_error: float = 0.0
    """Level of the errors that trackers make: shrunk and mixed expressions, drift; 1 is 0.5 to 1 mm on the face, 2 to 3 mm
    on lips and lids. 0 to 4."""


def synth(settings: SynthSettings, progress: Progress) -> Findings:
    """Render a synthetic multi-view capture in the GaussianAvatars/VHAP layout."""
    out, execution = Path(settings.out), settings.execution
    check_executor(execution, "cpu")
    check_kind(out, "a synthetic capture", "captures")
    check_output_folder(out)
    with locked(out, beside=True):  # a capture is made in an empty folder
        size = parse_size(settings.size)
        _synthesise({**settings.others, "out": out, "size": size, "execution": execution})
    return Findings(settings.out, {"out": out})


@dataclass(frozen=True)
class RunSettings:
    """Settings come from --config, then from the options here, then from --set. A run that was killed continues
    when started again. Exit code 0: all done; 1: some method failed (the table shows which and why); 2: bad input,
    found before any training.
    """

    data: str | None = None
    """Capture, such as one in the GaussianAvatars/VHAP layout: a UNION folder, a sequence folder, or a folder of them."""
    out: str | None = None
    """Folder for everything the run makes. A run in it is continued: methods, seeds and metrics may be added, but none left
    out; captures, frames, tasks and regions have to be the same."""
    methods: str | None = None
    """Names, separated by commas; see `headbench list methods`. Default: all that compare fairly here:
    mean-image,nearest-camera,ga,ours."""
    preset: str | None = None
    """How much training: smoke (seconds), demo (minutes), fast, paper (the published schedule), or another that each
    method of the run has; see `headbench list presets`. Default: fast."""
    config: str | None = None
    """YAML file with any settings of a run."""
    head: str | None = None
    """Head model for captures that bring none: FLAME pickle or npz."""
    seeds: str | None = None
    """Seeds of the training, separated by commas: an avatar is trained for each. Default: 0."""
    executor: ExecutorName | None = None
    """Where cells (a subject, a method, a seed) run: inline, one after another; processes, several at once on this machine;
    slurm, a job for each. Default: inline."""
    workers: int | None = None
    """How many processes, with `--executor processes`. Default: one for each core."""
    unchecked: bool = False
    """Train although `headbench lint` names an error of a capture that makes its results meaningless."""
    set: Assignments = ()
    """Any setting, for example `frames_per_task=50`, `settings.ga.budget.iterations=5000`, `execution.slurm.hours=8`;
    repeatable."""


def run(settings: RunSettings, progress: Progress) -> Findings:
    """Train methods on a capture, render, measure, and write tables and pictures."""
    values: dict[str, Any] = read_yaml(Path(settings.config)) if settings.config else {}
    values = with_homes(values, settings.config or "")
    given = {name: getattr(settings, name) for name in ("data", "out", "methods", "preset", "seeds")}
    values = merge(values, {key: value for key, value in given.items() if value is not None})
    if settings.head is not None:
        values = merge(values, {"reader_settings": {"head": settings.head}})
    source = settings.config or "command line"
    for key in ("data", "out"):
        if key not in values:
            raise InputError(source, key, f"--{key} or the key {key} in --config", "neither")
    assigned = parse_assignments(settings.set)
    values = merge(values, assigned)
    if "reader" not in values and isinstance(values["data"], str):
        from .runner.captures import reader_of  # which takes long to import

        values["reader"] = reader_of(values["data"])
    execution = chosen_execution(
        values.pop("execution", {}),
        assigned.get("execution", {}),
        settings.executor,
        settings.workers,
        source,
    )
    config = build_run_config(values, source)
    check_kind(Path(config.out), "a run")  # before the log is written there
    with _log_file(Path(config.out)):
        return _run(config, execution, unchecked=settings.unchecked)


@dataclass(frozen=True)
class TableSettings:
    """Runs are merged into one table: seeds of the same settings are averaged, other settings get rows of their own."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of the runs."""
    format: Literal["md", "csv", "latex", "html", "json"] | None = None
    """Markdown, CSV, LaTeX (booktabs), a page of HTML, or JSON. Default: by the suffix of --out, md without it."""
    layout: str = "comparison"
    """Which table: comparison, speed (latency, throughput, stages), cost (storage, training), or the paper's: paper-1
    (all methods), paper-3 (INSTA and ours), paper-4 (what an expression may change: a run each)."""
    published: bool = False
    """Add columns with the figures that papers printed, where a layout has some."""
    region: str = "full"
    """Region of the frames to show instead of the whole, such as face."""
    sequences: tuple[str, ...] = ()
    """Only frames of these sequences; default: all."""
    columns: tuple[str, ...] = ()
    """Only these metrics and tasks of the layout, by name and in this order, such as `psnr novel_view`; default: all."""
    digits: tuple[str, ...] = ()
    """Decimals shown, of all metrics or of one: `3`, `psnr=1 lpips=4`. Default: the layout's."""
    out: str | None = None
    """File to write the table to, instead of printing it."""


SUFFIXES = {".md": "md", ".txt": "md", ".tex": "latex", ".html": "html", ".csv": "csv", ".json": "json"}
"""Formats of tables by the suffix of a file."""


def table(settings: TableSettings, progress: Progress) -> Findings:
    """Print a table of finished runs on the same frames, or write it to a file."""
    options = asdict(settings)
    out = options.pop("out")
    if out is not None:
        check_writable(Path(out), "--out")
        if settings.format is None and Path(out).suffix.lower() not in SUFFIXES:
            expected = f"a suffix that names a format ({', '.join(SUFFIXES)}), or --format"
            raise InputError("command line", "--out", expected, out)
    options["format"] = settings.format or (SUFFIXES[Path(out).suffix.lower()] if out else "md")
    text = _table(**options)
    data = {"format": options["format"], "table": text}
    if out is None:
        return Findings(text, data)
    write_text(Path(out), text)
    return Findings(out, {**data, "out": out})


@dataclass(frozen=True)
class ListSettings:
    """--json prints all fields."""

    what: tyro.conf.Positional[
        Literal["methods", "presets", "metrics", "profiles", "datasets", "reports", "benchmarks", "commands"]
    ]
    """What to list; datasets are readers, and what makes captures."""


def list_installed(settings: ListSettings, progress: Progress) -> Findings:
    """List what is installed: methods, presets, metrics, their profiles, readers, reports, benchmarks, commands."""
    group: Group = "methods" if settings.what == "presets" else settings.what
    entries = []
    for name, plugin in discover(group).items():
        known = {} if plugin.spec is None else {k: _reference(v) for k, v in asdict(plugin.spec).items()}
        entries.append({"origin": plugin.origin, "error": plugin.error, **known, "name": name})
    if settings.what == "presets":
        entries = [
            {
                "name": f"{entry['name']} {preset}",
                "summary": ", ".join(f"{key}={value}" for key, value in values.items()),
                "settings": values,
                "error": "",
            }
            for entry in entries
            for preset, values in entry.get("presets", {}).items()
        ]
    width = max((len(entry["name"]) for entry in entries), default=0)
    shown = [f"broken: {entry['error']}" if entry["error"] else entry["summary"] for entry in entries]
    lines = [f"{entry['name']:<{width}}  {text}" for entry, text in zip(entries, shown)]
    return Findings("\n".join(lines), entries)


@dataclass(frozen=True, kw_only=True)
class StressSettings:
    """Exit code 1 where a case does not behave as expected."""

    part: tyro.conf.Positional[str]
    """What to measure: splats, or what `headbench list benchmarks` shows."""
    quick: bool = False
    """Less where there is much: fewer sizes, runs, cases."""
    out: str | None = None
    """Also write the results to this JSON file."""


@dataclass(frozen=True, kw_only=True)
class BenchSettings(StressSettings):
    """What is compared is timed in turns, and each table says whether times are processor times or by the clock, and of
    how many threads; compare ratios, not milliseconds, between machines.
    """

    tradeoffs: bool = False
    """Instead of speed alone, what settings that give up accuracy for speed buy."""


def bench(settings: BenchSettings, progress: Progress) -> Findings:
    """Benchmark a part of headbench itself on this machine."""
    return _measure(settings, "tradeoffs" if settings.tradeoffs else "speed", progress)


def stress(settings: StressSettings, progress: Progress) -> Findings:
    """Test a part of headbench at numerical extremes and print the result of each case."""
    return _measure(settings, "stress", progress)


def _synthesise(arguments: dict[str, Any]) -> None:
    with show_progress("capture") as report:
        resolve(get("datasets", "synthetic").implementation)(**arguments, progress=report)


def _run(config: RunConfig, execution: Execution | None = None, **record: Any) -> Findings:
    from .runner.run import run as run_comparison

    rows = run_comparison(config, execution, **record)
    text = f"{_table([config.out])}\n\nPictures, tables and everything else: {config.out}"
    return Findings(
        text, {"out": config.out, "failed": rows.failed, "means": means(config.out)}, not rows.failed
    )


def _table(runs: Sequence[str], **options: Any) -> str:
    text: str = resolve(get("reports", "table-text").implementation)(list(map(Path, runs)), **options)
    return text


def means(run_folder: str) -> list[dict[str, Any]]:
    """Numbers of the comparison table, so that a machine reads what a person does; None where there is none."""
    table = json.loads(_table([run_folder], format="json"))
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


def _measure(settings: StressSettings, kind: str, progress: Progress) -> Findings:
    function = getattr(get("benchmarks", settings.part), kind)
    if not function:
        found = f"{settings.part}, which has none"
        raise InputError("command line", "part", f"a benchmark with {kind}", found)
    if settings.out is not None:
        check_writable(Path(settings.out), "--out")
    findings: Findings = resolve(function)(settings.quick, progress)
    if settings.out is not None:
        write_json(Path(settings.out), findings.data)
    return findings


@contextmanager
def _log_file(out: Path) -> Iterator[None]:
    """Log to a run's file; not where the folder cannot be made, which the run then reports properly.

    A run that is refused before it has written anything else leaves neither the file nor a new folder.
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


def _reference(value: Any) -> Any:
    """Functions and classes as "package.module:name"."""
    return f"{value.__module__}:{value.__qualname__}" if callable(value) else value
