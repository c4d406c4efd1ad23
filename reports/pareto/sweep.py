"""Derives variants of a run's avatars, renders and measures them, and leaves a run folder of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ...bench.contracts import Progress, Variant
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest
from ...bench.manifest import Derived, MethodRecord
from ...bench.protocol import make_protocols
from ...bench.registry import get, resolve
from ...bench.rows import Rows
from ...bench.runner.config import default_names, resolve_metrics
from ...bench.runner.run import describe, load, trained
from ...bench.runner.steps import Job, measure, render
from ...bench.runner.store import RunFolder
from ...bench.runner.stored import shown_by, write_avatar_record
from ...bench.specs import MetricSpec
from .settings import SweepSettings


def sweep(settings: SweepSettings, out: Path, progress: Progress) -> Rows:
    """Derive, render and measure; return the rows of the run folder that it writes to ``out``.

    The trained avatars are measured again beside their variants, so that frame times were taken in one go. Started
    again, it keeps what is measured. Raises `InputError` for a folder that is no finished run, a method that derives
    nothing, a variant that none of them has.
    """
    config, jobs = trained(Path(settings.run), settings.methods, settings, out)
    able = [job for job in jobs if job.method.spec.variants]
    unable = sorted({job.method.spec.name for job in jobs} - {job.method.spec.name for job in able})
    if not able or (settings.methods and unable):
        found = ", ".join(unable) or "none"
        raise InputError(settings.run, "methods", "methods that derive variants", found)
    if settings.frames is not None:
        config = replace(config, frames_per_task=settings.frames)
    clips = list({job.clip.subject: job.clip for job in able}.values())
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    # What avatars cost, whether the run measured it or not.
    costs = [name for name in default_names("metrics") if get("metrics", name).kind == "avatar"]
    config = replace(config, metrics=tuple(dict.fromkeys((*config.metrics, *costs))))
    metrics = [spec for spec in resolve_metrics(config) if spec.kind != "training"]
    folder = RunFolder(out)
    derived = [(job, list(_chosen(job, settings.variants))) for job in able]
    known = {variant.name for _, variants in derived for variant in variants}
    for name in settings.variants:
        if name not in known:
            raise InputError("sweep", "variants", "a variant of these methods", repr(name))

    cells = [
        (replace(base, protocols=protocols).variant(variant.name if variant else "", folder), base, variant)
        for base, variants in derived
        for variant in (None, *variants)
    ]
    records = {job.method.spec.name: _record(job, base, variant) for job, base, variant in cells}
    manifest = describe(config, [], metrics, clips, protocols)
    manifest = replace(manifest, methods=tuple(records.values()), sweep_of=settings.run)
    folder.check_kept(manifest)
    frames: list[Rows] = []
    for job, base, variant in cells:
        progress(len(frames), len(cells), job.name)
        frames.append(_measured(job, base, variant, metrics))
    rows = Rows.joined(frames)
    folder.write_rows(rows)
    replace(manifest, status="done").write(folder.manifest)
    return rows


def _record(job: Job, base: Job, variant: Variant | None) -> MethodRecord:
    source: Derived | None = None
    if variant is not None:
        source = {"from": base.method.spec.name, "variant": variant.name, "change": variant.summary}
    return MethodRecord(**job.method.record(), derived=source)


def _chosen(job: Job, names: Sequence[str]) -> Iterator[Variant]:
    """Variants of a job's avatar, those named or all."""
    derive = resolve(job.method.spec.variants)
    for variant in derive(job.cell.avatar, job.form.clip, job.device):
        check_name(variant.name, job.method.spec.variants, "name of a variant")
        if not names or variant.name in names:
            yield variant


def _measured(job: Job, base: Job, variant: Variant | None, metrics: Sequence[MetricSpec]) -> Rows:
    job.check()
    avatar = load(base) if variant is None else variant.make(job.cell.avatar)
    source = base.cell.step("fit")
    assert source is not None  # `trained` saw to it
    derived_from = digest(source["fingerprint"], source.get("files"))
    if variant is not None:
        shown = shown_by(job.form.clip)
        change = {"variant": variant.name, "of": derived_from}
        write_avatar_record(job.cell.avatar, job.method, *shown, "variant", change)
    files = job.cell.digests(path for path in job.cell.avatar.rglob("*") if path.is_file())
    job.cell.finish("fit", job.fit_fingerprint, derived_from=derived_from, files=files)
    render(job, avatar)
    return measure(job, avatar, metrics)
