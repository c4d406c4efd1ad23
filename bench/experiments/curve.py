"""``headbench run curve``: quality over training time, cameras, timesteps, images or tracking error, as conditions of a run."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import tyro

from ..condition import PLAIN, Condition, Named, part_of_text
from ..configuration import merge
from ..contracts import Avatar, Budget, Clip, Progress, no_progress
from ..engine.captures import PROGRAMS, check_trusted, open_run_clips, run_configuration
from ..engine.config import (
    ResolvedMethod,
    RunConfig,
    RunOptions,
    default_names,
    resolve_methods,
    with_methods,
)
from ..engine.plan import trained
from ..engine.run import run
from ..engine.scoring import TrainingView
from ..engine.store import Cell, RunFolder
from ..errors import InputError
from ..executors.settings import ExecutionOptions
from ..io.files import check_kind, check_name
from ..io.lock import locked
from ..options import DependentOptions, iterations
from ..registry import get, resolve
from ..specs import CommandResult, MethodSpec, command
from .held_out import CAMERA, TIMESTEPS, count_of, hold_out
from .specs import Over


@dataclass(frozen=True)
class SweepSettings(RunOptions, ExecutionOptions):
    """Quality against size and frame time of variants derived from a run's avatars without training."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write, a run folder itself; default: `sweep` in the folder of the run. The same sweep in it is continued."""

    methods: tuple[str, ...] = ()
    """Methods to derive from; default: all that provide variants."""

    variants: tuple[str, ...] = ()
    """Variants to derive, by name; default: all. The trained avatar itself is always measured."""

    frames: int | None = None
    """Maximum number of scored frames per subject and task, evenly spaced; default: that of the run."""

    task: str = "novel_view"
    """Task whose frames give the quality in the plot."""

    metric: str = ""
    """Metric of quality in the plot; default: the first of frames that the run has."""

    time: str = ""
    """Metric of frame time in the plot, in ms: latency_p50 (default), processor_time on a machine with other work."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")


@command("run sweep", group="compare")
def sweep_run(settings: SweepSettings, progress: Progress = no_progress) -> CommandResult:
    """Derive smaller and faster avatars without training, and measure them.

    The trained avatars are measured again with their variants, so that frame times are comparable. Writes
    ``points.csv`` and ``pareto.png`` into the run folder. A restart keeps existing measurements and adds
    variants.
    """
    execution, source = settings.execution, RunFolder(Path(settings.run))
    source.read_manifest()  # before a folder is created
    out = Path(settings.out) if settings.out else source.root / "sweep"
    check_kind(out, "a run")
    with locked(out):
        config, jobs = trained(source.root, settings.methods, settings, out)
        able = [job for job in jobs if job.method.spec.variants]
        unable = sorted({job.method.spec.name for job in jobs} - {job.method.spec.name for job in able})
        if not able or (settings.methods and unable):
            found = ", ".join(unable) or "none"
            raise InputError(settings.run, "methods", "methods that derive variants", found)
        methods: dict[str, dict[str, None]] = {}
        for job in able:
            derive = resolve(job.method.spec.variants)
            for variant in derive(job.cell.avatar, TrainingView(job.form.clip), job.device):
                name = check_name(variant.name, job.method.spec.variants, "name of a variant")
                methods.setdefault(name, {})[job.method.spec.name] = None
        for name in settings.variants:
            if name not in methods:
                raise InputError(
                    "sweep", "variants", f"a variant of these methods: {', '.join(methods)}", repr(name)
                )
        conditions = [
            Condition(name, tuple(names), derive=Named("variant", {"name": name}))
            for name, names in methods.items()
            if not settings.variants or name in settings.variants
        ]
        # Cost of avatars, independent of the run's metrics.
        costs = [name for name in default_names("metrics") if get("metrics", name).kind == "avatar"]
        metrics = dict.fromkeys((*config.metrics, *costs))
        config = replace(
            with_methods(config, {job.method.spec.name for job in able}),
            frames_per_task=config.frames_per_task if settings.frames is None else settings.frames,
            metrics=tuple(name for name in metrics if get("metrics", name).kind != "training"),
            conditions=(PLAIN, *conditions),
            source=settings.run,
        )
        clips = list({job.clip.subject: job.clip for job in able}.values())
        run(config, execution, clips=clips, is_locked=True, reports=False)
        from ...reports.pareto.command import pareto

        return pareto((str(out),), out, settings.task, settings.metric, settings.time)


def variant(method: MethodSpec, trained: Path, out: Path, clip: Clip, device: str, *, name: str) -> Avatar:
    """Create a named variant of a trained avatar, see `MethodSpec.variants`; the registered change "variant"."""
    names = []
    for each in resolve(method.variants)(trained, clip, device):
        if each.name == name:
            return each.make(out)  # type: ignore[no-any-return]
        names.append(each.name)
    raise InputError(trained, "variant", f"one of {', '.join(names)}", name)


MOST_TRACKING_ERROR = 4.0
"""Maximum level of `headbench synth`."""
FRACTIONS = ("1/16", "1/8", "1/4", "1/2", "1")
LEVELS = (0.0, 1.0, 2.0)
SECONDS, PICTURES = (5.0, 30.0, 120.0), (1, 4, 16)


@dataclass(frozen=True)
class CurveSettings(RunOptions, ExecutionOptions):
    """Quality against training time, cameras, timesteps, images or tracking error. Each method is trained with parts of them.

    Each part, number or level is a separate training. Quality is measured on training frames that are held out of every
    training, the same for all parts, never on test frames, unless --test asks for them."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write, a run folder itself; default: `curve` in the folder of the run, or `curve-cameras` and so on."""

    methods: tuple[str, ...] = ()
    """Methods to train; default: all but the trivial baselines."""

    over: Over = "budget"
    """What is varied: fractions of budget, cameras or timesteps; numbers of seconds of training or of images (pictures); or the
    tracking error of a synthetic capture, whose images stay the same."""

    iterations: tuple[str, ...] = ()
    """METHOD=NUMBER: iterations of the whole budgets, instead of those of the run. Only with `--over budget`."""

    fractions: tuple[str, ...] = ()
    """Parts of the method's budget, or of the training cameras or timesteps, above 0 and at most 1; default: 1/16 1/8 1/4 1/2
    1. Not with `--over tracking_error`."""

    seconds: tuple[float, ...] = ()
    """Training times for `--over seconds`; default: 5 30 120. Trainings with a time limit are not bitwise reproducible. Not
    with another `--over`."""

    pictures: tuple[int, ...] = ()
    """Numbers of training frames for `--over pictures`; default: 1 4 16. Not with another `--over`."""

    levels: tuple[float, ...] = ()
    """Levels for `--over tracking_error`, as for `headbench synth`; default: 0 1 2. Not with another `--over`."""

    camera: str = ""
    """Training camera to hold out; default: the one nearest to the mean position of the training cameras."""

    every: int = 8
    """Hold out one of this number of consecutive training timesteps."""

    test: bool = False
    """Measure on the test frames of the captures instead: new views, and new expressions at seen and unseen cameras. For results;
    choose no setting by them that is used on the same captures. Not with --camera or --every."""

    until_flat: bool = False
    """With `--over budget` or `--over seconds`: begin with the shortest training, and end a method's curve where twice the length gains
    less than 0.05 dB at training cameras, or the other cameras get worse: in the face if the captures have it."""

    frames: int = 100
    """Maximum number of scored frames of each subject, for the held-out camera and timesteps separately."""

    dependent = (
        DependentOptions(("levels",), "over", ("tracking_error",)),
        DependentOptions(("seconds",), "over", ("seconds",)),
        DependentOptions(("pictures",), "over", ("pictures",)),
        DependentOptions(("fractions",), "over", ("budget", "cameras", "timesteps")),
        DependentOptions(("iterations",), "over", ("budget",)),
        DependentOptions(("until_flat",), "over", ("budget", "seconds")),
        DependentOptions(("camera", "every"), "test", False),
    )

    def __post_init__(self) -> None:
        iterations(self.iterations)
        if len(set(self.parts)) != len(self.parts):
            raise ValueError(f"fractions: each once; found {' '.join(self.fractions)}")
        if len(set(self.levels)) != len(self.levels):
            raise ValueError(f"levels: each once; found {' '.join(map(str, self.levels))}")
        for name in ("seconds", "pictures"):
            values = getattr(self, name)
            if len(set(values)) != len(values) or not all(value > 0 for value in values):
                raise ValueError(f"{name}: numbers above 0, each once; found {' '.join(map(str, values))}")
        if not all(1e-3 <= value < 1e6 and float(f"{value:g}") == value for value in self.seconds):
            expected = "from 0.001 to below 1,000,000, with at most six digits"
            raise ValueError(f"seconds: {expected}; found {' '.join(map(str, self.seconds))}")
        if not all(0 <= level <= MOST_TRACKING_ERROR for level in self.levels):
            expected = f"from 0 to {MOST_TRACKING_ERROR:g}"
            raise ValueError(f"levels: {expected}; found {' '.join(map(str, self.levels))}")
        if self.every < 2:
            raise ValueError(f"every is {self.every}; at least 2")
        if self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parts(self) -> tuple[Fraction, ...]:
        """The fractions as numbers, rising. Raises `ValueError` unless they are numbers in (0, 1]."""
        return tuple(sorted(map(_part, self.fractions or FRACTIONS)))

    @property
    def tracking_errors(self) -> tuple[float, ...]:
        """The levels, rising."""
        return tuple(sorted(self.levels or LEVELS))


def _part(text: str) -> Fraction:
    return part_of_text(text, "fractions")


log = logging.getLogger(__name__)
METRICS: tuple[str, ...] = ("psnr", "ssim", "lpips", "storage", "primitives")
"""Metrics of a curve, independent of the run's, as defined by the canonical profile."""
COSTS = ("training_processor", "training_time", "training_memory")
"""Training costs that are measured as well."""


@command("run curve", group="compare")
def curve_run(settings: CurveSettings, progress: Progress = no_progress) -> CommandResult:
    """Measure quality against training time, cameras, timesteps or tracking error.

    Writes ``curve.csv`` and ``curve.png`` into the run folder of all trainings. A restart keeps finished
    trainings; an interrupted training starts over, since its time is measured.
    """
    execution, source = settings.execution, RunFolder(Path(settings.run))
    manifest = source.read_manifest()
    manifest.check_done(source.manifest)  # before a folder is created
    if manifest.configuration.clip or manifest.configuration.source:
        expected = "a run that trained on whole captures"
        raise InputError(source.manifest, "configuration", expected, "one of a curve or of a sweep")
    name = "curve" if settings.over == "budget" else f"curve-{settings.over.replace('_', '-')}"
    out = Path(settings.out) if settings.out else source.root / name
    check_kind(out, "a run")
    if (out / "run.json").is_file() if settings.until_flat else any(out.glob("*/run.json")):
        expected = f"a new folder, or a curve {'with' if settings.until_flat else 'without'} --until-flat"
        raise InputError(out, "--out", expected, f"one {'without' if settings.until_flat else 'with'} it")
    wanted = _wanted(settings, source)
    with locked(out):
        config, opened = open_run_clips(source.root, settings, out=out)
        how = {"test": True} if settings.test else {}
        held = Named("hold-out", {"camera": settings.camera, "every": settings.every, **how})
        config = replace(
            with_methods(_lengthened(config, settings), _names(wanted)),
            clip=held,
            frames_per_task=settings.frames,
            metrics=(*METRICS, *COSTS),
            metric_profiles=("canonical",),
            regions=None,
            source="",
        )
        clips: list[Clip] = [hold_out(clip, config, **held.parameters) for clip in opened]
        tasks = tuple(task for task in (CAMERA, TIMESTEPS) if all(task in clip.splits for clip in clips))
        if not tasks:
            raise InputError(settings.run, "--test", "captures with test frames of one task", "none")
        if settings.until_flat and TIMESTEPS not in tasks:
            expected = "scored frames of training cameras, whose gain ends a curve"
            raise InputError(settings.run, "--until-flat", expected, f"frames of {CAMERA} alone")
        config = replace(config, tasks=tasks)
        planned = tuple(conditions(settings, wanted, clips))

        def measure(config: RunConfig) -> None:
            _drop_interrupted(Path(config.out))
            unchecked = bool(manifest.unchecked)  # for a run whose captures have errors
            run(config, execution, clips=clips, is_locked=True, reports=False, unchecked=unchecked)

        from ...reports.curve.curve import curve_report, rising

        if not settings.until_flat:
            measure(replace(config, conditions=planned))
            return curve_report([out], settings.over, out)
        parts: list[Path] = []
        left = set(_names(wanted))
        for condition in reversed(planned):
            names = left & {*(condition.methods or left)}
            if names:
                parts.append(out / condition.name)
                part = replace(config, conditions=(replace(condition, methods=()),), out=str(parts[-1]))
                measure(with_methods(part, names))
                left -= names - rising(parts, settings.over)
        return curve_report(parts, settings.over, out)


def conditions(
    settings: CurveSettings, methods: Sequence[ResolvedMethod], clips: Sequence[Clip]
) -> Iterator[Condition]:
    """Conditions of the trainings; the full one is first, since start-up time, such as imports, affects it least.

    Of fractions with the same amount, only the largest is used.
    """
    if settings.over == "tracking_error":
        for level in settings.tracking_errors:
            yield Condition(f"tracking-{level:g}", clip=Named("tracking-error", {"level": level}))
        return
    if settings.over == "seconds":
        for seconds in sorted(settings.seconds or SECONDS, reverse=True):
            yield Condition(f"seconds-{seconds:g}", budget=f"{seconds:g} s")
        return
    if settings.over == "pictures":
        yield from _pictures(sorted(settings.pictures or PICTURES, reverse=True), clips)
        return
    texts = [str(part) for part in reversed(settings.parts)]
    if settings.over == "budget":
        for text in texts:
            part = Condition(_named(text), budget=text)
            larger = [Condition(_named(other), budget=other) for other in texts[: texts.index(text)]]
            chosen = [
                m.spec.name
                for m in methods
                if all(part.part_of(m.budget) != each.part_of(m.budget) for each in larger)
            ]
            if chosen:
                yield replace(part, methods=() if len(chosen) == len(methods) else tuple(chosen))
        return
    counts: set[tuple[int, ...]] = set()
    what = settings.over.removesuffix("s")
    for text in texts:
        wholes = [len({getattr(key, what) for key in clip.splits["train"]}) for clip in clips]
        count = tuple(count_of(whole, text) for whole in wholes)
        if count not in counts:
            counts.add(count)
            yield Condition(f"{settings.over}-{_named(text)}", clip=Named(settings.over, {"part": text}))


def _pictures(counts: Sequence[int], clips: Sequence[Clip]) -> Iterator[Condition]:
    """Conditions of numbers of images; of numbers that no capture exceeds, only the largest."""
    whole = max(len(clip.splits["train"]) for clip in clips)
    seen = set()
    for count in counts:
        if min(count, whole) not in seen:
            seen.add(min(count, whole))
            yield Condition(f"pictures-{count}", clip=Named("pictures", {"count": count}))


def _named(text: str) -> str:
    return text.replace("/", "-")


def _names(methods: Sequence[ResolvedMethod]) -> list[str]:
    return [method.spec.name for method in methods]


def _lengthened(config: RunConfig, settings: CurveSettings) -> RunConfig:
    """The run's configuration with the budgets asked for."""
    return replace(config, settings=merge(config.settings, iterations(settings.iterations)))


def _wanted(settings: CurveSettings, source: RunFolder) -> list[ResolvedMethod]:
    """The methods to train, each with a budget."""
    trained = {record.name for record in source.read_manifest().methods}
    resolved = [
        m
        for m in resolve_methods(_lengthened(run_configuration(source.root, settings), settings))
        if m.spec.name in trained
    ]
    names = ", ".join(_names(resolved)) or "none that it trained"
    for name in settings.methods:
        if name not in _names(resolved):
            raise InputError(source.manifest, "methods", f"methods of the run: {names}", name)
    wanted = [
        m for m in resolved if (m.spec.name in settings.methods if settings.methods else not m.spec.trivial)
    ]
    if not wanted:
        raise InputError(source.manifest, "methods", "a method that is no trivial baseline", names)
    for name in iterations(settings.iterations):
        if name not in _names(wanted):
            expected = f"methods that are trained: {', '.join(_names(wanted))}"
            raise InputError("command line", "--iterations", expected, name)
    for method in wanted:
        if method.budget == Budget():
            key, expected = f"budget of {method.spec.name}", "iterations or seconds, to train with a part of"
            remedy = "Name other methods with --methods."
            raise InputError(source.manifest, key, expected, "none", remedy)
    programs = [method.spec.name for method in wanted if not method.spec.native]
    check_trusted(source.manifest, {PROGRAMS: programs}, trust=settings.trust)
    return wanted


def _drop_interrupted(out: Path) -> None:
    """Remove interrupted trainings, so that they restart and their time can be measured."""
    for folder in sorted(out.glob("*/*/seed-*")):
        if Cell(folder).record.get("state") == "training":
            log.info("%s: its training was interrupted; it begins again", folder)
            shutil.rmtree(folder)
