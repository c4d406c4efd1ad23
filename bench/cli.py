"""The command line. It composes the rooms through the registry; commands themselves hold no logic of a room."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .commands import offered_commands, with_groups
from .configuration import build, merge, parse_assignments, read_yaml
from .demo import DemoConfig, demo_run_config, parse_size
from .device import check_device
from .errors import HeadbenchError, InputError
from .files import WRITE_FAULTS, plain, write_json
from .lock import locked
from .progress import log_to, progress
from .registry import Group, discover, get, resolve
from .run_config import RunConfig, resolve_methods, resolve_metrics
from .runner import run as run_comparison
from .specs import Findings
from .store import RunFolder

EXIT_FAILED_CELL = 1
EXIT_BAD_INPUT = 2

Preset = Literal["smoke", "demo", "fast", "paper"]
Text = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
PathText = Annotated[str | None, tyro.conf.arg(metavar="PATH")]
Assignments = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")]


def demo(
    out: str = "demo-output",
    preset: Preset = "demo",
    seed: int = 0,
    set: Assignments = (),
    json: bool = False,
) -> int:
    """Compare methods from nothing: make a capture, train, render, measure, print the table.

    Needs no data, no accelerator and no network. Everything lands in OUT: the capture, the avatars, the renders,
    tables (Markdown, CSV, LaTeX) and contact_sheet.png. Started again after a kill it continues.

    Args:
        out: Folder for everything the demo makes.
        preset: How much effort: smoke takes seconds and proves nothing about quality; demo takes minutes.
        seed: Seeds the training.
        set: Change a setting of the run, as for `headbench run`; repeatable. `capture.size=96x136`,
            `capture.subject_seed=3` and the like change the capture.
        json: Print the result as JSON.
    """
    values = parse_assignments(set)
    given = merge(
        {"capture": {"preset": preset, "seed": seed, "out": out}}, {"capture": values.pop("capture", {})}
    )
    config = build(DemoConfig, given["capture"], "--set", "capture.")
    comparison = build(RunConfig, merge(demo_run_config(config), values), "--set")
    # Errors before the capture is made, which takes minutes.
    resolve_methods(comparison)
    resolve_metrics(comparison)
    check_device(comparison.device)
    RunFolder(Path(out)).prepare()
    with log_to(_log_file(Path(out))):
        start = time.perf_counter()
        with locked(Path(out)):
            _synthesise(config.capture_arguments())
        seconds = round(time.perf_counter() - start, 3)
        return _run(comparison, json, capture_seconds=seconds)


def synth(
    out: str,
    subjects: int = 1,
    cameras: int = 16,
    timesteps: int = 60,
    size: str = "275x401",
    head: str = "procedural",
    seed: int = 0,
    tracking_noise: float = 0.0,
    performance: Literal["full", "expressions", "still"] = "full",
    dynamics: float = 1.0,
) -> int:
    """Render a synthetic multi-view capture in the GaussianAvatars/VHAP layout.

    Path-traced heads with expression-dependent wrinkles and blush, on NeRSemble's camera rig, with sequences
    named as there. Frames already rendered with the same settings are kept.

    Args:
        out: Folder to write.
        subjects: How many heads; each differs in shape, skin, hair.
        cameras: 2 to 16 views; the frontal one is always there and is held out as the novel view.
        timesteps: Frames per camera, shared out over the sequences; FREE is held out for self-reenactment.
        size: Width x height of the images in pixels, for example 550x802 (NeRSemble at a quarter).
        head: `procedural`, or the path of a head model (ICT-FaceKit npz).
        seed: Decides subjects and performances.
        tracking_noise: Noise on the tracked parameters, as a fraction of their standard deviation.
        performance: `expressions` leaves out jaw and tongue, `still` moves only head, neck and eyes.
        dynamics: Scales what expressions do to skin beyond moving it (wrinkles, blush), 0 to 3.
    """
    RunFolder(Path(out)).prepare()
    folder = Path(out).resolve()  # its lock lies beside it: a capture is made in an empty folder
    with log_to(None), locked(folder.parent, f".{folder.name}.lock"):
        _synthesise(
            {
                "out": Path(out),
                "subjects": subjects,
                "cameras": cameras,
                "timesteps": timesteps,
                "size": parse_size(size),
                "head": head,
                "seed": seed,
                "tracking_noise": tracking_noise,
                "performance": performance,
                "dynamics": dynamics,
            }
        )
    print(out)
    return 0


def run(
    data: PathText = None,
    out: PathText = None,
    methods: Text = None,
    preset: Preset | None = None,
    config: PathText = None,
    head: PathText = None,
    seeds: Text = None,
    set: Assignments = (),
    json: bool = False,
) -> int:
    """Train methods on a capture, render, measure, and write tables and pictures.

    Settings come from --config, then from the options here, then from --set. A run that was killed continues
    when started again. Exit code 0: all done; 1: some method failed (the table shows which and why); 2: bad input,
    found before any training.

    Args:
        data: Capture in the GaussianAvatars/VHAP layout: a UNION folder, a sequence folder, or a folder of them.
        out: Folder for everything the run makes.
        methods: Names, separated by commas; see `headbench list methods`. Default: all that compare fairly here:
            mean-image,nearest-camera,ga,ours.
        preset: How much training: smoke (seconds), demo (minutes), fast, paper (the published schedule).
        config: YAML file with any settings of a run.
        head: Head model for captures that bring none: FLAME pickle or npz.
        seeds: Seeds of the training, separated by commas: an avatar is trained for each. Default: 0.
        set: Any setting, for example `frames_per_task=50`, `settings.ga.budget.iterations=5000`;
            repeatable.
        json: Print the result as JSON.
    """
    values: dict[str, Any] = read_yaml(Path(config)) if config else {}
    given = {"data": data, "out": out, "methods": methods, "preset": preset, "seeds": seeds}
    values = merge(values, {key: value for key, value in given.items() if value is not None})
    if head is not None:
        values = merge(values, {"reader_settings": {"head": head}})
    source = config or "command line"
    for key in ("data", "out"):
        if key not in values:
            raise InputError(source, key, f"--{key} or the key {key} in --config", "neither")
    settings = build(RunConfig, merge(values, parse_assignments(set)), source)
    with log_to(_log_file(Path(settings.out))):
        return _run(settings, json)


def table(
    runs: Annotated[tuple[str, ...], tyro.conf.Positional],
    format: Literal["md", "csv", "latex", "html", "json"] = "md",
    layout: str = "comparison",
    published: bool = False,
) -> int:
    """Print a table of finished runs on the same frames.

    Several runs make one table: other seeds of the same settings join, other settings are rows of their own.

    Args:
        runs: Folders of the runs.
        format: Markdown, CSV, LaTeX (booktabs), a page of HTML, or JSON.
        layout: Which table: comparison, speed (latency, throughput, stages), cost (storage, training), or the paper's:
            paper-1 (all methods), paper-3 (INSTA and ours), paper-4 (what an expression may change: a run each).
        published: Add columns with the figures that papers printed, where a layout has some.
    """
    render: Callable[..., str] = resolve(get("reports", "table-text").implementation)
    print(render([Path(run) for run in runs], format, layout, published))
    return 0


def list_(
    what: Annotated[
        Literal["methods", "presets", "metrics", "profiles", "datasets", "reports", "benchmarks", "commands"],
        tyro.conf.Positional,
    ],
    json: bool = False,
) -> int:
    """List what is installed: methods, presets, metrics, their profiles, readers, reports, benchmarks, commands.

    Args:
        what: What to list.
        json: Print JSON with everything known of each.
    """
    group: Group = "methods" if what == "presets" else what
    entries = []
    for name, plugin in discover(group).items():
        entry: dict[str, Any] = {"name": name, "origin": plugin.origin, "error": plugin.error}
        if plugin.spec is not None:
            entry = {**entry, **asdict(plugin.spec), "name": name}
        entries.append(entry)
    if what == "presets":
        entries = [
            {
                "name": f"{entry['name']} {preset}",
                "summary": _settings_line(values),
                "settings": values,
                "error": "",
            }
            for entry in entries
            for preset, values in entry.get("presets", {}).items()
        ]
    if json:
        _print_json(entries)
        return 0
    width = max((len(entry["name"]) for entry in entries), default=0)
    for entry in entries:
        text = f"broken: {entry['error']}" if entry["error"] else entry["summary"]
        print(f"{entry['name']:<{width}}  {text}")
    return 0


def bench(
    part: Annotated[str, tyro.conf.Positional],
    quick: bool = False,
    tradeoffs: bool = False,
    out: PathText = None,
    json: bool = False,
) -> int:
    """Measure the speed of a part of headbench itself on this machine.

    Times are the least of many runs, beside an anchor timed in the same run, and each table says whether they are
    processor times or by the clock, and of how many threads; compare ratios, not milliseconds, between machines.

    Args:
        part: What to measure: splats, or what `headbench list benchmarks` shows.
        quick: Fewer sizes, fewer runs.
        tradeoffs: Instead of speed alone, what settings that give up accuracy for speed buy.
        out: Also write the results to this JSON file.
        json: Print JSON instead of tables.
    """
    return _measure(part, "tradeoffs" if tradeoffs else "speed", quick, out, json)


def stress(
    part: Annotated[str, tyro.conf.Positional], quick: bool = False, out: PathText = None, json: bool = False
) -> int:
    """Try a part of headbench at numerical extremes and print each case, what is expected and what came out.

    Exit code 1 where a case does not behave as expected.

    Args:
        part: What to try: splats, or what `headbench list benchmarks` shows.
        quick: Fewer cases where there are many.
        out: Also write the results to this JSON file.
        json: Print JSON instead of the table.
    """
    return _measure(part, "stress", quick, out, json)


COMMANDS: dict[str, Callable[..., int]] = {
    "demo": demo,
    "synth": synth,
    "run": run,
    "table": table,
    "list": list_,
    "bench": bench,
    "stress": stress,
}


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    # OpenMP's workers spin by default while they wait. On a machine with any other work that makes several
    # threads many times slower than one, so let them sleep; read once, when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    words = sys.argv[1:] if arguments is None else arguments
    try:
        offered = offered_commands()
        group = offered.get(words[0]) if words else None
        if isinstance(group, dict):
            return _call(group, f"headbench {words[0]}", f"What to {words[0]}.", words[1:])
        description = "Benchmark of animatable 3D head avatars. Start with `headbench demo`."
        return _call({**with_groups(offered), **COMMANDS}, "headbench", description, words)
    except HeadbenchError as error:
        print(f"headbench: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("headbench: interrupted; start it again to continue", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has gone (`headbench list methods | head`): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno not in WRITE_FAULTS:
            raise
        where = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or str(error)
        remedy = "Make room (or let it be written) and start again."
        print(
            f"headbench: {where}expected a file that can be written, found: {reason}. {remedy}",
            file=sys.stderr,
        )
        return EXIT_BAD_INPUT


def _call(commands: dict[str, Callable[..., int]], prog: str, description: str, words: list[str]) -> int:
    return tyro.extras.subcommand_cli_from_dict(
        commands, prog=prog, description=description, args=words, config=(tyro.conf.FlagCreatePairsOff,)
    )


def _synthesise(arguments: dict[str, Any]) -> None:
    make = resolve(get("datasets", "synthetic").implementation)
    with progress("capture") as report:
        make(**arguments, progress=report)


def _run(config: RunConfig, as_json: bool, **record: Any) -> int:
    rows = run_comparison(config, **record)
    failed = rows[rows["status"] == "failed"]
    if as_json:
        failures = sorted(set(failed["method"]))
        _print_json({"out": config.out, "failed": failures, "means": _means(Path(config.out))})
    else:
        table((config.out,))
        print(f"\nPictures, tables and everything else: {config.out}")
    return EXIT_FAILED_CELL if len(failed) else 0


def _means(run_folder: Path) -> list[dict[str, Any]]:
    """Numbers of the comparison table, so that a machine reads what a person does; None where there is none."""
    render: Callable[..., str] = resolve(get("reports", "table-text").implementation)
    means = []
    for line in csv.DictReader(io.StringIO(render([run_folder], "csv"))):
        for column in (name.removesuffix("/status") for name in line if name.endswith("/status")):
            task, _, metric = column.rpartition("/")
            means.append(
                {
                    "task": task,
                    "method": line["method"],
                    "metric": metric,
                    "value": float(line[column]) if line[column] else None,
                    "status": line[f"{column}/status"],
                }
            )
    return means


def _measure(part: str, kind: str, quick: bool, out: str | None, as_json: bool) -> int:
    spec = get("benchmarks", part)
    function = getattr(spec, kind)
    if not function:
        raise InputError("command line", "part", f"a benchmark with {kind}", f"{part}, which has none")
    with log_to(None), progress(kind) as report:
        findings: Findings = resolve(function)(quick, report)
    if out is not None:
        write_json(Path(out), findings.data)
    if as_json:
        _print_json(findings.data)
    else:
        print(findings.text)
    return 0 if findings.passed else EXIT_FAILED_CELL


def _log_file(out: Path) -> Path | None:
    """Where to log; None where the folder cannot be made, which the run then reports properly."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError):
        return None
    return out / "run.log" if os.access(out, os.W_OK) else None


def _settings_line(values: dict[str, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in values.items())


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, default=plain))


if __name__ == "__main__":
    sys.exit(main())
