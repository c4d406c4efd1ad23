"""``headbench run curve``: quality over training time, cameras, timesteps, images or tracking error, as conditions of a run."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from ..condition import Condition, Named
from ..contracts import Budget, Clip, Progress, no_progress
from ..engine.captures import PROGRAMS, check_trusted, open_run_clips, run_configuration
from ..engine.config import ResolvedMethod, resolve_methods, with_methods
from ..engine.run import run
from ..engine.store import Cell, RunFolder
from ..errors import InputError
from ..io.files import check_kind, output_inside, refuse_links
from ..io.lock import locked
from ..registry import get, resolve
from ..specs import CommandResult, command
from .curve_settings import PICTURES, SECONDS, CurveSettings
from .held_out import CAMERA, TIMESTEPS, count_of

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

    Raises
    ------
    InputError
        The folder is not a finished run or has trainings with other settings, the run has no such
        method or the method has no budget, or a capture differs from the run's or has too few frames
        to hold some out.
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
    wanted = _wanted(settings, source)
    with nullcontext() if settings.out else output_inside(source.root), locked(out):
        config, opened = open_run_clips(source.root, settings, out=out)
        held = Named("hold-out", {"camera": settings.camera, "every": settings.every})
        config = replace(
            with_methods(config, _names(wanted)),
            clip=held,
            frames_per_task=settings.frames,
            metrics=(*METRICS, *COSTS),
            metric_profiles=("canonical",),
            regions=(),
            source="",
        )
        hold_out = resolve(get("conditions", held.name).implementation)
        clips: list[Clip] = [hold_out(clip, config, **held.parameters) for clip in opened]
        tasks = tuple(task for task in (CAMERA, TIMESTEPS) if all(task in clip.splits for clip in clips))
        config = replace(config, tasks=tasks, conditions=tuple(conditions(settings, wanted, clips)))
        refuse_links(out)
        _drop_interrupted(out)
        unchecked = bool(manifest.unchecked)  # for a run whose captures have errors
        run(config, execution, clips=clips, is_locked=True, reports=False, unchecked=unchecked)
        found: CommandResult = resolve(get("reports", "curve").implementation)(out, settings.over)
        return found


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


def _wanted(settings: CurveSettings, source: RunFolder) -> list[ResolvedMethod]:
    """The methods to train, each with a budget."""
    trained = {record.name for record in source.read_manifest().methods}
    resolved = [
        m for m in resolve_methods(run_configuration(source.root, settings)) if m.spec.name in trained
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
