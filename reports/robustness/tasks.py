"""Avatars that an executor's tasks render and judge: a file of each, which the process that asked merges."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from ...bench.errors import HeadbenchError, InputError, UnavailableError
from ...bench.executors.schedule import Schedule
from ...bench.executors.task import TASK_LOG, Task
from ...bench.io.documents import checked, read_json
from ...bench.io.files import write_json
from .settings import ExtremesSettings
from .stability import JudgedFrame, LimitCheck, RobustnessCase, cell_folder

FILE = "frames.json"
REPORT_EVERY_S = 10.0
"""Seconds between records of how far a task is."""


class _Check(TypedDict):
    """A `LimitCheck`. Numbers are text, since JSON has neither infinity nor what is not a number."""

    measure: str
    value: str | None
    lower: str
    upper: str
    absent: str


class _Frames(TypedDict):
    """What a task leaves: checks by frame, in the order of the case's keys, or in ``missing`` why there are none."""

    fingerprint: str
    missing: list[str]
    checks: list[list[_Check]]
    details: dict[str, Any]


def leave_frames(case: RobustnessCase, fingerprint: str, folder: Path, report: Callable[[str], None]) -> None:
    """Render and judge an avatar; write what came out to ``folder``."""
    left: _Frames = {"fingerprint": fingerprint, "missing": [], "checks": [], "details": {}}
    last = time.monotonic()

    def show(done: int) -> None:
        nonlocal last
        if time.monotonic() - last > REPORT_EVERY_S:
            last = time.monotonic()
            report(f"{done} of {len(case.keys)} frames")

    try:
        frames, left["details"] = case.render(show)
    except UnavailableError as error:
        left["missing"] = [error.what, error.remedy]
    else:
        left["checks"] = [[_written(check) for check in frame.checks] for frame in frames]
    write_json(folder / FILE, left)


def _written(check: LimitCheck) -> _Check:
    value = None if check.value is None else repr(float(check.value))
    limits = repr(float(check.lower)), repr(float(check.upper))
    return {
        "measure": check.measure,
        "value": value,
        "lower": limits[0],
        "upper": limits[1],
        "absent": check.absent,
    }


def _read(check: _Check) -> LimitCheck:
    value = None if check["value"] is None else float(check["value"])
    return LimitCheck(check["measure"], value, float(check["lower"]), float(check["upper"]), check["absent"])


def rendered_by_tasks(
    cases: Sequence[RobustnessCase],
    subjects: Sequence[str],
    fingerprints: Sequence[str],
    settings: ExtremesSettings,
    out: Path,
) -> list[RobustnessCase]:
    """Have an executor render all cases; return them with renderings that read what came out.

    Parameters
    ----------
    subjects : of the run, in the order in which its reader finds their captures.
    fingerprints : what the frames of each case depend on; those that an earlier start left of the same are kept.

    Raises
    ------
    HeadbenchError : a task failed.
    """
    given = {**settings.others, "run": str(settings.run)}
    tasks = {}
    for case in cases:
        job = case.job
        arguments = {
            "method": job.method.spec.name,
            "seed": job.seed,
            "capture": subjects.index(job.clip.subject),
        }
        place = cell_folder(out, job).relative_to(out).as_posix()
        tasks[place] = Task.of(
            out, place, f"{__package__}.extremes:render_avatar", settings=given, **arguments
        )
    made_of = dict(zip(tasks, fingerprints))

    def is_done(task: Task) -> bool:
        path = task.folder / FILE
        try:
            return path.exists() and read_frames(path)["fingerprint"] == made_of[task.place]
        except InputError:  # damaged
            return False

    left = [task for task in tasks.values() if not is_done(task)]
    failed = Schedule("avatars", is_done, settings.execution).run_all(left)
    for place, reason in failed.items():
        raise HeadbenchError(f"{place} failed: {reason} Its log is {out / place / TASK_LOG}.")
    return [
        replace(case, render=_reading(case, task.folder / FILE)) for case, task in zip(cases, tasks.values())
    ]


def read_frames(path: Path) -> _Frames:
    """Read what a task left. Raises `InputError` for a damaged file."""
    frames: _Frames = checked(read_json(path), _Frames, path)
    return frames


def _reading(
    case: RobustnessCase, path: Path
) -> Callable[[Callable[[int], None]], tuple[list[JudgedFrame], dict[str, Any]]]:
    def render(report: Callable[[int], None]) -> tuple[list[JudgedFrame], dict[str, Any]]:
        left = read_frames(path)
        path.unlink()  # asked for again, all is rendered again, as without tasks
        report(len(case.keys))
        if left["missing"]:
            raise UnavailableError(*left["missing"])
        pairs = zip(case.keys, left["checks"], strict=True)
        return [JudgedFrame(key, list(map(_read, checks))) for key, checks in pairs], left["details"]

    return render
