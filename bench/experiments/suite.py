"""The suite: its conditions, and a run for each subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

from ..comparison import closing, presets_of_methods
from ..condition import PLAIN, Condition, Named
from ..contracts import Progress, no_progress
from ..engine.config import (
    RunConfig,
    coded_conditions,
    default_names,
    parse_size,
    resolve_cells,
    resolve_methods,
    resolve_metrics,
)
from ..engine.plan import check_settings
from ..engine.run import run
from ..errors import InputError
from ..executors.settings import ExecutionOptions, check_executor
from ..io.files import write_text
from ..registry import discover
from ..specs import CommandResult, MethodSpec, command
from .extremes import ExtremesSettings, extremes_run
from .specs import AS_TRACKED, EQUAL, LARGE_RUN, LEVEL, RUN, SEEDS_RUN, TRACKED

SEED = 39_000
"""Seed of the suite's captures. Methods are tuned on captures with seeds below 10,000 (`docs/explanation/suite.md`)."""

ALL, NONE = "all", "none"

EQUAL_TO = "ga"
TRACKED_METHODS = ("ga", "gbs", "ours", "ours-plus")
"""Default methods of the conditions `TRACKED` and `LEVEL`."""


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the synthetic subjects of the suite, trains and measures methods on all of them, and writes
    result tables.

    Subjects differ in shape, skin, hair and performance. Each subject has a separate run, so that subjects can be measured on
    different machines. If it is interrupted, the same command continues it. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """Preset, as for `headbench run`, whose help lists the presets."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: tuple[str, ...] = ()
    """Train a method with these parts left out or changed, too, each as a condition of the run (`headbench list methods --json` has
    their names and settings); or "all" those of ours."""

    tracked: tuple[str, ...] = ()
    """Methods trained a second time, on tracking estimated from the images as by `headbench track`, as condition `tracked` of
    the run; or "none". Default: those of ga, gbs, ours and ours-plus that run. Tracking takes about 1 second per timestep, once
    per subject, and each method one more training."""

    tracked_ablations: tuple[str, ...] = ()
    """Train ours with these parts left out or changed also under the conditions of --tracked and --levels, as conditions such
    as `no-lines-tracked`. This tests whether an effect depends on the tracking, for example lines-move-splats (Table 4 of the
    paper)."""

    levels: tuple[float, ...] = ()
    """Train the methods of --tracked a further time for each of these levels of simulated tracking errors (see `headbench synth`), as
    conditions such as `tracking-3`."""

    equal_iterations: tuple[str, ...] = ()
    """Methods trained a second time, with as many iterations as ga, as condition `equal-iterations`; or "none". Default: ours, if it
    runs and has another number of iterations."""

    subjects: int = 10
    """Number of the suite's subjects, from the first. Significant differences require 6 subjects for two
    methods, 8 for five methods, 9 for ten ablations."""

    first: int = 1
    """Begin with this subject, counted from 1. Earlier ones may have been measured on another machine."""

    large: int = 2
    """At most this many subjects, from the first, are also rendered at twice the size, in separate runs and tables, without
    conditions. Each takes about half a processor hour to render, twice as long as at the usual size."""

    repeated: int = 0
    """At most this many subjects, from the first, are also trained with two further seeds, without conditions, in separate
    runs; `results.md` then has the variance between and within subjects."""

    extremes: int = 10
    """Avatars of at most this many subjects, from the first, are also rendered in new poses and views, as by `headbench run
    extremes`. A frame that exceeds a limit is a result, not a failure."""

    cameras: int = 16
    """Number of cameras, including the held-out one."""

    timesteps: int = 96
    """Number of timesteps of each subject; a quarter is held out."""

    size: str = "275x401"
    """Width x height of the images in pixels."""

    performance: Literal["parts", "natural"] = "natural"
    """As for `headbench synth`; with `natural` each subject has another choreography."""

    dynamics: float = 1.0
    """As for `headbench synth`."""

    tracking_error: float = 0.0
    """As for `headbench synth`."""

    tracker: Literal["per-frame", "video"] = "video"
    """As for `headbench synth`."""

    hair_lag: float = 0.0
    """As for `headbench synth`."""

    camera_colour: float = 0.0
    """As for `headbench synth`."""

    correctives: float = 0.0
    """As for `headbench synth`."""

    held_out_cameras: tuple[str, ...] = ()
    """Cameras of the novel views, instead of the frontal one alone, for example `222200037 221501007 222200041`: the frontal one,
    one at a side and a low one."""

    def __post_init__(self) -> None:
        """Refuse invalid sizes and names."""
        parse_size(self.size)
        for option in ("tracked", "equal_iterations"):
            names = getattr(self, option)
            if NONE in names and len(names) > 1:
                where = f"--{option.replace('_', '-')}"
                raise InputError("command line", where, f"names of methods, or {NONE}", " ".join(names))
        for name, least in (("large", 0), ("repeated", 0), ("extremes", 0), ("first", 1)):
            if getattr(self, name) < least:
                raise InputError("command line", f"--{name}", f"at least {least}", str(getattr(self, name)))
        if self.first > self.subjects:
            raise InputError(
                "command line", "--first", f"at most --subjects, {self.subjects}", str(self.first)
            )
        if any(not 0 < level <= 4 for level in self.levels):
            raise InputError(
                "command line", "--levels", "above 0 and at most 4", " ".join(map(str, self.levels))
            )

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()

    def tracked_of(self, methods: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the run's methods with the condition `TRACKED`."""
        if self.tracked:
            return tuple(name for name in self.tracked if name != NONE)
        return tuple(name for name in TRACKED_METHODS if name in methods)


OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Regions of the frame with separate tables."""
FACE_CROP = "lpips-face"
"""The metric that is measured besides those of every run."""
OF_CAPTURES = (
    *("subjects", "cameras", "timesteps", "performance", "dynamics", "tracking_error", "tracker"),
    *("hair_lag", "camera_colour", "correctives"),
)
"""Settings of the suite that are those of `headbench synth`."""


@command("run suite", group="compare", writes="out")
def suite(settings: SuiteSettings, progress: Progress = no_progress) -> CommandResult:
    """Run the benchmark suite: ten synthetic subjects, all methods; takes hours.

    Every subject has its own run, with conditions. Subjects run one after another, and the tables of ``results.md`` are written
    after each. Images of twice the size have separate captures and runs, since means over subjects need equal sizes.
    """
    from ...datasets.synthetic.capture import synthesize  # imports torch
    from ...reports.suite.suite import suite_report

    out, execution = Path(settings.out), settings.execution
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
    )
    coded = (PLAIN, *coded_conditions(methods))
    config = replace(plain, conditions=(*coded, *_conditions(settings, plain)))
    cells = resolve_cells(config)
    resolve_metrics(config)
    check_executor(execution, config.device)
    check_settings(cells)
    width, height = parse_size(settings.size)
    large = replace(plain, data=str(out / "capture-large"), out=str(out / LARGE_RUN), conditions=coded)
    seeds = tuple(max(settings.seeds) + further for further in (1, 2))
    more_seeds = replace(plain, out=str(out / SEEDS_RUN), seeds=seeds, conditions=(PLAIN,))
    failed: list[str] = []
    ends: list[str] = []
    runs: list[Path] = []
    for place in range(settings.first - 1, settings.subjects):
        parts = [(config, (width, height))]
        if place < settings.repeated:
            parts.append((more_seeds, (width, height)))
        if place < settings.large:
            parts.append((large, (2 * width, 2 * height)))
        for planned, size in parts:
            (capture,) = synthesize(
                planned.data,
                only=place,
                size=size,
                seed=SEED,
                **{name: getattr(settings, name) for name in OF_CAPTURES},
                execution=execution,
                progress=progress,
            )
            of_subject = replace(planned, data=str(capture), out=str(Path(planned.out) / f"{place + 1:02d}"))
            rows = run(of_subject, execution).rows
            runs.append(Path(of_subject.out))
            failed += rows.failed
            trained = any(not method.spec.trivial for method, _ in cells)
            if planned is config and trained and place < settings.extremes:
                how = {name: getattr(settings, name) for name in ("executor", "workers", "set")}
                extremes_run(ExtremesSettings(of_subject.out, **how), progress)
            ends.append(closing(runs[-1], rows))
            write_text(out / "results.md", suite_report(out, OURS))
    data = {"out": out, "runs": runs, "failed": sorted({*failed})}
    return CommandResult(
        "\n\n".join([f"Tables of all results: {out / 'results.md'}", *ends]), data, not failed
    )


def _splits(settings: SuiteSettings) -> dict[str, list[str]]:
    """Settings of the reader that hold out the requested cameras and the usual sequences; none for the capture's own splits."""
    from ...datasets.synthetic.performance import HELD_OUT, share_out
    from ...datasets.synthetic.plan import serials

    held_out = settings.held_out_cameras
    if not held_out:
        return {}
    known = serials(settings.cameras)
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


def _conditions(settings: SuiteSettings, config: RunConfig) -> list[Condition]:
    """All conditions except the plain comparison. Those without methods are omitted, since they would apply to all methods."""
    resolved = resolve_methods(config)
    specs = {method.spec.name: method.spec for method in resolved}
    tracked = settings.tracked_of(tuple(specs))
    converted = tuple(name for name, spec in specs.items() if spec.conversion == "published")
    conditions = [
        Condition(AS_TRACKED, converted, as_tracked=True),
        Condition(TRACKED, tracked, clip=Named(TRACKED)),
    ]
    conditions += [
        Condition(LEVEL.format(level), tracked, clip=Named("tracking-error", {"level": level}))
        for level in settings.levels
    ]
    iterations = {
        method.spec.name: method.budget.iterations for method in resolved if not method.spec.trivial
    }
    if (count := iterations.get(EQUAL_TO)) is not None:
        others = (OURS,) if iterations.get(OURS) not in (None, count) else ()
        asked = settings.equal_iterations or others
        names = tuple(name for name in asked if name != NONE)
        conditions.append(Condition(EQUAL, names, {"budget": {"iterations": count}}))
    conditions = [condition for condition in conditions if condition.methods]
    estimated = [condition for condition in conditions if condition.clip and OURS in condition.methods]
    ours = {name: spec for name, spec in specs.items() if name == OURS}
    crossed = _ablations("--tracked-ablations", settings.tracked_ablations, ours)
    if crossed and not estimated:
        expected = f"{OURS} among those of --tracked, which --tracked-ablations are compared with"
        raise InputError("command line", "--tracked", expected, " ".join(tracked) or NONE)
    return [
        *conditions,
        *_ablations("--ablations", settings.ablations, specs),
        *(
            replace(ablation, name=f"{ablation.name}-{condition.name}", clip=condition.clip)
            for ablation, condition in product(crossed, estimated)
        ),
    ]


def _ablations(option: str, asked: Sequence[str], specs: dict[str, MethodSpec]) -> list[Condition]:
    """The requested ablations in the order of the methods' specs; the one of ours if several methods have the name."""
    if ALL in asked and OURS not in specs:
        expected = f"{OURS} among them, whose {option} are all"
        raise InputError("command line", "--methods", expected, ", ".join(specs))
    conditions: dict[str, Condition] = {}
    for spec in sorted(specs.values(), key=lambda spec: spec.name == OURS):
        conditions |= {
            name: Condition(name, (spec.name,), dict(changes)) for name, changes in spec.ablations.items()
        }
    for name in asked:
        if name not in (*conditions, ALL):
            raise InputError("command line", option, f"{', '.join(conditions)} or {ALL}", name)
    return [
        each
        for name, each in conditions.items()
        if name in asked or (ALL in asked and each.methods == (OURS,))
    ]
