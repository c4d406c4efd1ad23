"""The avatars that a finished run left, with the clips they were trained on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..contracts import Avatar
from ..errors import InputError
from .captures import open_run_clips, run_configuration
from .config import RunConfig, resolve_methods
from .options import RunOptions
from .run import adapt, make_jobs
from .stages import Job
from .store import RunFolder


def trained(run: Path, methods: Sequence[str], options: RunOptions, out: Path) -> tuple[RunConfig, list[Job]]:
    """Return the settings of a run and its cells whose avatar is trained; `load` reads one.

    Parameters
    ----------
    run : folder of the run.
    methods : names of those wanted; empty: all but the floors, which nothing can drive to extremes.
    options : where the run's files are now.
    out : folder to keep clips in that methods need in another form; its lock is held. It becomes ``out`` of the settings.

    Raises
    ------
    InputError
        For a method that the run does not have, a capture that is not the one trained on, an avatar that is not
        there or whose training did not end, and a run without any avatar to look at.
    """
    folder = RunFolder(run)
    resolved = resolve_methods(run_configuration(run, options))
    names = [method.spec.name for method in resolved]
    for name in methods:
        if name not in names:
            raise InputError(folder.manifest, "methods", ", ".join(names), name)
    wanted = [m for m in resolved if (m.spec.name in methods if methods else not m.spec.trivial)]
    if not wanted:
        raise InputError(folder.manifest, "methods", "a method that is no floor", ", ".join(names))
    config, clips = open_run_clips(run, options, out=out)
    jobs = make_jobs(config, wanted, clips, {}, folder, adapt(clips, wanted, config, RunFolder(out), folder))
    for job in jobs:
        state = job.cell.stage("fit")
        if state is None or state.get("status") != "done":
            found = "none" if state is None else "one whose training did not end"
            raise InputError(job.cell.folder, "fit.json", "a trained avatar", found, "Start the run again.")
    return config, jobs


def load(job: Job) -> Avatar:
    """Read the avatar of a cell."""
    avatar: Avatar = job.method.create().load(job.cell.avatar, device=job.device)
    return avatar
