"""The avatars that a finished run left, with the clips they were trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..captures import open_clips
from ..configuration import build
from ..contracts import Avatar
from ..errors import InputError
from ..run_config import RunConfig, resolve_methods
from ..runner import adapt, make_jobs
from ..stages import Job
from ..store import RunFolder


def run_configuration(run: Path) -> RunConfig:
    """Settings of a run, its folder being where it is now. Raises `InputError` where it is not the folder of a run."""
    folder = RunFolder(run)
    recorded = folder.read_manifest().get("configuration")
    if not isinstance(recorded, dict):
        raise InputError(folder.manifest, "configuration", "the settings of the run", "none")
    return replace(build(RunConfig, recorded, str(folder.manifest)), out=str(run))


def trained(run: Path, methods: Sequence[str] = (), data: str | None = None) -> list[Job]:
    """Return the cells of a run whose avatar is trained; `load` reads one.

    Parameters
    ----------
    run : folder of the run.
    methods : names of those wanted; default: all but the floors, which nothing can drive to extremes.
    data : where the capture lies now, if it was moved.

    Raises
    ------
    InputError
        For a method that the run does not have, a capture that is not the one trained on, an avatar that is not
        there or whose training did not end, and a run without any avatar to look at.
    """
    config = run_configuration(run)
    folder = RunFolder(run)
    if data is not None:
        config = replace(config, data=data)
    resolved = resolve_methods(config)
    names = [method.spec.name for method in resolved]
    for name in methods:
        if name not in names:
            raise InputError(folder.manifest, "methods", ", ".join(names), name)
    wanted = [m for m in resolved if (m.spec.name in methods if methods else not m.spec.trivial)]
    if not wanted:
        raise InputError(folder.manifest, "methods", "a method that is no floor", ", ".join(names))
    clips = open_clips(config)
    fingerprints = {c["subject"]: c["fingerprint"] for c in folder.read_manifest().get("clips", [])}
    for clip in clips:
        known = fingerprints.get(clip.subject)
        if known != clip.fingerprint:
            raise InputError(
                config.data,
                f"subject {clip.subject}",
                f"the capture of the run ({str(known)[:12]})",
                f"another ({clip.fingerprint[:12]})",
                "Give the folder of the capture, or run again.",
            )
    jobs = make_jobs(config, wanted, clips, {}, folder, adapt(clips, wanted, config, folder))
    for job in jobs:
        state = job.cell.stage("fit")
        if state is None or state.get("status") != "done":
            found = "none" if state is None else "one whose training did not end"
            raise InputError(job.cell.folder, "fit.json", "a trained avatar", found, "Start the run again.")
    return jobs


def load(job: Job) -> Avatar:
    """Read the avatar of a cell."""
    avatar: Avatar = job.method.create().load(job.cell.avatar, device=job.device)
    return avatar
