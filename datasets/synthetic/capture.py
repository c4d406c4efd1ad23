"""Make a synthetic capture: plan every subject, render what is missing, write the layout.

A folder belongs to one set of settings. Each image is written atomically and depends only on those settings, so a
killed run continues and gives the same capture.

Every file has the same bytes on every x86-64 machine, with any number of threads (see `head.geometry` and `panels`).
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from ...bench.contracts import Progress, no_progress
from ...bench.errors import HeadbenchError, InputError
from ...bench.executors.settings import Execution
from ...bench.executors.task import TASK_LOG, Task
from ...bench.io.documents import read_json
from ...bench.io.files import user_files, write_json, write_text
from ...bench.io.provenance import SYNTHETIC, xmp
from ...bench.machine import processor_count
from ...bench.start import end_with_parent, starting_workers
from ..ga.writer import link_or_copy
from ..images import is_whole
from .panels import KERNEL, default_samples, sample_count
from .performance import KINDS, Kind, share_out
from .plan import (
    EDITION,
    MOST_RESIDUAL,
    RESIDUALS,
    SERIALS,
    SubjectPlan,
    SyntheticSettings,
    load_geometry,
    plan_subject,
    subject_name,
)
from .renderer import CaptureRenderer
from .tracking import TRACKERS, Tracker

MANIFEST, MARK = "synthesis.json", "provenance.xmp"
TASKS = ".tasks"
"""Folder of an executor's tasks while a capture is incomplete."""
_VERSION = 3
_SMALL = 400_000  # total pixels below which starting another process costs more time than rendering
_README = """This folder holds synthetic recordings made by `headbench synth`.

No person was recorded. Heads, skin, hair and performances are computed; subject numbers from 900 up, camera
serials and sequence names only follow the conventions of real recordings so that the same tools read both.
Settings: synthesis.json.
"""


def synthesize(
    out: str | Path,
    *,
    subjects: int = 1,
    cameras: int = 16,
    timesteps: int = 60,
    size: tuple[int, int] = (275, 401),
    head: str = "procedural",
    seed: int = 0,
    tracking_noise: float = 0.0,
    samples_per_pixel: int | None = None,
    performance: Kind = "natural",
    dynamics: float = 1.0,
    tracking_error: float = 0.0,
    tracker: Tracker = "video",
    hair_lag: float = 0.0,
    camera_colour: float = 0.0,
    motion_blur: float = 0.0,
    mask_error: float = 0.0,
    correctives: float = 0.0,
    edition: int = EDITION,
    pictures: str | Path | None = None,
    only: int | str | None = None,
    workers: int | None = None,
    execution: Execution | None = None,
    progress: Progress = no_progress,
) -> list[Path]:
    """Render ``subjects`` heads with a performance and write them as captures; return their union folders.

    Settings are those of `headbench synth`, documented at `command.SynthSettings`.

    Parameters
    ----------
    samples_per_pixel : int | None
        Rounded up to a count that the sampler supports; the default gives at least 43 dB between two renders of a frame.
    edition : int
        Edition of a capture to reproduce; only the current one is accepted.
    pictures : str | Path | None
        Folder of an earlier capture that differs only in its tracking. Its pictures are linked, or
        copied if links are not supported, instead of rendered.
    only : int | str | None
        The only subject to render in this call, by index from 0 or by name; None renders all.
    workers : int | None
        Number of rendering processes; by default one per core, or one for little work.
    execution : Execution | None
        Executor that renders the subjects, one task each; None renders one after another in this
        process and its ``workers``.
    """
    samples = default_samples(*size) if samples_per_pixel is None else sample_count(samples_per_pixel)
    pixels = (size[0], size[1])
    settings = SyntheticSettings(
        subjects,
        cameras,
        timesteps,
        pixels,
        head,
        seed,
        tracking_noise,
        samples,
        performance,
        dynamics,
        tracking_error,
        tracker,
        hair_lag,
        camera_colour,
        motion_blur,
        mask_error,
        correctives,
    )
    if edition != EDITION:
        remedy = "Use the version of headbench that made it, or name the folder of the capture."
        raise InputError(
            "synthetic capture", "edition", f"{EDITION}, which this version makes", str(edition), remedy
        )
    _check(settings)
    KERNEL.load()
    geometry = load_geometry(head)
    out = Path(out)
    wanted = _manifest(settings, geometry.head.fingerprint())
    if pictures is not None:
        _check_pictures(Path(pictures), wanted)
    _claim(out, wanted)
    chosen = [place for place in range(subjects) if only in (None, place, subject_name(place))]
    if not chosen:
        raise InputError("synthetic capture", "only", f"one of its {subjects} subjects", repr(only)[:40])
    plans = [plan_subject(out, index, geometry, settings) for index in chosen]
    if pictures is not None:
        _take_over(Path(pictures), out, plans)
    total = len(plans) * timesteps * cameras
    done = 0
    progress(done, total)
    if execution is not None and execution.executor in ("processes", "slurm"):
        _run_all(out, plans, execution)
    for plan in plans:
        work = _left(plan)
        done += timesteps * cameras - sum(len(names) for _, _, names in work)
        for sequence, count in _render_missing(out, plan, work, workers):
            done += count
            progress(done, total, f"subject {plan.person.name}, sequence {sequence}")
    return [plan.writer.write_metadata() for plan in plans]


Job = tuple[str, int, tuple[str, ...]]
"""A sequence, a timestep in it, and the cameras whose image is missing."""


def _render_missing(
    out: Path, plan: SubjectPlan, work: list[Job], workers: int | None
) -> Iterator[tuple[str, int]]:
    """Render the jobs; yield (sequence, number of images) after each."""
    images = sum(len(cameras) for _, _, cameras in work)
    small = images * plan.settings.size[0] * plan.settings.size[1] < _SMALL
    count = min(workers or (1 if small else processor_count()), len(work))
    if count <= 1:
        renderer = CaptureRenderer(plan) if work else None
        for job in work:
            assert renderer is not None
            renderer.render_frames(*job)
            yield job[0], len(job[2])
        return
    # Spawned, since neither torch nor the renderer's thread pool survives a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, context, _begin, (out, plan.index, plan.settings))
    try:
        with starting_workers():
            futures = {pool.submit(_render, job): job for job in work}
        for future in as_completed(futures):
            future.result()
            yield futures[future][0], len(futures[future][2])
    except BaseException:
        for process in multiprocessing.active_children():
            process.kill()  # otherwise unfinished images would be waited for
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_renderer: list[CaptureRenderer] = []
"""The renderer of a worker process; it cannot be passed to spawned processes."""


def _begin(out: Path, index: int, settings: SyntheticSettings) -> None:
    end_with_parent()
    torch.set_num_threads(1)  # the processes share the cores already
    threadpool_limits(1)
    _renderer.append(CaptureRenderer(plan_subject(out, index, load_geometry(settings.head), settings)))


def _render(job: Job) -> None:
    _renderer[0].render_frames(*job)


def _run_all(out: Path, plans: Sequence[SubjectPlan], execution: Execution) -> None:
    """Render the subjects with missing images by an executor. Raises `HeadbenchError` if one failed."""
    from ...bench.executors.schedule import Schedule

    root = out.resolve() / TASKS  # not recognised as a capture
    by_name = {plan.person.name: plan for plan in plans if _left(plan)}
    tasks = [
        Task.of(
            root,
            name,
            f"{__name__}:render_subject",
            out=str(out),
            index=plan.index,
            settings=asdict(plan.settings),
        )
        for name, plan in by_name.items()
    ]
    root.mkdir(exist_ok=True)
    failed = Schedule("subjects", lambda task: not _left(by_name[task.place]), execution).run_all(tasks)
    for name, reason in failed.items():
        raise HeadbenchError(f"Subject {name} failed: {reason} Its log is {root / name / TASK_LOG}.")
    shutil.rmtree(root)


def render_subject(task: Task, report: Callable[[str], None]) -> None:
    """Render the missing images of a subject, as an executor's task with its number of threads."""
    given = task.arguments
    settings = SyntheticSettings(**{**given["settings"], "size": tuple(given["settings"]["size"])})
    out = Path(given["out"])
    plan = plan_subject(out, given["index"], load_geometry(settings.head), settings)
    work = _left(plan)
    total, done = sum(len(names) for _, _, names in work), 0
    threads = os.environ.get("OMP_NUM_THREADS", "")
    for sequence, count in _render_missing(out, plan, work, int(threads) if threads.isdigit() else None):
        done += count
        report(f"{done} of {total} {sequence}")


def _left(plan: SubjectPlan) -> list[Job]:
    """Missing parts of a subject."""
    missing = [
        (sequence, timestep, _missing(plan, sequence, timestep)) for sequence, timestep in plan.moments()
    ]
    return [entry for entry in missing if entry[2]]


def _missing(plan: SubjectPlan, sequence: str, timestep: int) -> tuple[str, ...]:
    """Cameras with a missing or incomplete image or mask."""

    def whole(camera: str) -> bool:
        place, writer = (sequence, timestep, camera), plan.writer
        return all(
            is_whole(p, *plan.settings.size) for p in (writer.image_path(*place), writer.mask_path(*place))
        )

    return tuple(camera for camera in plan.cameras if not whole(camera))


def _check(settings: SyntheticSettings) -> None:
    size, noise, most = settings.size, settings.tracking_noise, len(SERIALS)
    error = settings.tracking_error
    count, kinds = settings.cameras, ", ".join(KINDS)
    checks = (
        ("--subjects", settings.subjects >= 1, "at least 1", settings.subjects),
        ("--cameras", 2 <= count <= most, f"2 to {most}, as the frontal one is held out", count),
        ("--seed", settings.seed >= 0, "a whole number from 0", settings.seed),
        ("--performance", settings.performance in KINDS, f"one of {kinds}", repr(settings.performance)),
        ("--dynamics", 0.0 <= settings.dynamics <= 3.0, "0 to 3", settings.dynamics),
        ("--size", min(size) >= 16, "at least 16 pixels each way", "x".join(map(str, size))),
        ("--tracking-error", np.isfinite(error) and 0.0 <= error <= 4.0, "0 to 4", error),
        ("--tracker", settings.tracker in TRACKERS, f"one of {', '.join(TRACKERS)}", repr(settings.tracker)),
        ("--tracking-noise", np.isfinite(noise) and noise >= 0.0, "a number from 0 up", noise),
    )
    levels = {name: getattr(settings, name) for name in RESIDUALS}
    residuals = (
        (f"--{name.replace('_', '-')}", 0.0 <= level <= MOST_RESIDUAL, f"0 to {MOST_RESIDUAL:g}", level)
        for name, level in levels.items()
    )
    for option, fits, expected, found in (*checks, *residuals):
        if not fits:
            raise InputError(option, "", expected, str(found))
    share_out(settings.timesteps, settings.performance)


def _manifest(settings: SyntheticSettings, head: str) -> dict[str, Any]:
    """Files in a folder that belong to these settings and to a head of this fingerprint."""
    return {
        "version": _VERSION,
        **settings.described(),
        "head": Path(settings.head).name,  # not the path, since only the content counts
        "size": list(settings.size),
        "head_fingerprint": head,
    }


def _check_pictures(pictures: Path, wanted: Mapping[str, Any]) -> None:
    """Refuse images whose settings differ in more than tracking."""
    manifest = pictures / MANIFEST
    manifest_data = read_json(manifest)
    tracking = {"tracking_error", "tracking_noise", "tracker"}
    for key in {**wanted, **manifest_data}.keys() - tracking - {"head"}:  # the name of the head is irrelevant
        if manifest_data.get(key) != wanted.get(key):
            raise InputError(
                manifest, key, f"{wanted.get(key)!r}, as asked for", f"{manifest_data.get(key)!r}"
            )


def _take_over(pictures: Path, out: Path, plans: Sequence[SubjectPlan]) -> None:
    """Link the images and masks of another capture, or copy them if links are not supported."""
    for plan in plans:
        for (sequence, timestep), camera in product(plan.moments(), plan.cameras):
            place = (sequence, timestep, camera)
            for path in (plan.writer.mask_path(*place), plan.writer.image_path(*place)):
                source = pictures / path.relative_to(out)
                if not is_whole(source, *plan.settings.size):
                    remedy = "Make that capture whole, or give no pictures."
                    raise InputError(source, "", "a picture of the capture", "none that is whole", remedy)
                if path.exists():
                    continue
                link_or_copy(source, path)


def _claim(out: Path, wanted: Mapping[str, Any]) -> None:
    """Mark the folder as belonging to the capture with settings ``wanted``; refuse the folder of another capture."""
    manifest, readme = out / MANIFEST, out / "README.txt"
    if manifest.exists():
        manifest_data = read_json(manifest)
        for key in {**wanted, **manifest_data}:
            if manifest_data.get(key) != wanted.get(key):
                expected, remedy = (
                    f"{wanted.get(key)!r}, as asked for",
                    "Give another folder, or the same settings.",
                )
                raise InputError(manifest, key, expected, f"{manifest_data.get(key)!r}", remedy)
    else:
        if user_files(out):
            raise InputError(out, "", "an empty folder or an earlier synthetic capture", "other files")
        write_json(manifest, wanted)
    if not readme.exists():
        write_text(readme, _README)
    if not (out / MARK).exists():
        write_text(out / MARK, xmp(SYNTHETIC))
