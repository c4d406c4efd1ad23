"""The command line. It composes the packages through the registry; commands hold no logic of theirs."""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .commands import check_known, exit_code, offered_commands, prepare_streams, show, with_groups
from .configuration import build, merge, parse_assignments
from .errors import EXIT_CODES, ExitCode, HeadbenchError, InputError, Interruption
from .io.documents import read_yaml
from .io.files import check_writable, plain, prepare_folder, write_json
from .io.lock import locked
from .machine import check_device
from .progress import log_to, progress
from .registry import Group, discover, get, resolve
from .runner.config import (
    DemoConfig,
    RunConfig,
    demo_run_config,
    parse_size,
    resolve_methods,
    resolve_metrics,
)
from .specs import Findings

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
    prepare_folder(Path(out))
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
    prepare_folder(Path(out))
    with log_to(None), locked(Path(out), beside=True):  # a capture is made in an empty folder
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
    show(out)
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
    show(render([Path(run) for run in runs], format, layout, published))
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
            entry = {
                **entry,
                **{key: _reference(value) for key, value in asdict(plugin.spec).items()},
                "name": name,
            }
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
    lines = []
    for entry in entries:
        text = f"broken: {entry['error']}" if entry["error"] else entry["summary"]
        lines.append(f"{entry['name']:<{width}}  {text}")
    show("\n".join(lines))
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
    "run": run,
    "table": table,
    "synth": synth,
    "list": list_,
    "bench": bench,
    "stress": stress,
}


def main(arguments: list[str] | None = None) -> int:
    """Run a command line, by default the process's own; returns the exit code, one of `ExitCode`."""
    # OpenMP's workers spin by default while they wait. On a machine with any other work that makes several
    # threads many times slower than one, so let them sleep; read once, when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    prepare_streams()
    words = sys.argv[1:] if arguments is None else arguments
    try:
        try:
            return _call(words)
        except BrokenPipeError:
            if not _reader_has_gone():
                raise
            return ExitCode.OK  # `headbench --help | head -1`: not an error of ours
        finally:
            show(end="")  # what is still buffered, here, where an error can be reported
    except HeadbenchError as error:
        return _fail(str(error), ExitCode.BAD_INPUT)
    except KeyboardInterrupt as error:
        ended = error if isinstance(error, Interruption) else Interruption(signal.SIGINT)
        return _fail(str(ended), ended.code)
    except OSError as error:
        return _fail(_described(error), ExitCode.BAD_INPUT)
    except Exception:  # noqa: BLE001
        traceback.print_exc()
        return _fail("unexpected error; please report it with the lines above", ExitCode.UNEXPECTED)


def _fail(message: str, code: ExitCode) -> ExitCode:
    print(f"headbench: {message}", file=sys.stderr)
    return code


def _described(error: OSError) -> str:
    """An error of the system in one line: the file, the reason, and what to do where that is not obvious."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
    remedy = ". Make room (or let it be written) and start again." if full else ""
    return f"{'' if error.filename is None else f'{error.filename}: '}{reason}{remedy}"


def _reader_has_gone() -> bool:
    """Whether standard output is a pipe that nobody reads any longer."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _call(words: list[str]) -> int:
    """Call the command that the words of the command line name."""
    if words[:1] == ["--version"]:
        show(f"headbench {version('headbench')}")
        return ExitCode.OK
    offered = {**offered_commands(), **COMMANDS}
    check_known(words, offered)
    first = ("demo", "run", "table")  # what a newcomer needs
    commands = with_groups({name: offered[name] for name in (*first, *sorted(offered.keys() - set(first)))})
    description = "Benchmark of animatable 3D head avatars. Start with `headbench demo`."
    description += f" `headbench --version` prints the version.\n\n{EXIT_CODES}"
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    return tyro.extras.subcommand_cli_from_dict(
        commands, prog="headbench", description=description, args=words, config=config
    )


def _synthesise(arguments: dict[str, Any]) -> None:
    make = resolve(get("datasets", "synthetic").implementation)
    with progress("capture") as report:
        make(**arguments, progress=report)


def _run(config: RunConfig, as_json: bool, **record: Any) -> int:
    from .runner.run import run as run_comparison

    rows = run_comparison(config, **record)
    if as_json:
        _print_json({"out": config.out, "failed": rows.failed, "means": _means(Path(config.out))})
    else:
        table((config.out,))
        show(f"\nPictures, tables and everything else: {config.out}")
    return ExitCode.NEGATIVE if rows.failed else ExitCode.OK


def _means(run_folder: Path) -> list[dict[str, Any]]:
    """Numbers of the comparison table, so that a machine reads what a person does; None where there is none."""
    render: Callable[..., str] = resolve(get("reports", "table-text").implementation)
    table = json.loads(render([run_folder], "json"))
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


def _measure(part: str, kind: str, quick: bool, out: str | None, as_json: bool) -> int:
    spec = get("benchmarks", part)
    function = getattr(spec, kind)
    if not function:
        raise InputError("command line", "part", f"a benchmark with {kind}", f"{part}, which has none")
    if out is not None:
        check_writable(Path(out), "--out")
    with log_to(None), progress(kind) as report:
        findings: Findings = resolve(function)(quick, report)
    if out is not None:
        write_json(Path(out), findings.data)
    if as_json:
        _print_json(findings.data)
    else:
        show(findings.text)
    return exit_code(findings)


def _log_file(out: Path) -> Path | None:
    """Where to log; None where the folder cannot be made, which the run then reports properly."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError):
        return None
    return out / "run.log" if os.access(out, os.W_OK) else None


def _reference(value: Any) -> Any:
    """Functions and classes as "package.module:name"."""
    return f"{value.__module__}:{value.__qualname__}" if callable(value) else value


def _settings_line(values: dict[str, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in values.items())


def _print_json(value: Any) -> None:
    show(json.dumps(value, indent=1, default=plain))


if __name__ == "__main__":
    from .start import main as start

    sys.exit(start())
