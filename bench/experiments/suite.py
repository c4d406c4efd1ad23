"""The suite: its conditions, and a run for each subject."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ..comparison import closing, presets_of_methods
from ..condition import PLAIN, Condition
from ..contracts import Progress, no_progress
from ..engine.config import (
    RunConfig,
    coded_conditions,
    default_names,
    parse_size,
    resolve_cells,
    resolve_methods,
    resolve_metrics,
    with_methods,
)
from ..engine.plan import check_settings
from ..engine.run import run
from ..errors import InputError
from ..executors.settings import ExecutionOptions, check_executor
from ..io.files import write_text
from ..options import iterations, numbers
from ..registry import discover
from ..specs import CommandResult, MethodSpec, command
from .extremes import ExtremesSettings, extremes_run
from .specs import MOVED_LINES, RECORDED_RUN, RUN, SEEDS_RUN

SEED = 41_000
"""Seed of the suite's captures. Methods are tuned on captures with seeds below 10,000 (`docs/explanation/suite.md`)."""

ALL = "all"
OURS, SEEDS_METHODS = "ours", ("ga", "ours")
HELD_OUT_CAMERAS = ("222200037", "221501007", "222200041")
"""The frontal camera, one at a side and a low one."""
RECORDED: Mapping[str, Any] = {
    "tracking_error": 1.0,
    "correctives": 1.0,
    "hair_lag": 1.0,
    "camera_colour": 1.0,
}
"""Settings of captures as recordings are; they are 0 for exact captures."""


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the synthetic subjects of the suite, trains and measures methods on all of them, and writes
    result tables.

    Subjects differ in shape, skin, hair and performance. Each has two captures, an exact one and one with the errors of recordings,
    with a separate run each, so that subjects can be measured on different machines. If it is interrupted, the same command continues it. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """Preset, as for `headbench run`, whose help lists the presets."""

    iterations: tuple[str, ...] = ()
    """METHOD=NUMBER: iterations of methods, instead of those of the preset."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: tuple[str, ...] = ()
    """Train a method with these parts left out or changed, too, each as a condition of the run (`headbench list methods --json` has
    their names and settings); or "all" those of ours. Default: lines-move-splats, which an endpoint has, if ours runs."""

    subjects: int = 10
    """Number of the suite's subjects, from the first. The tests of the endpoints require 8."""

    first: int = 1
    """Begin with this subject, counted from 1. Earlier ones may have been measured on another machine."""

    repeated: int = 0
    """On the captures as recordings are of at most this many subjects, from the first, ga and ours are also trained with a further
    seed, in separate runs; `results.md` then has the variance between and within subjects."""

    extremes: int = 10
    """Avatars of at most this many subjects, from the first, are also rendered in new poses and views, as by `headbench run
    extremes`. A frame that exceeds a limit is a result, not a failure."""

    cameras: int = 16
    """Number of cameras, including the held-out ones."""

    timesteps: int = 96
    """Number of timesteps of each subject; a quarter is held out."""

    size: str = "275x401"
    """Width x height of the images in pixels."""

    performance: Literal["parts", "natural"] = "natural"
    """As for `headbench synth`; with `natural` each subject has another choreography."""

    dynamics: float = 2.0
    """As for `headbench synth`."""

    held_out_cameras: tuple[str, ...] = ()
    """Cameras of the novel views; default: the frontal one, one at a side and a low one, or the frontal one alone if --cameras makes
    too few."""

    plan: tuple[str, ...] = ()
    """Make nothing, and print the hours that the suite would take, and the differences that it would find. NAME=MICROSECONDS of
    processor time: of an iteration of each method, of `capture`, a frame of a capture, and of `frame`, to render and measure a frame
    of an avatar."""

    def __post_init__(self) -> None:
        """Refuse invalid sizes and numbers."""
        parse_size(self.size)
        for name, least in (("repeated", 0), ("extremes", 0), ("first", 1)):
            if getattr(self, name) < least:
                raise InputError("command line", f"--{name}", f"at least {least}", str(getattr(self, name)))
        for name in ("methods", "seeds"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise InputError("command line", f"--{name}", "each once", ", ".join(map(str, values)))
        if min(self.seeds, default=0) < 0:
            raise InputError("command line", "--seeds", "whole numbers from 0", str(min(self.seeds)))
        if self.first > self.subjects:
            raise InputError(
                "command line", "--first", f"at most --subjects, {self.subjects}", str(self.first)
            )
        iterations(self.iterations)
        numbers(self.plan, "--plan")

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()


REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Regions of the frame with separate tables."""
FACE_CROP = "lpips-face"
"""The metric that is measured besides those of every run."""
OF_CAPTURES = ("subjects", "cameras", "timesteps", "performance", "dynamics")
"""Settings of the suite that are those of `headbench synth`."""


@command("run suite", group="compare", writes="out")
def suite(settings: SuiteSettings, progress: Progress = no_progress) -> CommandResult:
    """Run the benchmark suite: synthetic subjects, exact and as recordings are, all methods; takes hours.

    Every subject has two captures with a run each. Subjects run one after another, and the tables of ``results.md`` are written
    after each.
    """
    from ...datasets.synthetic.capture import synthesize  # imports torch
    from ...reports.suite.suite import suite_report

    out, execution = Path(settings.out), settings.execution
    runs = planned_runs(settings)
    for config in runs.values():
        check_settings(resolve_cells(config))
        resolve_metrics(config)
    check_executor(execution, runs[RUN].device)
    if settings.plan:
        return _plan(settings, runs)
    failed: list[str] = []
    ends: list[str] = []
    done: list[Path] = []
    for place in range(settings.first - 1, settings.subjects):
        for base, config in runs.items():
            if base == SEEDS_RUN and place >= settings.repeated:
                continue
            (capture,) = synthesize(
                config.data,
                only=place,
                size=parse_size(settings.size),
                seed=SEED,
                **{name: getattr(settings, name) for name in OF_CAPTURES},
                **(dict.fromkeys(RECORDED, 0.0) if base == RUN else RECORDED),
                execution=execution,
                progress=progress,
            )
            of_subject = replace(config, data=str(capture), out=str(Path(config.out) / f"{place + 1:02d}"))
            rows = run(of_subject, execution).rows
            done.append(Path(of_subject.out))
            failed += rows.failed
            specs = [method.spec for method in resolve_methods(config)]
            trained = tuple(spec.name for spec in specs if not spec.trivial and spec.name not in rows.failed)
            if base == RUN and trained and place < settings.extremes:
                how = {name: getattr(settings, name) for name in ("executor", "workers", "set")}
                extremes_run(ExtremesSettings(of_subject.out, methods=trained, **how), progress)
            ends.append(closing(done[-1], rows))
        write_text(out / "results.md", suite_report(out, OURS))
    data = {"out": out, "runs": done, "failed": sorted({*failed})}
    return CommandResult(
        "\n\n".join([f"Tables of all results: {out / 'results.md'}", *ends]), data, not failed
    )


def planned_runs(settings: SuiteSettings) -> dict[str, RunConfig]:
    """The configuration of each kind of run, for all subjects."""
    out = Path(settings.out)
    methods = settings.methods or tuple(
        name for name, plugin in discover("methods").items() if plugin.spec and plugin.spec.demo
    )
    plain = RunConfig(
        data=str(out / "capture"),
        out=str(out / RUN),
        methods=methods,
        preset=settings.preset,
        seeds=settings.seeds,
        regions=REGIONS,
        metrics=(*default_names("metrics"), FACE_CROP),
        reader_settings=_splits(settings),
        settings=iterations(settings.iterations),
    )
    specs = {method.spec.name: method.spec for method in resolve_methods(plain)}
    ablations = _ablations(settings.ablations or (MOVED_LINES,) * (OURS in specs), specs)
    recorded = replace(plain, data=str(out / "capture-recorded"), out=str(out / RECORDED_RUN))
    runs = {
        RUN: replace(plain, conditions=(PLAIN, *coded_conditions(methods), *ablations)),
        RECORDED_RUN: replace(recorded, conditions=(PLAIN, *ablations)),
    }
    if settings.repeated:
        again = {*SEEDS_METHODS} & {*specs} or {*specs}
        seeds = replace(recorded, out=str(out / SEEDS_RUN), seeds=(max(settings.seeds) + 1,))
        runs[SEEDS_RUN] = with_methods(seeds, again)
    return runs


def _splits(settings: SuiteSettings) -> dict[str, list[str]]:
    """Settings of the reader that hold out the requested cameras and the usual sequences; none for the capture's own splits."""
    from ...datasets.synthetic.performance import HELD_OUT, share_out
    from ...datasets.synthetic.plan import serials

    known = serials(settings.cameras)
    usual = HELD_OUT_CAMERAS if {*HELD_OUT_CAMERAS} < {*known} else ()
    held_out = settings.held_out_cameras or usual
    if not held_out:
        return {}
    if unknown := [name for name in held_out if name not in known]:
        expected = f"some of {', '.join(known)}, which --cameras {settings.cameras} makes"
        raise InputError("command line", "--held-out-cameras", expected, ", ".join(unknown))
    if len(set(held_out)) == len(known):
        raise InputError("command line", "--held-out-cameras", "fewer than all cameras", ", ".join(held_out))
    sequences = share_out(settings.timesteps, settings.performance)
    return {
        "held_out_cameras": list(held_out),
        "held_out_sequences": [name for name in sequences if name.startswith(HELD_OUT)],
    }


def _plan(settings: SuiteSettings, runs: Mapping[str, RunConfig]) -> CommandResult:
    """Processor hours of captures, trainings and frames by kind of run, and the differences that the endpoints would show."""
    from ...datasets.synthetic.performance import HELD_OUT, share_out
    from ...reports.suite.suite import power_table
    from ...reports.writers import pipe_table

    sequences = share_out(settings.timesteps, settings.performance)
    held_out = sum(n for name, n in sequences.items() if name.startswith(HELD_OUT))
    novel = len(_splits(settings).get("held_out_cameras", [""])) * (settings.timesteps - held_out)
    frames = novel + settings.cameras * held_out
    microseconds = numbers(settings.plan, "--plan")
    lines = [
        ["run", "what", "subjects", "number for each", "processor hours"],
        ["---", "---", "--:", "--:", "--:"],
    ]
    total, needed = 0.0, {"capture", "frame"}
    for base, config in runs.items():
        subjects = settings.subjects - settings.first + 1
        subjects = min(subjects, settings.repeated) if base == SEEDS_RUN else subjects
        parts = {} if base == SEEDS_RUN else {"capture": settings.cameras * settings.timesteps}
        cells = [cell for cell in resolve_cells(config) for _ in config.seeds]
        for method, condition in cells:
            if not (method.spec.trivial or condition.follows):
                parts[method.spec.name] = parts.get(method.spec.name, 0) + (method.budget.iterations or 0)
        parts["frame"] = len(cells) * frames
        needed |= {*parts}
        for name, count in parts.items():
            hours = subjects * count * microseconds.get(name, 0) / 3.6e9
            lines.append([base, name, str(subjects), str(count), f"{hours:.2f}"])
            total += hours
    if needed != {*microseconds}:
        expected, found = (", ".join(sorted(names)) for names in (needed, microseconds))
        raise InputError("command line", "--plan", f"microseconds of {expected}", found)
    lines.append(["all", "", "", "", f"{total:.2f}"])
    text = f"{pipe_table(lines)}\n\n{power_table(settings.subjects)}"
    return CommandResult(text, {"processor_hours": total})


def _ablations(asked: Sequence[str], specs: Mapping[str, MethodSpec]) -> list[Condition]:
    """The requested ablations in the order of the methods' specs; the one of ours if several methods have the name."""
    if ALL in asked and OURS not in specs:
        expected = f"{OURS} among them, whose --ablations are all"
        raise InputError("command line", "--methods", expected, ", ".join(specs))
    conditions: dict[str, Condition] = {}
    for spec in sorted(specs.values(), key=lambda spec: spec.name == OURS):
        conditions |= {
            name: Condition(name, (spec.name,), dict(changes)) for name, changes in spec.ablations.items()
        }
    for name in asked:
        if name not in (*conditions, ALL):
            raise InputError("command line", "--ablations", f"{', '.join(conditions)} or {ALL}", name)
    return [
        each
        for name, each in conditions.items()
        if name in asked or (ALL in asked and each.methods == (OURS,))
    ]
