"""Runs a comparison: checks everything, then fits, renders and measures cell by cell, then reports."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from . import adaptation
from .adaptation import AdaptedClip, MethodNeeds
from .audit.digests import record_digests
from .captures import open_clips
from .contracts import Clip
from .device import check_device
from .errors import HeadbenchError, InputError, UnavailableError
from .lock import locked
from .machine import machine_record, peak_memory_bytes
from .progress import duration
from .protocol import Protocol, make_protocol
from .registry import discover, get, resolve
from .run_config import ResolvedMethod, RunConfig, resolve_methods, resolve_metrics
from .scoring import check_regions, make_metric
from .specs import DatasetSpec, MetricSpec
from .stages import Job, failed_rows, fit, measure, render
from .store import RunFolder, write_rows

log = logging.getLogger(__name__)


def run(config: RunConfig, **record: Any) -> pd.DataFrame:
    """Run a comparison into ``config.out`` and return its rows; ``record`` is added to the manifest.

    Everything that can be checked is checked before the first long step: settings, device, methods, captures, the
    output folder, and that no other process works in it. A method that fails is recorded as failed and the others
    go on. Started again with the same configuration after a kill, it keeps what is done and continues what is not.
    """
    methods, metrics = resolve_methods(config), resolve_metrics(config)
    check_device(config.device)
    folder = RunFolder(Path(config.out))
    folder.prepare()
    with locked(folder.root):
        return _run(config, methods, metrics, folder, record)


def _run(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    metrics: Sequence[MetricSpec],
    folder: RunFolder,
    record: Mapping[str, Any],
) -> pd.DataFrame:
    start = time.perf_counter()
    for method in methods:
        method.create()  # an implementation that cannot be imported or made is not to be found out hours later
    clips = open_clips(config)
    protocols: dict[str, Protocol] = {
        task: make_protocol(task, clips, config.frames_per_task) for task in config.tasks
    }
    regions = {clip.subject: check_regions(clip, config.regions) for clip in clips}
    adapted = adapt(clips, methods, config, folder)
    jobs = make_jobs(config, methods, clips, protocols, folder, adapted, regions)
    for job in jobs:
        job.check()
    _warn_of_missing_metrics(metrics, clips[0])

    manifest = {**describe(config, methods, metrics, clips, protocols), **record}
    manifest["adapted"] = [
        adaptation.record(job.clip, job.adapted, job.method.spec.name)
        for job in jobs
        if job.adapted is not None and job.seed == config.seeds[0]
    ]
    folder.write_manifest({**manifest, "status": "started"})
    for protocol in protocols.values():
        log.info("%s, protocol %s: %d frames", protocol.task, protocol.hash, len(protocol.keys))
    frames = [_run_cell(job, metrics) for job in jobs]
    rows = pd.concat(frames, ignore_index=True)
    write_rows(folder.rows, rows)
    folder.write_manifest(
        {
            **manifest,
            "status": "done",
            "seconds": round(time.perf_counter() - start, 3),
            "peak_memory_bytes": peak_memory_bytes(),
        }
    )
    write_reports(folder.root)
    log.info("finished in %s: %s", duration(time.perf_counter() - start), folder.root)
    return rows


def write_reports(run_folder: Path) -> list[Path]:
    """Write every registered report of a finished run. One that fails is logged and the others are written."""
    written: list[Path] = []
    for name, plugin in discover("reports").items():
        if plugin.spec is None:
            log.warning("report %r of %s is broken: %s", name, plugin.origin, plugin.error)
        elif plugin.spec.writes:
            try:
                written += resolve(plugin.spec.implementation)(run_folder)
            except Exception:
                log.exception("report %r of %s failed; the rows are complete", name, plugin.origin)
    return written


Adapted = Mapping[tuple[str, MethodNeeds], AdaptedClip]


def adapt(
    clips: Sequence[Clip],
    methods: Sequence[ResolvedMethod],
    config: RunConfig,
    folder: RunFolder,
) -> Adapted:
    """Bring every clip into every form that a method needs, once each; first make sure that all can be had."""
    reader: DatasetSpec = get("datasets", config.reader)
    planned = {}
    for clip in clips:
        for needs in {MethodNeeds.of(method.spec): None for method in methods}:
            step = adaptation.plan(clip, needs, reader, config.heads)
            if step is not None:
                planned[clip.subject, needs] = step
    return {
        (subject, needs): adaptation.carry_out(step, needs, folder.adapted / subject, f"adapting {subject}")
        for (subject, needs), step in planned.items()
    }


def make_jobs(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
    folder: RunFolder,
    adapted: Adapted,
    regions: Mapping[str, tuple[str, ...]] | None = None,
) -> list[Job]:
    return [
        Job(
            clip,
            method,
            seed,
            config.device,
            folder.cell(clip.subject, method.spec.name, seed),
            protocols,
            adapted.get((clip.subject, MethodNeeds.of(method.spec))),
            (regions or {}).get(clip.subject, ()),
        )
        for clip in clips
        for method in methods
        for seed in config.seeds
    ]


def _run_cell(job: Job, metrics: Sequence[MetricSpec]) -> pd.DataFrame:
    log.info("%s", job.name)
    try:
        avatar = fit(job)
        render(job, avatar)
        rows = measure(job, avatar, metrics)
        record_digests(job, avatar)
        return rows
    except InputError as error:
        log.error("%s failed: %s", job.name, error)
        return failed_rows(job, metrics, error)
    except Exception as error:
        log.exception("%s failed", job.name)
        return failed_rows(job, metrics, error)


def _warn_of_missing_metrics(metrics: Sequence[MetricSpec], clip: Clip) -> None:
    """Say before the training, not after it, which metric cannot be had."""
    image = clip.image(clip.splits["train"][0])
    for spec in metrics:
        metric = make_metric(spec)
        if not spec.per_frame:
            continue
        try:
            value = metric(image, image, image, image) if spec.temporal else metric(image, image)
        except UnavailableError as error:
            log.warning("%s will be missing: %s", spec.label, error)
        else:
            if not np.isfinite(value):
                raise HeadbenchError(f"metric {spec.name} gives {value} for identical images")


def describe(
    config: RunConfig,
    methods: Sequence[ResolvedMethod],
    metrics: Sequence[MetricSpec],
    clips: Sequence[Clip],
    protocols: Mapping[str, Protocol],
) -> dict[str, Any]:
    """What the manifest of a run tells: everything that made its numbers."""
    return {
        "configuration": asdict(config),
        "methods": [method.record() for method in methods],
        "metrics": [asdict(metric) for metric in metrics],
        "clips": [
            {
                "subject": clip.subject,
                "fingerprint": clip.fingerprint,
                "steps": [asdict(step) for step in clip.steps],
                "splits": {name: len(keys) for name, keys in clip.splits.items()},
                "excluded": {str(key): reason for key, reason in sorted(clip.excluded.items())},
            }
            for clip in clips
        ],
        "protocols": {
            task: {"id": protocol.id, "hash": protocol.hash, **asdict(protocol)}
            for task, protocol in protocols.items()
        },
        "machine": machine_record(),
    }
