"""``headbench prepare nersemble``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_kind
from ...bench.specs import CommandResult, command
from .names import SUBJECT_NAMES, PrepareSettings, chosen_subjects

if TYPE_CHECKING:
    from .plan import PreparationPlan
    from .prepare import SubjectResult


@command("prepare nersemble", group="data")
def prepare_nersemble(settings: PrepareSettings, progress: Progress = no_progress) -> CommandResult:
    """Convert raw NeRSemble recordings to captures.

    Everything about every subject is checked before the first frame is decoded.
    """
    from .plan import plan_subject
    from .prepare import prepare
    from .tracking import check_unions

    subjects = chosen_subjects(settings.subjects)
    if bool(settings.root) == bool(settings.union_root):
        found = "both" if settings.root else "neither"
        raise InputError("command line", "--root", "--root or --union-root", found)
    if settings.downscale < 1:
        raise InputError("command line", "--downscale", "a number from 1", f"{settings.downscale}")
    for key in ("every", "workers"):
        if getattr(settings, key) < 0:
            raise InputError("command line", f"--{key}", "a number from 0", f"{getattr(settings, key)}")
    if settings.union_root:
        return check_unions(Path(settings.union_root), subjects, rejoin=settings.rejoin, progress=progress)
    check_kind(Path(settings.out), "captures")
    _check_named(settings, subjects)
    plans = [plan_subject(settings, subject) for subject in subjects]
    if settings.check:
        return _checked(plans)
    return _done(prepare(plans, workers=settings.workers, progress=progress), plans, settings)


def _check_named(settings: PrepareSettings, subjects: list[str]) -> None:
    """Raise `InputError` if no subject of a named group exists."""
    from .recording import participants

    by_id = participants(Path(settings.root))
    if settings.subjects not in SUBJECT_NAMES or set(subjects) & set(by_id):
        return
    remedy = f"Name those to prepare, as in --subjects {next(iter(by_id))}"
    remedy += ': it defaults to "paper".' if settings.subjects == "paper" else "."
    expected = f'folders of "{settings.subjects}", which is {", ".join(subjects)}'
    raise InputError(settings.root, "--subjects", expected, ", ".join(by_id), remedy)


def _table(plans: list[PreparationPlan]) -> list[str]:
    lines = [f"{'subject':8} {'sequence':34} {'timesteps':>9} {'cameras':>7}  masks  colour  tracking"]
    for plan in plans:
        for job in plan.jobs:
            test = " (test)" if job.recorded.name in plan.test else ""
            marks = (job.recorded.has_masks, bool(job.corrections), job.tracked is not None)
            flags = "  ".join(f"{'yes' if mark else 'no':6}" for mark in marks)
            lines.append(
                f"{plan.subject:8} {job.recorded.name + test:34} {job.count:9} {len(job.cameras):7}  {flags}"
            )
    return lines


def _checked(plans: list[PreparationPlan]) -> CommandResult:
    images = sum(job.count * len(job.cameras) for plan in plans for job in plan.jobs)
    text = "\n".join([*_table(plans), "", f"All there: {images} images to make."])
    return CommandResult(text, {"images": images, "subjects": [plan.subject for plan in plans]})


def _done(
    results: list[SubjectResult], plans: list[PreparationPlan], settings: PrepareSettings
) -> CommandResult:
    """Passed unless requested parameters are missing."""
    lines = _table(plans)
    for plan, result in zip(plans, results, strict=True):
        lines += ["", f"{result.subject}: {result.written} images written, {result.kept} there already."]
        lines += [f"  {sentence}" for sentence in result.missing]
        if result.union is not None:
            splits = ", ".join(f"{count} {name}" for name, count in result.frames.items())
            suffix = "pkl" if plan.head_model.startswith("flame") else "npz"
            head = f" --head {settings.head or f'{plan.head_model}.{suffix}'}"
            lines += [
                f"  Frames: {splits}.",
                f"  Use it: headbench run --data {result.union}{head} --out runs/{result.subject}",
            ]
    data = {}
    for result in results:
        data[result.subject] = {**vars(result), "missing": list(result.missing)}
        del data[result.subject]["subject"]
    passed = not settings.tracking or all(result.union is not None for result in results)
    return CommandResult("\n".join(lines), data, passed)
